"""Repeats: values that are polled faster than they are new, stored by a band, or stuck."""

from collections.abc import Iterator
from math import sqrt

import numpy as np

from sysid.core.findings import Finding
from sysid.inspection.quantisation import find_quantum
from sysid.inspection.signal import Signal, build_finding, find_limited

_MIN_RUNS = 10
_EVEN_SHARE = 0.9  # of the runs that last as long as their median, give or take a sample
_FRESH_SHARE = 0.9  # of the runs, that have a value of their own
_SMOOTH = 0.5  # correlation of a value with the one before, of a plant that is polled
_DEVIATIONS = 3.0  # of the correlation of values without any (Bartlett 1946)
_REPEATED_SHARE = 0.2  # of the samples: readings that equal the one before
_BAND_SHARE = 0.1  # of the median move: the smallest one, if moves are stored by a band
_STUCK = 10  # readings in a row that equal the one before
_UNLIKELY = 1e-3  # probability that so many equal readings follow each other by chance
_FLANK = 10  # samples on either side of a stuck run
_QUANTA = 10.0  # moves beside it, in the smallest one: a plant that comes to rest has small ones


def find_repeats(signal: Signal) -> Iterator[Finding]:
    """Find readings that repeat an older one."""
    if not signal.is_told or find_quantum(signal) is not None:
        return
    if every := _find_poll(signal):
        seconds = every * float(np.median(np.diff(signal.times)))
        yield build_finding(
            "repeated reading",
            "sensor",
            f"{signal.name} has a new value only each {every} samples ({seconds:.4g} s): it is "
            "polled faster than it changes, and repeats old values.",
            (signal.name,),
            advice=f"If {signal.name} is an output, keep the first row of equal readings, and "
            "leave the others empty.",
        )
        return
    if signal.is_held:
        return
    if band := _find_band(signal):
        yield build_finding(
            "repeated reading",
            "sensor",
            f"{signal.name} repeats its last value until it has moved by "
            f"{signal.format_value(band)}: it was stored by a band.",
            (signal.name,),
            advice=f"Keep the first row of equal readings of {signal.name}, and leave the others "
            "empty.",
        )
        return
    if signal.role != "input" and (stuck := list(_find_stuck(signal))):
        where = ", ".join(f"{first:.6g} to {last:.6g} s" for first, last in stuck[:3])
        yield build_finding(
            "repeated reading",
            "sensor",
            f"{signal.name} does not move at all from {where}, and does everywhere else.",
            (signal.name,),
            tuple(stuck),
            f"If it is stuck, leave these samples of {signal.name} empty.",
        )


def _find_poll(signal: Signal) -> int:
    """Find each how many samples a signal is new; 0 if it is so at each, or not evenly."""
    lengths = signal.runs.lengths[1:-1]
    if lengths.size < _MIN_RUNS or (signal.role == "input" and signal.is_held):
        return 0
    every = int(np.median(lengths))
    is_even = np.abs(lengths - every) <= (1 if every > 2 else 0)
    is_fresh = signal.levels.size >= _FRESH_SHARE * signal.runs.lengths.size
    if every < 2 or not is_fresh or np.mean(is_even) < _EVEN_SHARE:
        return 0
    return every if signal.role == "output" or _is_smooth(signal) else 0


def _is_smooth(signal: Signal) -> bool:
    """Whether the values of runs follow each other; levels that were drawn for a test do not."""
    values = signal.values[signal.runs.starts]
    values = values - np.mean(values)
    correlation = float(values[1:] @ values[:-1]) / float(values @ values)
    return correlation >= max(_SMOOTH, _DEVIATIONS / sqrt(values.size))


def _find_band(signal: Signal) -> float:
    """Find the band by which an output is stored; 0 if it is not."""
    if signal.role != "output":
        return 0.0
    equal = (signal.steps == 0) & ~find_limited(signal.values)[1:]
    moves = np.abs(signal.steps[signal.steps != 0])
    if np.mean(equal) <= _REPEATED_SHARE or moves.size < _MIN_RUNS:
        return 0.0
    least = float(np.min(moves))
    return least if least >= _BAND_SHARE * float(np.median(moves)) else 0.0


def _find_stuck(signal: Signal) -> Iterator[tuple[float, float]]:
    """Find runs of equal readings between samples that move."""
    starts, lengths = signal.runs
    long = np.flatnonzero(lengths[1:-1] > _STUCK) + 1
    if not long.size:
        return
    equal = float(np.mean(signal.steps == 0))
    limited = find_limited(signal.values)
    for start, length in zip(starts[long].tolist(), lengths[long].tolist(), strict=True):
        others = max(equal - (length - 1) / signal.steps.size, 1.0 / signal.steps.size)
        is_chance = signal.values.size * others ** (length - 1) > _UNLIKELY
        if is_chance or limited[start]:
            continue
        before = np.abs(signal.steps[max(start - 1 - _FLANK, 0) : start - 1])
        after = np.abs(signal.steps[start + length : start + length + _FLANK])
        sides = [float(np.median(side)) for side in (before, after) if side.size]
        if sides and min(sides) >= _QUANTA * signal.quantum:
            yield signal.take_span(start, start + length - 1)
