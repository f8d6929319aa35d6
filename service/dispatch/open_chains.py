"""Which runs of a sweep's chains may begin: of every chain one after another, of many chains."""

from collections import deque
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field

from service.chains import Chain

MOST_OPEN = 1_000
"""Chains under way at a time: more cores than that hardly work on one job."""


@dataclass(slots=True)
class _Open:
    """A chain under way."""

    numbers: range
    at: int = 0  # position of its next run
    flying: set[int] = field(default_factory=set)
    values: Mapping[str, float] | None = None  # of the last run that succeeded
    last: int = -1  # the number of that run
    has_gap: bool = False  # runs were passed over that an earlier attempt ended


class OpenChains:
    """The chains of one job, opened one after another as runs are wanted.

    Of a chain it knows its place, the runs that are out and the last values; of no chain the runs.

    Parameters
    ----------
    chain : Chain
        What a chain of this sweep is.
    n_runs : int
        Runs of the job.
    waits : callable
        Whether the run of a number waits until those before it in its chain are over.
    ended : container of int
        Numbers of runs that an earlier attempt has ended: they are not given.
    """

    def __init__(
        self,
        chain: Chain,
        n_runs: int,
        waits: Callable[[int], bool],
        ended: Container[int] = frozenset(),
    ) -> None:
        self._chain, self._waits, self._ended = chain, waits, ended
        self._n_chains, self._opened = n_runs // chain.length, 0
        self._open: dict[int, _Open] = {}
        self._n_unfinished = 0  # open chains of which not every run was given
        self._free: deque[int] = deque()  # chains whose next run may begin

    @property
    def is_empty(self) -> bool:
        """Whether every run was given."""
        return self._opened == self._n_chains and self._n_unfinished == 0

    @property
    def has_free(self) -> bool:
        """Whether a run may begin: one that `ready` did not give has not been made."""
        return bool(self._free)

    def ready(self, limit: int, made: int) -> list[int]:
        """At most `limit` numbers below `made` of runs that may begin; each is given once."""
        self._open_more(limit)
        found: list[int] = []
        for _ in range(len(self._free)):
            key = self._free.popleft()
            one = self._open[key]
            if len(found) < limit and one.numbers[one.at] < made:
                found.append(self._taken(one))
            if self._is_free(one):
                self._free.append(key)
        return found

    def over(self, number: int, values: Mapping[str, float] | None = None) -> None:
        """A run has ended; `values` are its estimates if it succeeded. To be told again is fine."""
        key = self._chain.of(number)
        one = self._open.get(key)
        if one is None or number not in one.flying:
            return
        was_free = self._is_free(one)
        one.flying.discard(number)
        if values is not None and number > one.last:
            one.values, one.last = values, number
        if one.at == len(one.numbers) and not one.flying:
            del self._open[key]
        elif self._is_free(one) and not was_free:
            self._free.append(key)

    def before(
        self, number: int, stored: Callable[[range], tuple[int, Mapping[str, float]] | None]
    ) -> Mapping[str, float] | None:
        """Estimates of the last run before that one in its chain that succeeded, if one did.

        `stored` finds it, with its number, among those that an earlier attempt has ended.
        """
        one = self._open[self._chain.of(number)]
        if one.has_gap:
            found = stored(one.numbers[: one.numbers.index(number)])
            if found is not None and found[0] > one.last:
                one.last, one.values = found
            one.has_gap = False
        return one.values

    def _open_more(self, wanted: int) -> None:
        room = MOST_OPEN - len(self._open)
        while len(self._free) < wanted and room > 0 and self._opened < self._n_chains:
            key, self._opened = self._opened, self._opened + 1
            one = _Open(self._chain.numbers(key))
            self._pass_over(one)
            if one.at < len(one.numbers):
                self._open[key] = one
                self._n_unfinished += 1
                self._free.append(key)
                room -= 1

    def _taken(self, one: _Open) -> int:
        number = one.numbers[one.at]
        one.flying.add(number)
        one.at += 1
        self._pass_over(one)
        self._n_unfinished -= one.at == len(one.numbers)
        return number

    def _pass_over(self, one: _Open) -> None:
        while one.at < len(one.numbers) and one.numbers[one.at] in self._ended:
            one.at, one.has_gap = one.at + 1, True

    def _is_free(self, one: _Open) -> bool:
        if one.at == len(one.numbers):
            return False
        return not one.flying or not self._waits(one.numbers[one.at])
