"""Wire types of the core's dataclasses: their fields, types and descriptions."""

from dataclasses import dataclass

import pytest
from pydantic import Field

from service.core.bodies.descriptions import describe_fields
from service.core.bodies.value_schemas import (
    describe_value,
    extend_by,
    extend_later_by,
)
from service.core.bodies.wire import Answer
from sysid.core.types import FloatArray
from sysid.core.value_documents import encode, has_fields, list_fields
from sysid.results.result import Result
from tests.support.storage.run_results import conclude


@dataclass(frozen=True)
class Measured:
    """A measured value.

    More is said here.

    Attributes
    ----------
    name : str
        Name of it. It may be empty.
    value : float
        Value, in V.
    rows : FloatArray, shape (N, 2)
        Values over two
        lines.

    Examples
    --------
    >>> 1
    1
    """

    name: str
    value: float
    rows: FloatArray


def test_a_wire_type_has_the_fields_with_their_descriptions() -> None:
    schema = describe_value(Measured).model_json_schema()
    assert (schema["title"], schema["description"]) == ("MeasuredOut", "A measured value.")
    fields = schema["properties"]
    assert [fields[name]["description"] for name in fields] == [
        "name of it. It may be empty",
        "value, in V",
        "values over two lines",
    ]
    assert schema["required"] == ["name", "value", "rows"]
    number = [{"type": "number"}, {"type": "null"}]
    assert fields["value"]["anyOf"] == number
    assert fields["rows"]["items"]["items"]["anyOf"] == number


def test_a_type_is_extended_by_all_fields_that_it_does_not_declare() -> None:
    @extend_by(Measured)
    class NumberedOut(Answer):
        """A numbered value."""

        name: int = Field(description="number of it")

    schema = NumberedOut.model_json_schema()
    assert list(schema["properties"]) == ["name", "value", "rows"]
    assert schema["properties"]["name"]["type"] == "integer"
    assert schema["description"] == "A numbered value."


def test_fields_that_come_later_are_null_until_then_and_are_not_checked() -> None:
    @extend_later_by(Measured, name="")
    class PendingOut(Answer):
        """A value that comes later."""

    assert PendingOut().model_dump() == {"name": "", "value": None, "rows": None}
    assert PendingOut.model_validate({"rows": "as stored"}).model_dump()["rows"] == "as stored"
    assert "required" not in PendingOut.model_json_schema()


def test_without_its_description_a_field_has_no_wire_type() -> None:
    @dataclass(frozen=True)
    class Silent:
        """Says nothing of its field."""

        value: float

    with pytest.raises(KeyError, match="value"):
        describe_value(Silent)


def test_a_result_fits_its_own_wire_type() -> None:
    document = encode(conclude(L=(1.0, 0.1)).identification, Result)
    assert describe_value(Result).model_validate(document)


def list_parts(kind: type) -> set[type]:
    """The dataclasses that a document consists of."""
    found, coming = set[type](), [kind]
    while coming:
        part = coming.pop()
        if has_fields(part) and part not in found:
            found.add(part)
            coming += [field.hint for field in list_fields(part)]
        else:
            coming += [one for one in getattr(part, "__args__", ()) if one is not part]
    return found


@pytest.mark.parametrize("kind", sorted(list_parts(Result), key=str))
def test_every_field_of_a_result_is_described(kind: type) -> None:
    described = describe_fields(kind)
    for field in list_fields(kind):
        assert described[field.name].text, field.name
