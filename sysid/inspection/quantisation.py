"""Quantisation: values in steps of a converter, as coarse as what moves between two samples.

Finer steps act as white noise (Widrow and Kollár, Quantization Noise, 2008), and are not told.
"""

from collections.abc import Iterator

import numpy as np

from sysid.core.findings import Finding
from sysid.inspection.signal import Signal, build_finding

_GRID_TOLERANCE = 0.02  # of a step: values are printed with few digits
_MIN_STAIRS, _MIN_MOVES, _ONE_STEP = 4, 10, 1.5
"""Levels and moves of a signal that goes from each level to a neighbour alone. Levels that somebody
chose are not so: of five drawn at random, ten moves are in one of 8,000 cases."""
_MIN_LEVELS = 8
_SAMPLES_PER_LEVEL = 4
_STILL_SHARE = 0.25  # of the samples, that equal the one before: white noise of a step has 28 %


def find_quantum(signal: Signal) -> float | None:
    """Find the step in which the values of a moving signal come; None if it is fine, or none."""
    if not signal.is_told or not signal.quantum > 0:
        return None
    levels = signal.levels
    count = np.rint((levels[-1] - levels[0]) / signal.quantum)
    counts = (levels - levels[0]) * (count / (levels[-1] - levels[0]))
    if np.max(np.abs(counts - np.rint(counts))) > _GRID_TOLERANCE:
        return None
    moves = np.abs(signal.steps[signal.steps != 0])
    is_stair = moves.size >= _MIN_MOVES and _MIN_STAIRS <= levels.size <= moves.size / 2
    if is_stair and np.max(moves) < _ONE_STEP * signal.quantum:
        return signal.quantum
    if signal.is_held or not _MIN_LEVELS <= levels.size <= signal.values.size / _SAMPLES_PER_LEVEL:
        return None
    return signal.quantum if np.mean(signal.steps == 0) >= _STILL_SHARE else None


def find_quantisation(signal: Signal) -> Iterator[Finding]:
    """Find values that come in coarse steps."""
    quantum = find_quantum(signal)
    if quantum is not None:
        levels = signal.levels.size
        yield build_finding(
            "quantisation",
            "input" if signal.role == "input" else "sensor",
            f"{signal.name} comes in steps of {signal.format_value(quantum)}, in {levels} levels: "
            "what it does between two of them is not recorded.",
            (signal.name,),
        )
