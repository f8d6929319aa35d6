"""Values as documents: what is written is read again, and a misfit says where it is."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.core.value_documents import Misfit, decode, decode_exactly, encode, encode_exactly


class SizedName(NamedTuple):
    name: str
    size: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    value: float
    ends: tuple[float, float] | None = None
    kind: Literal["a", "b"] = "a"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Whole:
    parts: tuple[Part, ...]
    pair: SizedName
    rows: FloatArray = field(metadata={"digits": 3})
    by_name: Mapping[str, float]
    is_good: bool = True


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Extended(Whole):
    secret: int


def whole(**changes: Any) -> Whole:
    known = {
        "parts": (Part(value=1.5, ends=(0.5, 2.5)), Part(value=math.inf, kind="b")),
        "pair": SizedName("n", 2),
        "rows": np.array([[1.23456, 2.0], [3.0, -4.0]]),
        "by_name": {"L": 0.1},
    }
    return Whole(**{**known, **changes})


DOCUMENT = {
    "parts": [
        {"value": 1.5, "ends": [0.5, 2.5], "kind": "a"},
        {"value": None, "ends": None, "kind": "b"},
    ],
    "pair": {"name": "n", "size": 2},
    "rows": [[1.23, 2.0], [3.0, -4.0]],
    "by_name": {"L": 0.1},
    "is_good": True,
}


def test_a_plain_document_has_the_fields_null_and_few_digits() -> None:
    assert encode(whole()) == DOCUMENT
    assert json.loads(json.dumps(DOCUMENT, allow_nan=False)) == DOCUMENT


def test_a_plain_document_is_read_as_the_value_and_null_as_nan() -> None:
    found = decode(Whole, DOCUMENT)
    assert found.parts[0] == whole().parts[0]
    assert math.isnan(found.parts[1].value)
    assert found.pair == SizedName("n", 2)
    assert found.rows.tolist() == DOCUMENT["rows"]
    assert encode(found) == DOCUMENT


def test_null_in_an_array_of_a_plain_document_is_nan_and_whole_numbers_are_numbers() -> None:
    rows = decode(Whole, {**DOCUMENT, "rows": [[None, 2]]}).rows
    assert rows.dtype == np.float64
    np.testing.assert_array_equal(rows, [[math.nan, 2.0]])


def test_of_a_subclass_only_the_fields_of_the_base_are_written() -> None:
    parts = {name: getattr(whole(), name) for name in ("parts", "pair", "rows", "by_name")}
    assert encode(Extended(**parts, secret=7), Whole) == DOCUMENT
    assert encode(Extended(**parts, secret=7)) == {**DOCUMENT, "secret": 7}


def test_an_exact_document_keeps_every_bit_and_what_json_lacks() -> None:
    odd = whole(rows=np.array([[math.nan, -math.inf, 1 / 3]]), by_name={"L": -math.inf})
    document = json.loads(json.dumps(encode_exactly(odd), allow_nan=False))
    assert document["rows"] == [["nan", "-inf", 1 / 3]]
    found = decode_exactly(Whole, document)
    assert encode_exactly(found) == encode_exactly(odd)
    assert found.rows.tobytes() == odd.rows.tobytes()
    assert found.parts == odd.parts


def test_an_empty_array_keeps_its_shape_in_an_exact_document() -> None:
    empty = whole(rows=np.zeros((0, 3)))
    assert decode_exactly(Whole, encode_exactly(empty)).rows.shape == (0, 3)


@pytest.mark.parametrize("scalar", [np.float64(1.5), np.float64(math.nan)])
def test_a_number_of_numpy_is_a_number(scalar: np.float64) -> None:
    [written] = encode([scalar])
    assert written == (None if np.isnan(scalar) else 1.5)
    assert type(written) in (float, type(None))


def test_fields_with_a_default_may_be_missing() -> None:
    assert decode(Part, {"value": 1}) == Part(value=1.0)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"parts": 3}, "/parts: found 3; need a list"),
        ({"parts": [{"ends": None}]}, "/parts/0/value: found None; need this field"),
        ({"parts": [{"value": 1, "ends": [1]}]}, r"/parts/0/ends: found \[1\]; need 2 entries"),
        ({"parts": [{"value": "nan"}]}, "/parts/0/value: found 'nan'; need a number"),
        ({"parts": [{"value": True}]}, "/parts/0/value: found True; need a number"),
        ({"parts": [{"value": 1, "kind": "c"}]}, "/parts/0/kind: found 'c'; need one of a, b"),
        ({"pair": {"name": "n", "size": 2.0}}, "/pair/size: found 2.0; need a whole number"),
        ({"by_name": {"a/b": "x"}}, "/by_name/a~1b: found 'x'; need a number"),
        ({"parts": [{"value": -(10**400)}]}, "/parts/0/value: found -1.*…; need a number"),
        ({"rows": [["a"]]}, "/rows: .*need a list of numbers"),
        ({"rows": [["1.5"]]}, "/rows: .*need a list of numbers"),
        ({"rows": [[1, 2], [True, 3]]}, "/rows: .*need a list of numbers"),
        ({"rows": [[1], [2, 3]]}, "/rows: .*need a list of numbers"),
        ({"rows": 1.5}, "/rows: .*need a list of numbers"),
        ({"is_good": 1}, "/is_good: found 1; need true or false"),
        ({"other": 1}, "/: found 'other'; need one of the fields parts, pair, rows"),
    ],
)
def test_a_document_that_does_not_fit_says_where(change: dict[str, Any], told: str) -> None:
    with pytest.raises(Misfit, match=told):
        decode(Whole, {**DOCUMENT, **change})


def test_a_value_that_no_document_has_is_refused() -> None:
    with pytest.raises(TypeError, match="a document has no object"):
        encode({"a": object()})
