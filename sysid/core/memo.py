"""Values kept by the identity of what they are of, where its equality would be a long walk."""

from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar

_MAX_KEPT = 64
_Subject = TypeVar("_Subject")
_Others = ParamSpec("_Others")
_Value = TypeVar("_Value")


def cache_by_identity(
    function: Callable[Concatenate[_Subject, _Others], _Value],
) -> Callable[Concatenate[_Subject, _Others], _Value]:
    """The function, its last values kept by its first argument itself and by the others' value.

    A subject that is kept cannot be freed, so no other one gets its identity meanwhile.
    """
    known: dict[tuple[object, ...], tuple[_Subject, _Value]] = {}

    @wraps(function)
    def cached(subject: _Subject, /, *others: _Others.args, **named: _Others.kwargs) -> _Value:
        key = (id(subject), *others, *sorted(named.items()))
        entry = known.get(key)
        if entry is None:
            entry = (subject, function(subject, *others, **named))
            if len(known) >= _MAX_KEPT:
                known.clear()
            known[key] = entry
        return entry[1]

    return cached
