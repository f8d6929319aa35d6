"""Pydantic's errors in our words: every kind of them, and none of its own sentences."""

import re
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field, TypeAdapter, ValidationError
from pydantic_core._pydantic_core import list_all_errors

from service.core.bodies.validation import PYDANTIC_KINDS, describe_error, explain_errors
from service.jobs.job_schemas import JobIn


def explain_value(kind: Any, value: Any) -> str:
    with pytest.raises(ValidationError) as refused:
        TypeAdapter(kind).validate_python(value)
    return describe_error(refused.value.errors()[0], ())


@pytest.mark.parametrize(
    ("kind", "value", "sentence"),
    [
        (int, "x", "found 'x'; need a whole number"),
        (int, 1.5, "found 1.5; need a whole number"),
        (int, None, "found null; need a whole number"),
        (float, "x", "found 'x'; need a number"),
        (float, [], "found []; need a number"),
        (str, True, "found true; need text"),
        (bool, "perhaps", "found 'perhaps'; need true or false"),
        (str, 3, "found 3; need text"),
        (Annotated[int, Field(ge=1)], 0, "found 0; need 1 or more"),
        (Annotated[int, Field(le=100)], 101, "found 101; need 100 or less"),
        (Annotated[float, Field(gt=0)], 0, "found 0; need a number above 0"),
        (Annotated[float, Field(lt=1)], 1, "found 1; need a number below 1"),
        (Annotated[int, Field(lt=2**63)], 2**63, f"found {2**63}; need a number below {2**63}"),
        (
            Annotated[float, Field(allow_inf_nan=False)],
            float("nan"),
            "found nan; need a finite number",
        ),
        (
            Annotated[str, Field(max_length=2)],
            "abc",
            "found 'abc' (3 characters); need at most 2 characters",
        ),
        (Annotated[str, Field(min_length=1)], "", "found ''; need at least 1 character"),
        (Annotated[list[int], Field(min_length=1)], [], "found []; need at least 1 entry"),
        (
            Annotated[list[int], Field(max_length=1)],
            [1, 2],
            "found [1, 2] (2 entries); need at most 1 entry",
        ),
        (Literal["a", "b"], "c", "found 'c'; need 'a' or 'b'"),
        (list[int], 3, "found 3; need a list"),
        (list[str], "a", "found 'a'; need a list, such as ['a']"),
        (dict[str, int], 3, "found 3; need an object (name: value)"),
        (set[int], 3, "found 3; this cannot be used here"),
    ],
)
def test_a_sentence_tells_what_was_found_and_what_would_be_right(
    kind: Any, value: Any, sentence: str
) -> None:
    assert explain_value(kind, value) == sentence


def test_no_sentence_of_pydantic_is_told() -> None:
    errors = list_all_errors()
    assert {error["type"] for error in errors} <= set(PYDANTIC_KINDS)
    assert [error["type"] for error in errors if is_repeated(error)] == []


def is_repeated(error: Any) -> bool:
    """Whether our sentence has the longest piece of Pydantic's own."""
    template = error["message_template_python"]
    context = {name: f"<{name}>" for name in error.get("example_context") or {}}
    entry = {"type": error["type"], "loc": ("field",), "input": 3, "ctx": context, "msg": template}
    longest = max(re.split(r"{\w+}", template), key=len)
    return longest in describe_error(entry, ["other"])


def test_an_unknown_field_that_is_one_elsewhere_is_told_with_its_place() -> None:
    body = {"model": "m", "datasets": ["d"], "population": 50, "sigm": 1, "algoritm": {}}
    with pytest.raises(ValidationError) as refused:
        JobIn.model_validate(body)
    found = {one.pointer: one.detail for one in explain_errors(refused.value.errors(), body, JobIn)}
    assert found["/population"] == "unknown field 'population'; there is /algorithm/population"
    assert "did you mean 'algorithm'?" in found["/algoritm"]
