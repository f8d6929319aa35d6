"""Use case: all runs of a job as one CSV table, written as it is read."""

import csv
import io
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from service.storage.jobs import JobRepository
from service.storage.runs import RunRepository
from service.storage.sessions import Database
from service.storage.tables import Run

AT_ONCE = 500
FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""What a formula begins with, in one spreadsheet or another."""
_NUMBER = re.compile(r"[+-]?[0-9]*\.?[0-9]+([eE][+-]?[0-9]+)?")
COLUMNS = ("number", "id", "state", "valid", "best_rms", "fit_estimation", "fit_validation",
           "evaluations", "generations", "seconds", "error")  # fmt: skip


def table(database: Database, job_id: str) -> Iterator[str]:
    """Lines of the table, some hundred runs at a time, each part read in a session of its own.

    One row a run in the order of the sweep: its columns, the values of the axes by their paths,
    its labels, and estimate and standard error of every parameter that a run has. A text that a
    spreadsheet would take for a formula begins with an apostrophe, which it hides.

    Raises
    ------
    NotFound
        If there is no such job; at the call, before the first line.
    """
    with database.read() as session:
        spec = JobRepository(session).get(job_id).spec
        runs = RunRepository(session)
        best = runs.page(job_id, limit=1, order="best_rms").items
        names = [*((best[0].estimates or {}) if best else ()), *runs.estimated(job_id)]
    parameters = list(dict.fromkeys(names))
    axes = (spec.get("sweep") or {}).get("axes") or []
    paths = [axis["path"] for axis in axes]
    labels = list(dict.fromkeys(
        name for axis in axes for one in axis.get("labels") or [] for name in one
    ))  # fmt: skip
    return _parts(database, job_id, paths, labels, parameters)


def _parts(
    database: Database, job_id: str, paths: Sequence[str], labels: Sequence[str],
    parameters: Sequence[str],
) -> Iterator[str]:  # fmt: skip
    errors = [f"stderr of {name}" for name in parameters]
    yield _lines([[*COLUMNS, *paths, *labels, *parameters, *errors]])
    cursor: str | None = None
    while True:
        with database.read() as session:
            page = RunRepository(session).page(job_id, cursor=cursor, limit=AT_ONCE)
            rows = [_row(run, paths, labels, parameters) for run in page.items]
        yield _lines(rows)
        cursor = page.next
        if cursor is None:
            return


def _row(
    run: Run, paths: Sequence[str], labels: Sequence[str], parameters: Sequence[str]
) -> list[Any]:
    known = run.estimates or {}
    found = [known.get(name) or {} for name in parameters]
    return [
        run.number, run.id, run.state.value, *(getattr(run, name) for name in COLUMNS[3:]),
        *(_plain(run.cell.get(path)) for path in paths),
        *(_plain(run.labels.get(name)) for name in labels),
        *(one.get("value") for one in found), *(one.get("stderr") for one in found),
    ]  # fmt: skip


def _plain(value: object) -> object:
    return json.dumps(value) if isinstance(value, dict | list) else value


def _lines(rows: Iterable[Sequence[Any]]) -> str:
    sink = io.StringIO()
    csv.writer(sink, lineterminator="\n").writerows(map(_inert, row) for row in rows)
    return sink.getvalue()


def _inert(value: object) -> object:
    """A value that no spreadsheet carries out, and no reader takes for two lines."""
    if not isinstance(value, str):
        return value
    is_formula = value.startswith(FORMULA) and not _NUMBER.fullmatch(value)
    return ("'" if is_formula else "") + value.replace("\r", " ")
