"""Units: a moving signal that is in another unit from some moment on."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sysid.core.findings import Finding
from sysid.core.robust import estimate_deviation
from sysid.core.types import FloatArray
from sysid.inspection.signal import Signal


class _Conversion(NamedTuple):
    """A change of a unit: the value is multiplied, then shifted."""

    words: str
    factor: float
    shift: float


_CONVERSIONS = (
    _Conversion("°C to °F", 1.8, 32.0),
    _Conversion("°C to K", 1.0, 273.15),
    _Conversion("a fraction to %", 100.0, 0.0),
    _Conversion("a unit to its thousandth", 1000.0, 0.0),
    _Conversion("bar to psi", 14.5038, 0.0),
    _Conversion("m to feet", 3.28084, 0.0),
    _Conversion("inches to mm", 25.4, 0.0),
    _Conversion("l to gallons", 0.264172, 0.0),
    _Conversion("s to min", 1.0 / 60.0, 0.0),
)
_JUMP = 20.0  # deviations of the moves between samples
_NEIGHBOURS = 5  # samples on either side that tell where the jump begins and ends
_CLOSE = 3.0  # deviations
_CLEAR_SHARE = 0.1  # of the jump: a conversion that is met no better may be met by chance
_SCALED = 1.4  # moves after the jump are larger by the factor, give or take so much


def find_unit_change(signal: Signal) -> Iterator[Finding]:
    """Find one jump of a signal that a usual conversion of units explains.

    The moves between samples must grow by the factor too.
    """
    if not signal.is_told or signal.is_held:
        return
    deviation = estimate_deviation(signal.steps)
    jumps = np.flatnonzero(np.abs(signal.steps) > _JUMP * deviation)
    if not (deviation > 0 and 1 <= jumps.size <= 2):
        return
    place = int(jumps[np.argmax(np.abs(signal.steps[jumps]))])
    before, after = _read_beside(signal.values, place)
    old, new = (
        estimate_deviation(part) if part.size else 0.0
        for part in (signal.steps[:place], signal.steps[place + 1 :])
    )
    for one in _CONVERSIONS:
        words = one.words.split(" to ")
        factor, shift = one.factor, one.shift
        for told, scale, text in (
            (factor * before + shift, factor, " to ".join(words)),
            ((before - shift) / factor, 1.0 / factor, " to ".join(reversed(words))),
        ):
            error = _CLOSE * max(new, old * scale)
            is_met = abs(told - after) <= error <= _CLEAR_SHARE * abs(after - before)
            if is_met and old * scale / _SCALED < new < old * scale * _SCALED:
                moment = float(signal.times[place + 1])
                yield Finding(
                    "change of a unit",
                    "sensor",
                    "serious",
                    f"{signal.name} changes its unit at {moment:.6g} s",
                    f"{signal.name} jumps from {before:.4g} to {after:.4g} at {moment:.6g} s, as "
                    f"if its unit changed from {text}.",
                    "Convert that part, or cut the record there.",
                    channels=(signal.name,),
                    spans=((moment, float(signal.times[-1])),),
                )
                return


def _read_beside(values: FloatArray, place: int) -> tuple[float, float]:
    """Read where a jump after a sample begins and ends, by the lines of its neighbours."""
    ends = []
    for part, at in (
        (values[max(place + 1 - _NEIGHBOURS, 0) : place + 1], 0.5),
        (values[place + 1 : place + 1 + _NEIGHBOURS][::-1], 0.5),
    ):
        rows = np.arange(part.size)
        slope = float(np.polyfit(rows, part, 1)[0]) if part.size > 2 else 0.0
        ends.append(float(np.mean(part) + slope * (part.size - 1 + at - np.mean(rows))))
    return ends[0], ends[1]
