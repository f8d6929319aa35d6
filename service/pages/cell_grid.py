"""Build the cells of a sweep as a grid by its axes; pages show it instead of thousands of runs."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode

from sqlalchemy.orm import Session

from service.core.bodies.job_fields import SIGMA_PATH
from service.core.label_text import format_count, format_value
from service.core.states import JobState
from service.repositories.summary_rows import SummaryQuantity
from service.storage.columns import to_json
from service.storage.tables import Job
from service.sweeps.groups import QUANTILES_PER_MILLE, RunGroup
from service.sweeps.job_summary import list_default_keys, load_summary
from sysid.core.text import format_number

MAX_LISTED_RUNS = 50
"""Most runs that a page lists; for more it shows the grid."""
MAX_COLUMNS = 12
MEDIAN_INDEX = QUANTILES_PER_MILLE.index(500)

CellKey = tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class CellView:
    """The runs of one cell of the grid."""

    href: str
    text: str
    count_text: str
    state: str
    share: float
    is_chosen: bool


@dataclass(frozen=True, slots=True)
class GridView:
    """Grid of cells: rows by all axes but the last, columns by the last; a missing cell is None."""

    quantity: str
    row_names: Sequence[str]
    column_name: str
    columns: Sequence[str]
    rows: Sequence[tuple[Sequence[str], Sequence[CellView | None]]]
    is_cut: bool


def build_cell_grid(session: Session, job: Job, chosen: Mapping[str, Any]) -> GridView | None:
    """Build the grid of a job; None if it has few runs, or they differ only in seeds."""
    keys = [key.name for key in list_default_keys(job.spec)]
    if job.n_runs <= MAX_LISTED_RUNS or not keys:
        return None
    error = SummaryQuantity("rms_noise_free" if SIGMA_PATH in keys else "rms")
    summary = load_summary(session, job)
    groups = summary.groups
    split = len(keys) - 1 if _fits_as_columns([group.key[-1] for group in groups]) else len(keys)
    columns = _distinct_keys([group.key[split:] for group in groups])
    shares = _rank_medians(groups, error)
    cells = {
        to_json(group.key): _to_cell_view(group, keys, error, share, chosen)
        for group, share in zip(groups, shares, strict=True)
    }
    rows = [
        (
            [format_value(value) for value in row],
            [cells.get(to_json((*row, *column))) for column in columns],
        )
        for row in _distinct_keys([group.key[:split] for group in groups])
    ]
    return GridView(
        quantity="RMS error against the record without noise" if SIGMA_PATH in keys else "RMS",
        row_names=[_axis_label(path) for path in keys[:split]],
        column_name=_axis_label(keys[-1]) if split < len(keys) else "",
        columns=[format_value(column[0]) if column else "all" for column in columns],
        rows=rows,
        is_cut=summary.is_cut,
    )


def cell_query(cell: Mapping[str, Any]) -> str:
    """Build the query that selects the runs of a cell."""
    pairs = [("cell", f"{path}={json.dumps(value)}") for path, value in cell.items()]
    return f"?{urlencode(pairs)}" if pairs else ""


def _fits_as_columns(values: Sequence[Any]) -> bool:
    return len({to_json(value) for value in values}) <= MAX_COLUMNS


def _distinct_keys(keys: Sequence[CellKey]) -> list[CellKey]:
    return list({to_json(key): key for key in keys}.values())


def _to_cell_view(
    group: RunGroup,
    keys: Sequence[str],
    error: SummaryQuantity,
    share: float,
    chosen: Mapping[str, Any],
) -> CellView:
    cell = dict(zip(keys, group.key, strict=True))
    quantiles = group.quantiles.get(error)
    total = sum(group.states.values())
    over = sum(n for state, n in group.states.items() if state.is_terminal)
    failed = group.states[JobState.FAILED]
    count = format_count(total) if over == total else f"{over} of {total}"
    return CellView(
        href=cell_query(cell),
        text="–" if quantiles is None else format_number(quantiles[MEDIAN_INDEX], 3),
        count_text=f"{count} runs{f', {failed} failed' if failed else ''}",
        state=_group_state(group, over == total),
        share=share,
        is_chosen=bool(chosen) and cell == dict(chosen),
    )


def _group_state(group: RunGroup, is_over: bool) -> str:
    if not is_over:
        return "running" if group.states[JobState.RUNNING] or _has_ended_runs(group) else "queued"
    for state in (JobState.FAILED, JobState.CANCELLED):
        if group.states[state]:
            return state.value
    return JobState.SUCCEEDED.value


def _has_ended_runs(group: RunGroup) -> bool:
    return any(n for state, n in group.states.items() if state.is_terminal)


def _rank_medians(groups: Sequence[RunGroup], error: SummaryQuantity) -> list[float]:
    """Rank the medians of the cells, from 0 to 1, for their colours."""
    medians = [
        group.quantiles[error][MEDIAN_INDEX] if error in group.quantiles else None
        for group in groups
    ]
    ranked = sorted({value for value in medians if value is not None})
    rank = {value: number / max(len(ranked) - 1, 1) for number, value in enumerate(ranked)}
    return [0.0 if value is None else rank[value] for value in medians]


def _axis_label(path: str) -> str:
    return "σ" if path == SIGMA_PATH else path.rsplit("/", 1)[-1]
