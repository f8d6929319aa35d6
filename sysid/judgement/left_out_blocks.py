"""Blocks of a record simulated by linear models that did not see them.

Blocks are left out linearly first, as in Allen's PRESS (Technometrics 16 (1974) 125). Then they are
really left out: poles and time lags take a Gauss–Newton step without a block, the linear part is
fitted without it, and the whole record is simulated.
"""

from typing import NamedTuple

import numpy as np

from sysid.core.types import BoolArray, FloatArray
from sysid.judgement.input_grid import GridRows, InputGrid, take_rows
from sysid.judgement.linear_fits import (
    WORTHWHILE,
    LinearFit,
    fit_each_order,
    make_ridge,
    move_parameters,
    solve_scaled,
)
from sysid.judgement.state_responses import (
    StateSignals,
    compute_impulses,
    compute_responses,
    read_columns,
    read_plain_columns,
)

LEAST_SHARE = 0.5  # of the samples must be compared
_STEP_SHARES = (1.0, 0.5, 0.2)  # of a step without a block, until it lowers the squares


def fit_better_orders(grid: InputGrid, rows: GridRows) -> list[LinearFit]:
    """Fit each order; list those that simulate left-out blocks better than all lower ones."""
    better, least = list[LinearFit](), np.full((int(np.max(rows.block)) + 1) // 2, np.inf)
    for fit in fit_each_order(grid, rows):
        squares = _sum_left_out(fit, rows)
        known = np.isfinite(squares) & ~np.isnan(least)
        if np.mean(known) < LEAST_SHARE:
            continue
        if np.sum(squares[known]) < WORTHWHILE * np.sum(least[known]):
            least = squares
            better.append(fit)
    return better


class _Omission(NamedTuple):
    """A block left out of the rows (R,): which are in it, and which the fit without it sees.

    `move` (P,) is that of all parameters. `is_told`: the rows that are seen determine what is
    simulated in the block.
    """

    mask: BoolArray
    seen: BoolArray
    move: FloatArray
    is_told: bool


def _hide(rows: GridRows) -> list[tuple[BoolArray, BoolArray]]:
    """List the rows in each block, and those that are seen without it.

    Half a block at either side is not seen, because coloured noise there knows the noise in the
    block (h-block cross-validation: Burman, Chow and Nolan, Biometrika 81 (1994) 351).
    """
    parts = []
    for first in range(0, int(np.max(rows.block)) + 1, 2):
        mask = (rows.block == first) | (rows.block == first + 1)
        is_near = (rows.block >= max(first - 1, 0)) & (rows.block <= first + 2)
        is_near &= np.isin(rows.experiment, rows.experiment[mask])
        parts.append((mask, ~(mask | is_near)))
    return parts


def leave_out_blocks(fit: LinearFit, rows: GridRows) -> list[_Omission]:
    """Leave out each block by a Gauss–Newton step.

    The mean variance of what is then simulated, over that of the noise, is the mean diagonal of
    J A⁻¹ Jᵀ, where A is the sum of products of the rows that are seen. Up to 1 the block is told.
    """
    parts = _hide(rows)
    gram = fit.columns.T @ fit.columns
    gram[np.diag_indices_from(gram)] += fit.ridge
    others = np.array([gram - fit.columns[~seen].T @ fit.columns[~seen] for _, seen in parts])
    right = np.array([fit.columns[~seen].T @ fit.errors[~seen] for _, seen in parts])
    size = np.sqrt(np.maximum(np.einsum("bpp->bp", others), 1e-300))
    scaled = others / (size[:, :, None] * size[:, None, :])
    inverse = np.linalg.pinv(scaled, rcond=1e-13, hermitian=True)
    moves = -np.einsum("bpq,bq->bp", inverse, right / size) / size
    left_out = []
    for i, (mask, seen) in enumerate(parts):
        inside = fit.columns[mask] / size[i]
        variance = float(np.sum((inside @ inverse[i]) * inside))
        is_told = variance <= float(np.count_nonzero(mask))
        left_out.append(_Omission(mask, seen, moves[i], is_told))
    return left_out


def _sum_left_out(fit: LinearFit, rows: GridRows) -> FloatArray:
    """Sum the squared errors of each left-out block (B,), linear in all parameters.

    It is nan for a block that the others do not tell.
    """
    return np.array(
        [
            float(np.sum(np.square(fit.errors[mask] - fit.columns[mask] @ move)))
            if is_told
            else np.nan
            for mask, _, move, is_told in leave_out_blocks(fit, rows)
        ]
    )


def simulate_left_out(
    grid: InputGrid, rows: GridRows, fit: LinearFit, every: GridRows
) -> FloatArray:
    """Simulate each block of all samples with parameters fitted without it; nan elsewhere."""
    predicted = np.full(every.value.size, np.nan)
    left_out = leave_out_blocks(fit, rows)
    waiting = [number for number, block in enumerate(left_out) if block.is_told]
    count = fit.shape.size + fit.delays.size
    for share in _STEP_SHARES:
        moved = [
            move_parameters(grid, fit, share * left_out[number].move[-count:]) for number in waiting
        ]
        if not moved:
            break
        shapes = np.array([shape for shape, _ in moved])
        signals = compute_responses(grid, compute_impulses(shapes, grid.points))
        rejected = []
        for i, number in enumerate(waiting):
            seen, delays = left_out[number].seen, moved[i][1]
            linear, squares = _fit_linear(grid, signals.select(i), delays, take_rows(rows, seen))
            before = float(np.sum(np.square(fit.errors[seen])))
            if squares > before and share != _STEP_SHARES[-1]:
                rejected.append(number)
                continue
            own = every.block // 2 == number
            columns = read_plain_columns(grid, signals.select(i), delays, take_rows(every, own))
            predicted[own] = linear @ columns
        waiting = rejected
    return predicted


def _fit_linear(
    grid: InputGrid, signals: StateSignals, delays: FloatArray, rows: GridRows
) -> tuple[FloatArray, float]:
    """Fit the linear coefficients (P,) to rows; return their squares too."""
    [columns] = read_columns(grid, signals, delays, rows)
    value = rows.root * rows.value
    gram = columns @ columns.T
    size = signals.responses.shape[1] * signals.responses.shape[2]
    gram[np.diag_indices_from(gram)] += make_ridge(columns[None], size)[0]
    linear = solve_scaled(gram, columns @ value)
    return linear, float(np.sum(np.square(value - linear @ columns)))
