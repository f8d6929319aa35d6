"""Points of a trend from the runs of a batch: one for each label and quantity."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Any, Literal

from service.repositories.trend_rows import TrendRow
from service.trends.trend_schemas import BatchLabelOut, SpanOut
from sysid.residuals.onset_delay import OnsetDelay
from sysid.trends.trend import TrendEstimate, pool_estimates

DatasetChannels = Mapping[str, Mapping[str, Any]]
"""Channels of each dataset, by name."""

QuantityKind = Literal["parameter", "onset delay"]
DATA_FIELDS = ("/datasets", "/noise", "/channels", "/hold", "/skip", "/validation")
"""Fields of a job that determine which data a run uses."""


@dataclass(frozen=True, slots=True)
class BatchPoint:
    """Estimate of one quantity at one label, pooled over its runs; None without standard errors."""

    x: float
    runs: tuple[str, ...]
    status: str
    estimate: TrendEstimate | None
    value: float | None


@dataclass(frozen=True, slots=True)
class TrendQuantity:
    """A parameter or an onset delay over the labels.

    `between_runs` is the scatter of `sysid.trends.trend.pool_estimates`. `bounds` are the widest of
    its runs.
    """

    name: str
    unit: str
    kind: QuantityKind
    points: tuple[BatchPoint, ...]
    between_runs: float | None
    bounds: tuple[float, float] = (-inf, inf)


@dataclass(slots=True)
class _RunEstimate:
    run: str
    value: float | None
    stderr: float | None
    status: str


@dataclass(slots=True)
class _QuantityEstimates:
    """Estimates of one quantity by label. Its bounds are the widest of its runs."""

    unit: str
    kind: QuantityKind
    lower: float = inf
    upper: float = -inf
    entries: dict[float, list[_RunEstimate]] = field(default_factory=dict)

    def widen_bounds(self, lower: float, upper: float) -> None:
        """Include the bounds of a run; one that is not finite means that there is none."""
        self.lower = min(self.lower, lower if isfinite(lower) else -inf)
        self.upper = max(self.upper, upper if isfinite(upper) else inf)


def group_by_label(rows: Sequence[TrendRow], x: str) -> dict[float, list[TrendRow]]:
    """Group runs by label, ascending. Of runs on the same data only the best is used."""
    by_label: dict[float, dict[str, TrendRow]] = {}
    for row in rows:
        x_value = float(row.labels[x])
        data = repr(
            {path: value for path, value in row.cell.items() if path.startswith(DATA_FIELDS)}
        )
        best = by_label.setdefault(x_value, {}).setdefault(data, row)
        if _rank_rms(row) < _rank_rms(best):
            by_label[x_value][data] = row
    return {x_value: list(by_label[x_value].values()) for x_value in sorted(by_label)}


def _rank_rms(row: TrendRow) -> float:
    return float("inf") if row.best_rms is None else row.best_rms


def build_quantities(
    rows_by_label: Mapping[float, Sequence[TrendRow]], names: Sequence[str]
) -> list[TrendQuantity]:
    """Build the named parameters (by default all estimated ones), then the onset delays."""
    columns: dict[str, _QuantityEstimates] = {}
    for x, rows in rows_by_label.items():
        for row in rows:
            for estimate in row.parameters:
                if estimate.name in names or (not names and estimate.is_free):
                    entry = _RunEstimate(row.id, estimate.value, estimate.stderr, estimate.status)
                    column = _add_estimate(
                        columns, estimate.name, estimate.unit, "parameter", x, entry
                    )
                    column.widen_bounds(estimate.lower, estimate.upper)
            for name, unit, entry in _average_onsets(row.id, row.onset_delays):
                _add_estimate(columns, name, unit, "onset delay", x, entry).widen_bounds(0.0, inf)
    order = {name: number for number, name in enumerate(names)}
    named = sorted(columns.items(), key=lambda item: order.get(item[0], len(order)))
    return [_build_quantity(name, column) for name, column in named]


def _add_estimate(
    columns: dict[str, _QuantityEstimates],
    name: str,
    unit: str,
    kind: QuantityKind,
    x: float,
    entry: _RunEstimate,
) -> _QuantityEstimates:
    column = columns.setdefault(name, _QuantityEstimates(unit, kind))
    column.entries.setdefault(x, []).append(entry)
    return column


def read_onset_estimates(onsets: Sequence[OnsetDelay]) -> dict[str, TrendEstimate]:
    """Read the onset delays of a result that have standard errors, by their names in a trend."""
    estimates = {name: _to_estimate(entry) for name, _, entry in _average_onsets("", onsets)}
    return {name: estimate for name, estimate in estimates.items() if estimate is not None}


def _average_onsets(run: str, onsets: Sequence[OnsetDelay]) -> list[tuple[str, str, _RunEstimate]]:
    """Average the onset delays of a run over its experiments, with standard errors."""
    pairs: dict[tuple[str, str], list[OnsetDelay]] = {}
    for onset in onsets:
        pairs.setdefault((onset.input, onset.output), []).append(onset)
    averages = []
    for (first, then), experiments in pairs.items():
        delays = [onset.delay for onset in experiments if onset.delay is not None]
        measured = [onset for onset in experiments if onset.delay is not None]
        name = "onset delay" if len(pairs) == 1 else f"onset delay {first} → {then}"
        if not measured:
            averages.append(
                (name, experiments[0].unit, _RunEstimate(run, None, None, "not measured"))
            )
            continue
        n = len(measured)
        value = sum(delays) / n
        errors = [_compute_onset_error(experiment) for experiment in measured]
        error = None if None in errors else sum(e**2 for e in errors if e is not None) ** 0.5 / n
        averages.append((name, measured[0].unit, _RunEstimate(run, value, error, "measured")))
    return averages


def _compute_onset_error(onset: OnsetDelay) -> float | None:
    """Compute the standard error of a median of n events that scatter by `spread`."""
    if not onset.spread or onset.events < 2:
        return None
    median_over_mean = 1.2533  # √(π/2), of normally distributed events
    return float(median_over_mean * onset.spread / onset.events**0.5)


def _build_quantity(name: str, column: _QuantityEstimates) -> TrendQuantity:
    groups = {x: [_to_estimate(entry) for entry in many] for x, many in column.entries.items()}
    estimates_by_x = {
        x: [entry for entry in many if entry is not None] for x, many in groups.items()
    }
    used = [x for x, many in estimates_by_x.items() if many]
    means, ratio = pool_estimates([estimates_by_x[x] for x in used])
    estimates = dict(zip(used, means, strict=True))
    has_repeats = any(len(estimates_by_x[x]) > 1 for x in used)
    points = tuple(
        _build_point(x, column.entries[x], estimates.get(x)) for x in sorted(column.entries)
    )
    bounds = column.lower, column.upper
    return TrendQuantity(
        name, column.unit, column.kind, points, ratio if has_repeats else None, bounds
    )


def _to_estimate(entry: _RunEstimate) -> TrendEstimate | None:
    if entry.value is None or not entry.stderr or not entry.stderr > 0:
        return None
    return TrendEstimate(float(entry.value), float(entry.stderr))


def _build_point(
    x: float, entries: Sequence[_RunEstimate], estimate: TrendEstimate | None
) -> BatchPoint:
    states = list(dict.fromkeys(entry.status for entry in entries))
    values = [entry.value for entry in entries if entry.value is not None]
    value = sum(values) / len(values) if values else None
    return BatchPoint(
        x,
        tuple(entry.run for entry in entries),
        ", ".join(states),
        estimate,
        value if estimate is None else estimate.value,
    )


def to_label_out(
    x: float,
    rows: Sequence[TrendRow],
    datasets: Mapping[str, Sequence[str]],
    dataset_channels: DatasetChannels,
    channels: Mapping[str, str],
) -> BatchLabelOut:
    """Describe all runs of a label; `datasets` of each run, `channels` of the model's signals."""
    spans: dict[str, SpanOut] = {}
    for row in rows:
        for metrics in row.agreement.estimation:
            low, high = metrics.span
            if not (isfinite(low) and isfinite(high)):
                continue
            channel = channels.get(metrics.output, metrics.output)
            unit = _find_unit(dataset_channels, datasets.get(row.id, ()), channel, metrics.unit)
            before = spans.get(metrics.output)
            if before is not None:
                low, high = min(low, before.lower), max(high, before.upper)
            spans[metrics.output] = SpanOut(
                output=metrics.output, channel=channel, unit=unit, lower=low, upper=high
            )
    return BatchLabelOut(
        x=x,
        runs=[row.id for row in rows],
        evaluations=sum(row.evaluations for row in rows),
        spans=list(spans.values()),
        flags=list(
            dict.fromkeys(
                one.brief for row in rows for one in row.findings if one.severity != "note"
            )
        ),
        warnings=list(dict.fromkeys(text for row in rows for text in row.warnings)),
    )


def _find_unit(
    dataset_channels: DatasetChannels, datasets: Sequence[str], channel: str, otherwise: str
) -> str:
    units = [
        dataset_channels[dataset][channel]["unit"]
        for dataset in datasets
        if channel in dataset_channels.get(dataset, {})
    ]
    return next((unit for unit in units if unit != "1"), otherwise)
