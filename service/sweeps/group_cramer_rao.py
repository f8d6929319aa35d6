"""Stored Cramér–Rao bounds of a job, and their values for a group of its runs."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sysid.core.distributions import chi_square_limit

BoundsDocument = Mapping[str, Any]


class StoredBounds:
    """Finds the problem that all runs of a group share; they may share none.

    Parameters
    ----------
    stored : mapping or None
        Document of `service.dispatch.run_cramer_rao`. None while the job runs, and without noise.
    """

    def __init__(self, stored: BoundsDocument | None) -> None:
        self._axes: Sequence[str] = (stored or {}).get("axes", ())
        self._note: str = (stored or {}).get("note", "")
        self.problems: Sequence[BoundsDocument] = (stored or {}).get("problems", ())

    def find_problem(self, key: Mapping[str, Any]) -> BoundsDocument | None:
        """Find the problem of a group by the values of its keys."""
        if len(self.problems) == 1:
            return self.problems[0]
        if not self.problems or any(path not in key for path in self._axes):
            return None
        cell = {path: key[path] for path in self._axes}
        return next((problem for problem in self.problems if problem["cell"] == cell), None)

    def list_notes(self) -> Iterator[str]:
        """List the notes that a reader of errors and bounds needs, each once."""
        if not self.problems:
            return
        kinds = {(problem["reference"] or {}).get("kind") for problem in self.problems}
        if "truth" in kinds:
            yield "parameter errors are differences from the true values"
        if "estimate" in kinds:
            yield (
                "the true values are unknown. Parameter errors and Cramér–Rao bounds refer to the "
                "estimate of the best run with the least noise"
            )
        if any(_is_measured_record(problem["reference"] or {}) for problem in self.problems):
            yield (
                "σ = 0 is the measured record without added noise. It is always run, because it "
                "gives that estimate"
            )
        yield from dict.fromkeys(problem["note"] for problem in self.problems if problem["note"])
        if self._note:
            yield self._note


def _is_measured_record(reference: Mapping[str, Any]) -> bool:
    return reference.get("kind") == "estimate" and reference.get("sigma") == 0


def scale_to_median(group: Mapping[str, Any]) -> float | None:
    """Scale the bound of a group's RMS to one of the median over its runs.

    With r directions of the parameters in the response, r RMS²/bound² of an efficient estimator
    is χ² with r degrees of freedom. Its median is below r, so that of the runs may lie below a
    bound of the RMS.
    """
    if group["rms_cramer_rao_bound"] is None:
        return None
    r = sum(parameter["cramer_rao_bound"] is not None for parameter in group["parameters"]) or 1
    return float(group["rms_cramer_rao_bound"] * (chi_square_limit(r, 0.5) / r) ** 0.5)


def scale_to_sigma(per_sigma: float | None, sigma: tuple[float, float] | None) -> float | None:
    """Scale a bound to the σ of a group; None if its runs have several."""
    if per_sigma is None or sigma is None or sigma[0] != sigma[1]:
        return None
    return per_sigma * sigma[0]
