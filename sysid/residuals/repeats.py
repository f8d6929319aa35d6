"""Sandwich covariance with errors clustered by repeat.

Samples that are pooled from repeats of one experiment lie side by side, but what they have in
common belongs to their repeat: a pressure that was a little higher, a valve that opened later. So Ω
sums the scores of whole repeats, u_g = S_gᵀe_g, and assumes nothing about the noise inside a repeat
(Liang and Zeger 1986).

With few repeats the estimate follows each of them. So each score is that of the residuals which the
repeat would have if it had been left out: (I - M_g A)⁻¹u_g with M_g = S_gᵀS_g and A = (SᵀS)⁻¹, the
jackknife (Bell and McCaffrey 2002, CR3). An interval has one degree of freedom less than the
effective number of repeats: fewer if some repeats determine the parameter alone (Carter, Schnepel
and Steigerwald 2017).
"""

from collections.abc import Iterator

import numpy as np

from sysid.core.types import RANK_TOLERANCE, FloatArray, IntArray
from sysid.residuals.coloured import ColouredCovariance, iterate_parts
from sysid.simulation.problem import Problem

_MIN_REPEATS = 5
"""With fewer repeats than these, or not more than parameters, nothing is known of their spread."""


def estimate_repeat_covariance(
    problem: Problem, influence: FloatArray, columns: FloatArray
) -> ColouredCovariance | None:
    """Estimate the middle of the sandwich by repeats; None if the samples have none, or too few.

    Parameters
    ----------
    influence : FloatArray, shape (n,)
        Influence of the weighted residuals of the scored samples on the loss.
    columns : FloatArray, shape (n, D)
        Sensitivities of these samples.
    """
    clusters, d = list(_list_repeats(problem)), columns.shape[1]
    g = len(clusters)
    if g < max(_MIN_REPEATS, d + 2) or sum(rows.size for rows in clusters) < influence.size:
        return None
    squares = [columns[rows].T @ columns[rows] for rows in clusters]
    inverse = np.linalg.pinv(columns.T @ columns, rcond=RANK_TOLERANCE**2, hermitian=True)
    middle = np.zeros((d, d))
    for rows, square in zip(clusters, squares, strict=True):
        score = np.linalg.pinv(np.eye(d) - square @ inverse) @ (columns[rows].T @ influence[rows])
        middle += np.outer(score, score)
    n, share = float(influence.size), (g - 1.0) / g
    return ColouredCovariance(
        middle * share * (n - d) / n,  # not corrected twice for the degrees of freedom
        n,
        is_drifting=False,
        is_clustered=True,
        series=tuple((square, share) for square in squares),
    )


def _list_repeats(problem: Problem) -> Iterator[IntArray]:
    """List the scored samples of each repeat of each experiment, over all of its outputs."""
    clusters: dict[tuple[int, float], list[IntArray]] = {}
    for part in iterate_parts(problem):
        for number in () if part.repeats is None else np.unique(part.repeats).tolist():
            rows = part.rows.start + np.flatnonzero(part.repeats == number)
            clusters.setdefault((part.experiment, number), []).append(rows)
    for several in clusters.values():
        yield np.concatenate(several)
