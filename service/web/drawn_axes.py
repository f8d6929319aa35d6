"""Axes of a figure that is drawn without a script: ranges, ticks, places in px."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, floor, isfinite, log10
from typing import Any

from service.web import formats

Trace = Mapping[str, Any]
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))
_STEPS = (1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis; `low` and `high` are exponents of ten where it is logarithmic.

    `start` and `stop` are the px of `low` and `high`; of an upright one `start` lies below.
    """

    name: str
    title: str
    is_log: bool
    low: float
    high: float
    start: float
    stop: float
    n_ticks: int

    def at(self, value: float | None) -> float | None:
        """Place (px) of a value; None where it has none."""
        if value is None or not isfinite(value) or (self.is_log and value <= 0):
            return None
        place = log10(value) if self.is_log else value
        return self.start + (place - self.low) / (self.high - self.low) * (self.stop - self.start)

    def share(self, part: float) -> float:
        """Place (px) of a part of the axis, from 0 to 1."""
        return self.start + part * (self.stop - self.start)

    def ticks(self) -> Iterator[tuple[float, str]]:
        """Places (px) and labels of the ticks inside the range."""
        decades = self.is_log and self.high - self.low >= 1
        for value in _decades(self) if decades else _round_values(self):
            place = self.at(value)
            if place is not None:
                yield place, label_of(value)


def axes_of(figure: Mapping[str, Any], box: tuple[float, float, float, float]) -> dict[str, Axis]:
    """All axes of a figure by their names (``x``, ``y2``).

    Parameters
    ----------
    box : (left, right, top, bottom)
        Edges (px) of what the axes share.
    """
    left, right, top, bottom = box
    found = {}
    for key, layout in figure["layout"].items():
        kind, _, number = key.partition("axis")
        if kind not in ("x", "y") or "axis" not in key:
            continue
        name = kind + number
        first, last = layout.get("domain", (0, 1))
        edges = (left, right) if kind == "x" else (bottom, top)
        is_log = layout.get("type") == "log"
        low, high = _range(figure, name, layout, is_log)
        found[name] = Axis(
            name=name, title=str((layout.get("title") or {}).get("text", "")), is_log=is_log,
            low=low, high=high, start=edges[0] + first * (edges[1] - edges[0]),
            stop=edges[0] + last * (edges[1] - edges[0]), n_ticks=layout.get("nticks", 7),
        )  # fmt: skip
    return found


def label_of(value: float) -> str:
    """A tick's value: thousands as k, M, G, small ones by powers of ten."""
    size = abs(value)
    for unit, prefix in _PREFIXES:
        if 10_000 <= size < 1e13 and size >= unit:
            return f"{value / unit:.6g}{prefix}".replace("-", "−")
    if size >= 1e13 or 0 < size < 1e-3:
        return formats.number(value, 1 if _is_round(value) else 2)
    return f"{value:.6g}".replace("-", "−")


def axis_name(trace: Trace, kind: str) -> str:
    """Name of the axis that a trace lies on."""
    return str(trace.get(f"{kind}axis", kind))


def _is_round(value: float) -> bool:
    mantissa = f"{value:.4e}".partition("e")[0]
    return float(mantissa).is_integer()


def _range(
    figure: Mapping[str, Any], name: str, layout: Mapping[str, Any], is_log: bool
) -> tuple[float, float]:
    if "range" in layout:
        low, high = map(float, layout["range"])
    else:
        low, high = _spanned(list(_values(figure, name, layout, is_log)), layout, name[0])
    if not high > low:
        room = abs(low) * 0.1 or 1.0
        low, high = low - room, high + room
    return low, high


def _spanned(values: Sequence[float], layout: Mapping[str, Any], kind: str) -> tuple[float, float]:
    if not values:
        return 0.0, 1.0
    low, high = min(values), max(values)
    if layout.get("rangemode") == "tozero":
        low, high = min(low, 0.0), max(high, 0.0)
    room = (0.06 if kind == "y" else 0.02) * (high - low)
    at_zero = layout.get("rangemode") == "tozero"
    return low - (0.0 if at_zero and low == 0 else room), high + room


def _values(
    figure: Mapping[str, Any], name: str, layout: Mapping[str, Any], is_log: bool
) -> Iterator[float]:
    """What lies on an axis, or on one that it matches, as its exponents where it is one of ten."""
    kind = name[0]
    shared = {name, layout.get("matches", name)}
    for key, other in figure["layout"].items():
        if key.startswith(f"{kind}axis") and other.get("matches") in shared:
            shared.add(kind + key.removeprefix(f"{kind}axis"))
    for trace in figure["data"]:
        if axis_name(trace, kind) in shared:
            for value in _of_trace(trace, kind):
                if not is_log:
                    yield value
                elif value > 0:
                    yield log10(value)


def _of_trace(trace: Trace, kind: str) -> Iterator[float]:
    errors = (trace.get("error_y") or {}).get("array") if kind == "y" else None
    for place, value in enumerate(trace[kind]):
        if value is None or not isfinite(value):
            continue
        reach = (errors[place] or 0.0) if errors else 0.0
        yield value - reach
        yield value + reach
    if kind == "y" and trace.get("type") == "bar":
        yield 0.0


def _decades(axis: Axis) -> Iterator[float]:
    first, last = ceil(axis.low - 1e-9), floor(axis.high + 1e-9)
    step = max(1, -(-(last - first + 1) // axis.n_ticks))
    for exponent in range(first, last + 1, step):
        yield 10.0**exponent


def _round_values(axis: Axis) -> Iterator[float]:
    low, high = (10**axis.low, 10**axis.high) if axis.is_log else (axis.low, axis.high)
    rough = (high - low) / max(axis.n_ticks, 1)
    power = 10.0 ** floor(log10(rough))
    step = next(power * one for one in _STEPS if power * one >= rough * (1 - 1e-9))
    for number in range(ceil(low / step - 1e-9), floor(high / step + 1e-9) + 1):
        yield number * step
