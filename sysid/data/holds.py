"""What a sample says of the time beside it: the choices, and the choice by the values.

An input is a value that is held or interpolated between its samples, or a mean. `mean` is that of
the period that ends at the sample's stamp, and `mean-after` that of the period that begins there.
A mean is all that is known of its period. So the plant sees the value for that whole period: a
`mean` acts from the stamp before its own on, and a `mean-after` as a held value. An output is a
value at its stamp, or a mean: then the simulated output is averaged over the same period.
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple, get_args

import numpy as np

from sysid.core.types import FloatArray

Hold = Literal["zero", "first", "band-limited", "mean", "mean-after"]
HoldSetting = Literal["auto", "zero", "first", "band-limited", "mean", "mean-after"]
HOLDS: tuple[HoldSetting, ...] = get_args(HoldSetting)
MEANS: tuple[Hold, ...] = ("mean", "mean-after")
"""Holds of a value that is the mean of a period."""
OUTPUT_HOLDS: tuple[HoldSetting, ...] = ("auto", *MEANS)
"""Those of an output; ``auto`` is a value at its stamp."""
HOLD_TEXTS: Mapping[HoldSetting, str] = {
    "auto": "decided from the data",
    "zero": "held",
    "first": "straight lines",
    "band-limited": "band-limited",
    "mean": "mean up to its time",
    "mean-after": "mean from its time on",
}
"""What a signal does between its samples, in words."""

_ROUNDING_SHARE = 1e-9  # of the span: nearer values are equal
_ONE_QUANTUM = 1.5  # quanta: smaller jumps are of one quantum
_QUANTISED_SHARE = 0.9  # of the jumps: share of jumps of one quantum in a quantised signal
_FEW_LEVELS = 8
_SAMPLES_PER_LEVEL = 10
_BRIEF = 2  # samples: a shorter return to the level before is noise of a converter
_BRIEF_SHARE = 0.1  # of the jumps
_LASTING_SHARE = 0.5  # of the jumps between two plateaus in a piecewise constant signal


class HoldChoice(NamedTuple):
    """A chosen hold, and the reason as the end of a sentence: "it …"."""

    hold: Hold
    reason: str


def choose_hold(values: FloatArray) -> HoldChoice:
    """Choose the hold of an input by its values: ``zero`` if piecewise constant, else ``first``.

    Piecewise constant is a signal of two or few levels, or one whose jumps lie between plateaus
    without noise. Not so is a moving signal that a converter has quantised: it has plateaus too,
    but many levels, and nearly all of its jumps are of one quantum. A measured signal of few levels
    returns at once to the level that it left.
    """
    values = values[np.isfinite(values)]
    span = float(np.ptp(values)) if values.size else 0.0
    if not span > 0:
        return HoldChoice("first", "is constant, so that its hold has no effect")
    rounded = np.round((values - np.min(values)) / (_ROUNDING_SHARE * span))
    steps = np.diff(rounded)
    jumps = np.flatnonzero(steps)
    levels = np.unique(rounded)
    if levels.size == 2:
        return HoldChoice("zero", "has two levels")
    lengths = np.diff(np.concatenate([[0], jumps + 1, [rounded.size]]))
    if _is_quantised(steps[jumps], levels, lengths):
        return HoldChoice(
            "first", "moves and is quantised: it has many levels, and jumps from one to the next"
        )
    if levels.size <= min(_FEW_LEVELS, values.size / _SAMPLES_PER_LEVEL):
        return HoldChoice("zero", f"is piecewise constant: it has {levels.size} levels")
    equal = 100 * (1 - jumps.size / steps.size)
    share = f"{equal:.0f} % of its samples equal the one before"
    is_lasting = (lengths[:-1] > 1) & (lengths[1:] > 1)
    if np.mean(is_lasting) >= _LASTING_SHARE:
        return HoldChoice("zero", f"is piecewise constant: {share}")
    return HoldChoice("first", f"moves: {share}")


def _is_quantised(jumps: FloatArray, levels: FloatArray, lengths: FloatArray) -> bool:
    """Whether a signal of three or more levels looks like a moving one that was quantised."""
    quantum = float(np.min(np.diff(levels)))
    if np.mean(np.abs(jumps) <= _ONE_QUANTUM * quantum) < _QUANTISED_SHARE:
        return False
    returns = (jumps[1:] == -jumps[:-1]) & (lengths[1:-1] <= _BRIEF)
    return levels.size > _FEW_LEVELS or float(np.mean(returns)) > _BRIEF_SHARE
