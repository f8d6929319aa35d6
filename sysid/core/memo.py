"""Cache keyed by the identity of an argument whose comparison would be slow."""

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
    """Cache a function by the identity of its first argument and the values of the others.

    The cache keeps the first argument alive, so that no other object can get its identity.
    """
    entries: dict[tuple[object, ...], tuple[_Subject, _Value]] = {}

    @wraps(function)
    def look_up(subject: _Subject, /, *others: _Others.args, **named: _Others.kwargs) -> _Value:
        key = (id(subject), *others, *sorted(named.items()))
        entry = entries.get(key)
        if entry is None:
            entry = (subject, function(subject, *others, **named))
            if len(entries) >= _MAX_KEPT:
                entries.clear()
            entries[key] = entry
        return entry[1]

    return look_up
