"""Groups of the runs of jobs that have ended, kept in memory: their numbers change no more.

To group 100,000 runs takes seconds, and a page asks for the same again and again.
"""

from collections import OrderedDict
from collections.abc import Hashable, Sequence
from threading import Lock

from sqlalchemy.orm import Session

from service.storage.summaries import Group, GroupKey, Quantity
from service.storage.tables import Job
from service.unmade import all_groups

KEPT = 32
MOST_GROUPS = 2_000
"""Groups of more than so many are not kept."""


class _Kept:
    """What was asked for last."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._found: OrderedDict[Hashable, list[Group]] = OrderedDict()

    def get(self, key: Hashable) -> list[Group] | None:
        with self._lock:
            if key in self._found:
                self._found.move_to_end(key)
            return self._found.get(key)

    def put(self, key: Hashable, groups: list[Group]) -> None:
        with self._lock:
            self._found[key] = groups
            while len(self._found) > KEPT:
                self._found.popitem(last=False)


_kept = _Kept()


def groups_of(
    session: Session, job: Job, keys: Sequence[GroupKey], quantities: Sequence[Quantity], limit: int
) -> list[Group]:
    """`service.unmade.all_groups`, from memory where the job has ended since.

    A job that is resumed ends at another time; then its groups are made anew.
    """
    if not job.state.is_terminal:
        return all_groups(session, job, keys, quantities, limit)
    asked = (job.id, job.attempt, job.finished_at, tuple(keys), tuple(quantities), limit)
    found = _kept.get(asked)
    if found is None:
        found = all_groups(session, job, keys, quantities, limit)
        if len(found) <= MOST_GROUPS:
            _kept.put(asked, found)
    return found
