"""Comparison of a batch with a reference run and with the trend of that run's job."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from typing import Any, Literal

import numpy as np

from service.storage.tables import Run
from service.trends.points import TrendQuantity, read_onset_estimates
from service.trends.trend_schemas import DriftOut
from sysid.core.value_documents import decode
from sysid.residuals.onset_delay import OnsetDelay
from sysid.trends.trend import Drift, Trend, TrendEstimate, compute_drift, compute_law_drifts


@dataclass(frozen=True, slots=True)
class BatchReference:
    """Reference run of a batch, and the trend of its job, quantity by quantity.

    Attributes
    ----------
    x : float or None
        Its value on the axis of the batch.
    why_no_trend : str
        Why its job has no trend to compare with; empty if it has one.
    names : tuple of str
        Names under which it was accepted.
    """

    run: Run
    x: float | None
    trends: Mapping[str, tuple[Trend, TrendQuantity]] = field(default_factory=dict)
    why_no_trend: str = ""
    names: tuple[str, ...] = ()

    def explain_gaps(self, x: str, labels: Mapping[float, Any]) -> str:
        """Explain why fewer comparisons are made than expected; empty if all are."""
        if self.trends:
            return ""
        if self.x is not None and self.x in labels:
            return f"{self.why_no_trend}, so the batch is compared with the reference run only"
        where = (
            f"the reference run has no label {x!r}"
            if self.x is None
            else f"the reference run is at {x} = {self.x:g}, where this batch has no run"
        )
        return f"{where}, and {self.why_no_trend}. The batch is compared with nothing"


def compare_with_reference(
    quantity: TrendQuantity, reference: BatchReference | None, comparisons: int
) -> dict[float, list[DriftOut]]:
    """Compute the drifts of each point, by its x."""
    drifts: dict[float, list[DriftOut]] = {}
    if reference is None:
        return drifts
    new = [(point.x, point.estimate) for point in quantity.points if point.estimate is not None]
    old = _read_estimate(reference.run, quantity.name)
    for x, estimate in new:
        if x == reference.x and old is not None:
            drifts[x] = [_to_drift_out("run", old.value, compute_drift(estimate, old, comparisons))]
    fitted, reference_quantity = reference.trends.get(quantity.name, (None, None))
    if fitted is None or reference_quantity is None or fitted.best_law is None:
        return drifts
    old_points = [
        (p.x, p.estimate.stderr) for p in reference_quantity.points if p.estimate is not None
    ]
    used = np.delete(np.array(old_points), fitted.excluded, axis=0)
    reference_x, errors = used[:, 0], used[:, 1]
    new_x = np.array([x for x, _ in new])
    moved = compute_law_drifts(
        [estimate for _, estimate in new], fitted.best_law, reference_x, errors, new_x, comparisons
    )
    for (x, estimate), drift in zip(new, moved, strict=True):
        if isfinite(drift.difference):
            expected = estimate.value - drift.difference
            drifts.setdefault(x, []).append(_to_drift_out("trend", expected, drift))
    return drifts


def _read_estimate(run: Run, name: str) -> TrendEstimate | None:
    """Read the estimate of a parameter or an onset delay, with its standard error."""
    estimate: Any = (run.estimates or {}).get(name)
    if estimate is None:
        onsets = decode(tuple[OnsetDelay, ...], (run.result or {}).get("onset_delays", []))
        return read_onset_estimates(onsets).get(name)
    return TrendEstimate(estimate["value"], estimate["stderr"]) if estimate["stderr"] else None


def _to_drift_out(kind: Literal["run", "trend"], expected: float, moved: Drift) -> DriftOut:
    z = max(min(moved.z, 1e300), -1e300)
    return DriftOut.from_source(moved, kind=kind, expected=expected, z=z, drifted=moved.has_drifted)
