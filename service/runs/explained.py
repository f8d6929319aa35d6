"""Use case of a result that is looked at: the explanations of its residuals are there.

Runs of a sweep are concluded without them, so that a sweep takes no longer. They are computed from
the stored estimate when one run is opened, and remembered by this process.
"""

from functools import partial

from sqlalchemy.orm import Session

from service.core.computed import ComputedValues
from service.core.errors import BudgetExceeded, InvalidRequest, NotFound, ServiceBusy
from service.jobs.stored_run import StoredRun
from service.queue.daily_limit import compute_on_request
from service.runs.profiles import measure_work
from service.storage.objects import ObjectStore
from service.storage.sessions import find_database, release_connection
from service.storage.storage_errors import ObjectMissing, RowNotFound
from sysid.core.errors import SysidError
from sysid.results.result import Result

MAX_WORK = 4_000_000  # of `measure_work`: about a second
_CACHE_SIZE = 64  # runs: a page, its document and its report ask for the same
_explained = ComputedValues(_CACHE_SIZE)
_HINDRANCES = (
    BudgetExceeded,
    InvalidRequest,
    NotFound,
    ObjectMissing,
    RowNotFound,
    ServiceBusy,
    SysidError,
)


def load_explained_result(session: Session, store: ObjectStore, stored: StoredRun) -> Result | None:
    """Load the result of a run with explanations of its residuals; None until there is one.

    It stays as it was stored where they cannot be computed: the records are gone, the work is too
    much, the server is busy, or the project has used up its evaluations of a day.
    """
    result = stored.result
    if result is None or result.explained or not result.parameters:
        return result
    try:
        return _explained.get(
            stored.run.id,
            partial(_explain, session, store, stored, result),
            is_final=True,
            before_wait=partial(release_connection, session),
        )
    except _HINDRANCES:
        return result


def _explain(session: Session, store: ObjectStore, stored: StoredRun, result: Result) -> Result:
    # This imports the compiler.
    from sysid.judgement.afterwards import explain_afterwards
    from sysid.judgement.residual_context import Simulations

    problem = stored.problem(session, store)
    release_connection(session)
    if measure_work(problem) > MAX_WORK:
        return result
    with compute_on_request(find_database(session)) as computation:
        simulations = Simulations()
        explained = explain_afterwards(problem, result, simulations)
        computation.evaluations = simulations.spent
        return explained
