"""What can be told of a body of which some fields cannot be read: the faults of all the others."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from copy import deepcopy
from itertools import accumulate
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from service.core.errors import FieldError
from sysid.core.errors import split_pointer

Whole = TypeVar("Whole", bound=BaseModel)

# What stands for a field that has to be there; nothing is told of it.
STAND_INS: Mapping[str, Any] = {
    "datasets": [""], "batch": [{"x": 0.0, "datasets": [""]}], "label": "x", "sigma": [0.0],
}  # fmt: skip


def beside(
    kind: type[Whole],
    body: Any,
    faults: Sequence[FieldError],
    meant: Callable[[Whole, Set[str]], Iterable[FieldError]],
) -> list[FieldError]:
    """Faults of what a body means, where other fields of it have faults that keep it from its type.

    Parameters
    ----------
    kind : type
        The body's wire type.
    faults : sequence of FieldError
        Of the fields that cannot be read; nothing more is told of these. Those of query values and
        headers leave the body as it is.
    meant : callable
        Faults of a body of that type that do not depend on the fields named besides, which are
        those that were left out, wholly or in part.
    """
    left_out = [one.pointer for one in faults if one.pointer.startswith("/")]
    if not isinstance(body, dict) or any(not one.pointer for one in faults):
        return []
    highest = ["/".join(one.split("/")[:2]) for one in left_out]  # where what holds it is no more
    found = _whole(kind, _without(body, left_out)) or _whole(kind, _without(body, highest))
    if found is None:
        return []
    whole, stand_ins = found
    silent = {*left_out, *(f"/{name}" for name in stand_ins)}
    above = {place for one in silent for place in _places_down_to(one)}
    return [
        one for one in meant(whole, _unread(kind, body, silent))
        if one.pointer not in above and silent.isdisjoint(_places_down_to(one.pointer))
    ]  # fmt: skip


def _unread(kind: type[BaseModel], body: dict[str, Any], silent: Iterable[str]) -> frozenset[str]:
    """The fields that are not known, of which something was left out or could not be read.

    A name that no field has may be meant for any of those that are not given.
    """
    known = kind.model_fields.keys()
    tops = {one.split("/")[1] for one in silent}
    return frozenset(tops & known if tops <= known else tops & known | known - body.keys())


def _without(body: dict[str, Any], pointers: Iterable[str]) -> dict[str, Any]:
    """The body without the fields at these places; a list goes with any of its entries."""
    rest = deepcopy(body)
    for pointer in pointers:
        here: Any = rest
        last: tuple[dict[str, Any], str] | None = None
        for part in split_pointer(pointer):
            if not isinstance(here, dict):
                break
            if part not in here:  # a field that is missing: what should hold it goes
                break
            last, here = (here, part), here[part]
        if last is not None:
            last[0].pop(last[1], None)
    return rest


def _whole(kind: type[Whole], rest: dict[str, Any]) -> tuple[Whole, list[str]] | None:
    """The body as its type, and the fields that something stands for."""
    absent = [name for name in STAND_INS if name in kind.model_fields and name not in rest]
    needed = [name for name in absent if kind.model_fields[name].is_required()]
    for names in (needed, absent):
        try:
            whole = kind.model_validate(rest | {name: STAND_INS[name] for name in names})
            return whole, names
        except ValidationError:
            continue
    return None


def _places_down_to(pointer: str) -> Iterator[str]:
    """The places that hold a place, and the place itself."""
    return accumulate(pointer.split("/"), "{}/{}".format)
