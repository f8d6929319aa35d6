"""Use case of a run's file: all of one identification as MCAP, written when it is asked for.

Stored objects have the fitted outputs only, and may be shared by several runs. The file of a run
adds its inputs, and what it was made from. It follows from stored values, so its bytes stay the
same while they do. Names that users can change are not in it.
"""

import io
from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import partial
from typing import Any

from sqlalchemy.orm import Session

from service.core.bodies.json_text import write_json
from service.core.computed import ComputedValues
from service.core.errors import InvalidRequest, NotFound
from service.core.states import JobState
from service.formats.mcap.mcap_files import FittedInput, list_fitted_inputs, write_fitted_outputs
from service.jobs.stored_run import StoredRun, load_run
from service.runs.fitted import load_fitted_signals
from service.storage.objects import ObjectStore
from service.storage.sessions import release_connection
from service.storage.storage_errors import ObjectMissing, RowNotFound
from service.storage.tables import Dataset
from sysid.core.errors import SysidError

CACHE_SIZE = 4
"""Files that stay in memory: a viewer reads one by many ranges."""
_files = ComputedValues(CACHE_SIZE)


def load_run_file(session: Session, store: ObjectStore, run_id: str) -> bytes:
    """Write the file of a run, or take it from memory.

    Raises
    ------
    NotFound
        If the run has not succeeded.
    Conflict
        If its signals are not stored and cannot be computed again.
    """
    stored = load_run(session, run_id)
    if stored.run.state is not JobState.SUCCEEDED:
        raise NotFound("signals file of run", run_id, f"; the run is {stored.run.state.value}")
    return _files.get(
        run_id,
        partial(_write_run_file, session, store, stored),
        is_final=True,
        before_wait=partial(release_connection, session),
    )


def _write_run_file(session: Session, store: ObjectStore, stored: StoredRun) -> bytes:
    fits = load_fitted_signals(session, store, stored)
    assert fits is not None  # of a run that succeeded
    datasets = _read_datasets(session, stored)
    target = io.BytesIO()
    write_fitted_outputs(
        fits,
        target,
        inputs=_read_inputs(session, store, stored),
        run=_describe_run(stored, datasets),
        started_at=_find_clock(datasets),
    )
    return target.getvalue()


def _read_inputs(session: Session, store: ObjectStore, stored: StoredRun) -> Sequence[FittedInput]:
    """Read the inputs of all experiments; none once a dataset was deleted."""
    try:
        records = stored.read_fit_records(session, store)
    except (SysidError, NotFound, InvalidRequest, RowNotFound, ObjectMissing):
        return ()
    inputs = list_fitted_inputs("estimation", records.estimation)
    if records.validation is not None:
        inputs += list_fitted_inputs("validation", records.validation)
    return inputs


def _read_datasets(session: Session, stored: StoredRun) -> dict[str, Dataset]:
    """Read the rows of the datasets, those of deleted ones too."""
    names = [*stored.body["datasets"], *((stored.body["validation"] or {}).get("datasets") or ())]
    rows = (session.get(Dataset, name) for name in dict.fromkeys(names))
    return {row.id: row for row in rows if row is not None}


def _describe_run(stored: StoredRun, datasets: Mapping[str, Dataset]) -> dict[str, str]:
    """Build the content of the metadata record: texts, and JSON where it has parts."""
    run, job, result = stored.run, stored.job, stored.document
    fields: dict[str, Any] = {
        "run": run.id,
        "job": job.id,
        "number": run.number,
        "cell": run.cell,
        "labels": run.labels,
        "model": stored.model.document,
        "parameters": [
            {name: entry[name] for name in ("name", "value", "unit", "stderr", "status")}
            for entry in result.get("parameters", ())
        ],
        "datasets": [
            {
                "id": row.id,
                "sha256": row.sha256,
                "source": (row.details.get("source") or {}).get("sha256"),
                "started_at": row.details["started_at"],
            }
            for row in datasets.values()
        ],
        "channels": stored.body["channels"],
        "rms": run.best_rms,
        "seed": run.seed,
        "spec_hash": run.spec_hash,
        "version": result["version"],
        "fingerprint": result["fingerprint"],
        "reused_from": result.get("reused_from"),
    }
    return {
        name: value if isinstance(value, str) else write_json(value)
        for name, value in fields.items()
        if value is not None
    }


def _find_clock(datasets: Mapping[str, Dataset]) -> datetime | None:
    """Find time 0 s on the clock that recorded, if all experiments have the times of one dataset.

    Segments begin at times of their own.
    """
    rows = list(datasets.values())
    if len(rows) != 1 or rows[0].details["segments"]:
        return None
    start = rows[0].details["started_at"]
    return None if start is None else datetime.fromisoformat(start)
