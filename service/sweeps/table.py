"""Use case: stream all runs of a job as one CSV table."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from service.core.label_text import write_csv
from service.datasets.rms_unit import find_rms_unit
from service.repositories.job_rows import JobRepository
from service.repositories.run_rows import RunRepository
from service.storage.sessions import Database
from service.storage.tables import Run
from service.sweeps.job_summary import load_summary
from sysid.core.text import append_unit, find_shown_error

RUNS_PER_PART = 500
COLUMNS = (
    "number",
    "id",
    "state",
    "valid",
    "best_rms",
    "fit_estimation",
    "fit_validation",
    "evaluations",
    "generations",
    "seconds",
    "error",
)
COLUMN_UNITS = {"fit_estimation": "%", "fit_validation": "%"}
"""Units that neither the column's name nor the job gives."""


@dataclass(frozen=True, slots=True)
class _TableLayout:
    """Columns of a job's table; `parameters` are names with their units."""

    paths: tuple[str, ...]
    labels: tuple[str, ...]
    parameters: tuple[tuple[str, str], ...]

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The names of the parameters, each once."""
        return tuple(dict.fromkeys(name for name, _ in self.parameters))


def stream_table(database: Database, job_id: str) -> Iterator[str]:
    """Stream the lines of the table in parts of some hundred runs, each read in its own session.

    Each run is one row, in the order of the sweep. Its columns are fixed fields, axis values by
    path, labels, and estimate, standard error and status of every parameter. A heading has the unit
    after the name, ``L [s]``, but none for a dimensionless quantity.

    A parameter that has several units, with several models, has columns for each. A text that a
    spreadsheet would take for a formula gets a leading apostrophe, which the spreadsheet hides.

    Raises
    ------
    NotFound
        If there is no such job; at the call, before the first line.
    """
    with database.read_session() as session:
        job = JobRepository(session).get(job_id)
        spec = job.spec
        runs = RunRepository(session)
        best = runs.list_page(job_id, limit=1, order="best_rms").items
        others = [(one.name, one.unit) for one in load_summary(session, job).parameters]
        first = [
            (estimate["name"], estimate["unit"]) for run in best for estimate in _get_estimates(run)
        ]
        parameters = tuple(dict.fromkeys([*first, *others]))
        units = {**COLUMN_UNITS, "best_rms": find_rms_unit(session, spec)}
    axes = spec["sweep"]["axes"]
    labels = dict.fromkeys(
        name for axis in axes for labels in axis["labels"] or [] for name in labels
    )
    layout = _TableLayout(tuple(axis["path"] for axis in axes), tuple(labels), parameters)
    return _stream_parts(database, job_id, layout, units)


def _stream_parts(
    database: Database, job_id: str, layout: _TableLayout, units: Mapping[str, str]
) -> Iterator[str]:
    fixed = [append_unit(name, units.get(name, "1")) for name in COLUMNS]
    estimates = [
        append_unit(what + name, unit)
        for name, unit in layout.parameters
        for what in ("", "stderr of ")
    ]
    statuses = [f"status of {name}" for name in layout.parameter_names]
    yield write_csv([[*fixed, *layout.paths, *layout.labels, *estimates, *statuses]])
    cursor: str | None = None
    while True:
        with database.read_session() as session:
            page = RunRepository(session).list_page(job_id, cursor=cursor, limit=RUNS_PER_PART)
            rows = [_build_row(run, layout) for run in page.items]
        yield write_csv(rows)
        cursor = page.next
        if cursor is None:
            return


def _build_row(run: Run, layout: _TableLayout) -> list[Any]:
    estimates = {(estimate["name"], estimate["unit"]): estimate for estimate in _get_estimates(run)}
    statuses = {estimate["name"]: estimate["status"] for estimate in _get_estimates(run)}
    cells = [estimates.get(key) or {} for key in layout.parameters]
    return [
        run.number,
        run.id,
        run.state.value,
        *(getattr(run, name) for name in COLUMNS[3:]),
        *(_to_csv_value(run.cell.get(path)) for path in layout.paths),
        *(_to_csv_value(run.labels.get(name)) for name in layout.labels),
        *(number for estimate in cells for number in _list_numbers(estimate)),
        *(statuses.get(name) for name in layout.parameter_names),
    ]


def _list_numbers(estimate: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """List value and standard error of an estimate; nothing if the run has none."""
    if not estimate:
        return None, None
    return estimate["value"], find_shown_error(estimate["stderr"], estimate["status"])


def _get_estimates(run: Run) -> list[dict[str, Any]]:
    """The estimates of a run's result."""
    estimates: list[dict[str, Any]] = (run.result or {}).get("parameters", [])
    return estimates


def _to_csv_value(value: object) -> object:
    return json.dumps(value) if isinstance(value, dict | list) else value
