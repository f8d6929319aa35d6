"""What is computed between the end of a job's runs and its own end: bounds, and its summary."""

import logging
from collections.abc import Iterator
from functools import partial

from service.dispatch.background import DocumentMaker
from service.dispatch.job_parts import JobParts
from service.dispatch.run_cramer_rao import build_bounds_maker
from service.queue.leases import Lease
from service.storage.columns import Document
from service.storage.retry import retry_transient
from service.storage.sessions import Database
from service.storage.storage_errors import LeaseLost
from service.sweeps.job_summary import STORED_RUNS, store_summary

_log = logging.getLogger(__name__)


def build_end_maker(database: Database, lease: Lease, parts: JobParts) -> DocumentMaker | None:
    """Return the last steps of a job, which build its bounds document; None if it needs none.

    All runs of the job must have ended, and their results must be written. A large job also stores
    its summary, so that its first reader need not wait. A job without noise has no bounds document.
    """
    bounds = build_bounds_maker(database, parts)
    if parts.job.n_runs < STORED_RUNS:
        return bounds
    return partial(_iterate_steps, database, lease, bounds)


def _iterate_steps(
    database: Database, lease: Lease, bounds: DocumentMaker | None
) -> Iterator[Document | None]:
    document: Document | None = None
    for step in () if bounds is None else bounds():
        document = step
        yield None
    try:
        retry_transient(partial(store_summary, database, lease))
        database.update_statistics()
    except LeaseLost:
        pass  # the end of the job meets it too
    except Exception:  # noqa: BLE001 - the results must not be lost for a summary
        _log.exception("%s: its summary is not stored", lease.job_id)
    yield document
