"""Where a validation error lies, and what it says."""

from typing import Any

import pytest
from pydantic import ValidationError

from service.core.bodies.validation import explain_errors
from service.jobs.job_schemas import JobIn
from sysid.core.errors import join_pointer, split_pointer


def list_faults(**changes: Any) -> dict[str, str]:
    body = {"model": "m", "datasets": ["d"], **changes}
    with pytest.raises(ValidationError) as refused:
        JobIn.model_validate(body)
    return {one.pointer: one.detail for one in explain_errors(refused.value.errors(), body, JobIn)}


def test_the_names_of_unions_are_not_in_a_pointer() -> None:
    assert list(list_faults(algorithm={"islands": "four"})) == ["/algorithm/islands"]


def test_an_unknown_field_inside_a_list_of_a_union_suggests_the_nearest() -> None:
    found = list_faults(algorithm={"islands": [{"metod": "simple"}]})
    assert "did you mean 'method'?" in found["/algorithm/islands/0/metod"]


def test_a_missing_field_has_the_place_where_it_should_be() -> None:
    assert list_faults(sweep={"axes": [{"values": [1]}]}) == {
        "/sweep/axes/0/path": "this field is required"
    }


def test_what_was_found_is_shown_but_not_at_length() -> None:
    detail = list_faults(seed="x" * 1000)["/seed"]
    assert "xxx" in detail
    assert len(detail) < 200


def test_slashes_and_tildes_are_escaped() -> None:
    assert join_pointer("a/b~c", 1) == "/a~1b~0c/1"
    assert split_pointer("/a~1b~0c/1") == ["a/b~c", "1"]
