"""Draw the Plotly figures as SVG, for reports without scripts.

Colours come from the report's style sheet. A line has at most `MAX_LINE_POINTS` points. This module
computes ranges, ticks and positions (px) of the axes, and draws symbols by Plotly's names.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, floor, isfinite, log10
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from sysid.core.text import format_number
from sysid.figures.plotly import Figure
from sysid.figures.theme import stride_indices, thin_indices

_MarkerPath = Callable[[float, float, float], str]


def draw_marker(name: str, x: float, y: float, radius: float, colour: str) -> str:
    """Draw a symbol at a position (px); a name that ends with ``-open`` is only an outline."""
    shape, is_open = name.removesuffix("-open"), name.endswith("-open")
    is_thin = shape in _LINE_MARKERS
    paint = f'fill="none" stroke="{colour}"' if is_open or is_thin else f'fill="{colour}"'
    if shape in _MARKER_PATHS:
        return f'<path d="{_MARKER_PATHS[shape](x, y, radius)}" {paint}/>'
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" {paint}/>'


def _diamond_path(x: float, y: float, r: float) -> str:
    return f"M{x:.1f} {y - r:.1f}l{r:.1f} {r:.1f}l{-r:.1f} {r:.1f}l{-r:.1f} {-r:.1f}Z"


def _triangle_path(x: float, y: float, r: float) -> str:
    return f"M{x:.1f} {y - r:.1f}l{r:.1f} {1.7 * r:.1f}h{-2 * r:.1f}Z"


def _cross_path(x: float, y: float, r: float) -> str:
    return (
        f"M{x - r:.1f} {y - r:.1f}l{2 * r:.1f} {2 * r:.1f}M{x - r:.1f} {y + r:.1f}l{2 * r:.1f} "
        f"{-2 * r:.1f}"
    )


def _star_path(x: float, y: float, r: float) -> str:
    return (
        f"{_cross_path(x, y, 0.7 * r)}M{x - r:.1f} {y:.1f}h{2 * r:.1f}"
        f"M{x:.1f} {y - r:.1f}v{2 * r:.1f}"
    )


_MARKER_PATHS: Mapping[str, _MarkerPath] = {
    "diamond": _diamond_path,
    "triangle-up": _triangle_path,
    "x-thin": _cross_path,
    "star": _star_path,
}
_LINE_MARKERS = ("x-thin", "star")

PlotlyTrace = Mapping[str, Any]
_SI_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))
_TICK_STEPS = (1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True, slots=True)
class SvgAxis:
    """One axis; `low` and `high` are exponents of ten if it is logarithmic.

    `start` and `stop` are the px of `low` and `high`. On a vertical axis `start` is the lower end.
    """

    name: str
    title: str
    is_log: bool
    low: float
    high: float
    start: float
    stop: float
    n_ticks: int

    def to_pixel(self, value: float | None) -> float | None:
        """Compute the position (px) of a value; None if it has none."""
        if value is None or not isfinite(value) or (self.is_log and value <= 0):
            return None
        position = log10(value) if self.is_log else value
        return self.start + (position - self.low) / (self.high - self.low) * (
            self.stop - self.start
        )

    def fraction_to_pixel(self, part: float) -> float:
        """Compute the position (px) of a fraction of the axis, from 0 to 1."""
        return self.start + part * (self.stop - self.start)

    def tick_positions(self) -> Iterator[tuple[float, str]]:
        """Yield positions (px) and labels of the ticks inside the range."""
        decades = self.is_log and self.high - self.low >= 1
        for value in _decade_ticks(self) if decades else _round_ticks(self):
            position = self.to_pixel(value)
            if position is not None:
                yield position, format_tick(value)


def build_axes(
    figure: Mapping[str, Any], box: tuple[float, float, float, float]
) -> dict[str, SvgAxis]:
    """Build all axes of a figure by their names (``x``, ``y2``).

    Parameters
    ----------
    box : (left, right, top, bottom)
        Edges (px) of the area that the axes share.
    """
    left, right, top, bottom = box
    axes = {}
    for key, layout in figure["layout"].items():
        kind, _, number = key.partition("axis")
        if kind not in ("x", "y") or "axis" not in key:
            continue
        name = kind + number
        first, last = layout.get("domain", (0, 1))
        edges = (left, right) if kind == "x" else (bottom, top)
        is_log = layout.get("type") == "log"
        low, high = _axis_range(figure, name, layout, is_log)
        axes[name] = SvgAxis(
            name=name,
            title=str((layout.get("title") or {}).get("text", "")),
            is_log=is_log,
            low=low,
            high=high,
            start=edges[0] + first * (edges[1] - edges[0]),
            stop=edges[0] + last * (edges[1] - edges[0]),
            n_ticks=layout.get("nticks", 7),
        )
    return axes


def format_tick(value: float) -> str:
    """Format a tick: thousands as k, M, G; small values by powers of ten."""
    size = abs(value)
    for unit, prefix in _SI_PREFIXES:
        if 10_000 <= size < 1e13 and size >= unit:
            return f"{value / unit:.6g}{prefix}".replace("-", "−")
    if size >= 1e13 or 0 < size < 1e-3:
        return format_number(value, 1 if _is_round(value) else 2)
    return f"{value:.6g}".replace("-", "−")


def axis_name(trace: PlotlyTrace, kind: str) -> str:
    """Name of a trace's axis."""
    return str(trace.get(f"{kind}axis", kind))


def _is_round(value: float) -> bool:
    mantissa = f"{value:.4e}".partition("e")[0]
    return float(mantissa).is_integer()


def _axis_range(
    figure: Mapping[str, Any], name: str, layout: Mapping[str, Any], is_log: bool
) -> tuple[float, float]:
    if "range" in layout:
        low, high = map(float, layout["range"])
    else:
        low, high = _pad_range(list(_axis_values(figure, name, layout, is_log)), layout, name[0])
    if not high > low:
        room = abs(low) * 0.1 or 1.0
        low, high = low - room, high + room
    return low, high


def _pad_range(
    values: Sequence[float], layout: Mapping[str, Any], kind: str
) -> tuple[float, float]:
    if not values:
        return 0.0, 1.0
    low, high = min(values), max(values)
    if layout.get("rangemode") == "tozero":
        low, high = min(low, 0.0), max(high, 0.0)
    room = (0.06 if kind == "y" else 0.02) * (high - low)
    at_zero = layout.get("rangemode") == "tozero"
    return low - (0.0 if at_zero and low == 0 else room), high + room


def _axis_values(
    figure: Mapping[str, Any], name: str, layout: Mapping[str, Any], is_log: bool
) -> Iterator[float]:
    """Yield the values on an axis and on axes that match it; exponents of ten if logarithmic."""
    kind = name[0]
    shared = {name, layout.get("matches", name)}
    for key, other in figure["layout"].items():
        if key.startswith(f"{kind}axis") and other.get("matches") in shared:
            shared.add(kind + key.removeprefix(f"{kind}axis"))
    for trace in figure["data"]:
        if axis_name(trace, kind) in shared:
            for value in _trace_extents(trace, kind):
                if not is_log:
                    yield value
                elif value > 0:
                    yield log10(value)


def _trace_extents(trace: PlotlyTrace, kind: str) -> Iterator[float]:
    errors = (trace.get("error_y") or {}).get("array") if kind == "y" else None
    for index, value in enumerate(trace[kind]):
        if value is None or not isfinite(value):
            continue
        reach = (errors[index] or 0.0) if errors else 0.0
        yield value - reach
        yield value + reach
    if kind == "y" and trace.get("type") == "bar":
        yield 0.0


def _decade_ticks(axis: SvgAxis) -> Iterator[float]:
    first, last = ceil(axis.low - 1e-9), floor(axis.high + 1e-9)
    step = max(1, -(-(last - first + 1) // axis.n_ticks))
    for exponent in range(first, last + 1, step):
        yield 10.0**exponent


def _round_ticks(axis: SvgAxis) -> Iterator[float]:
    low, high = (10**axis.low, 10**axis.high) if axis.is_log else (axis.low, axis.high)
    rough = (high - low) / max(axis.n_ticks, 1)
    power = 10.0 ** floor(log10(rough))
    step = next(power * factor for factor in _TICK_STEPS if power * factor >= rough * (1 - 1e-9))
    for number in range(ceil(low / step - 1e-9), floor(high / step + 1e-9) + 1):
        yield number * step


DEFAULT_WIDTH_PX = 900
MAX_LINE_POINTS = 400
MAX_MARKERS = 400
_LETTER_PX, _LEGEND_ROW_PX, _LEGEND_KEY_PX = 6.7, 18, 30
_DASH_ARRAYS = {"dash": "7 4", "dot": "2 3", "dashdot": "7 3 2 3"}
_TAG_PATTERN = re.compile(r"(</?b>|</?sup>|<br>)")
_TAG_SPANS = {
    "<b>": '<tspan font-weight="600">',
    "<sup>": '<tspan baseline-shift="super" font-size="9">',
    "</b>": "</tspan>",
    "</sup>": "</tspan>",
    "<br>": " ",
}


def is_drawable(figure: Figure) -> bool:
    """Whether the figure has only lines, points and bands."""
    return bool(figure["data"]) and all(trace["type"] == "scatter" for trace in figure["data"])


def to_svg(figure: Figure, title: str, width: int = DEFAULT_WIDTH_PX) -> Markup:
    """Draw a figure as an SVG element.

    Parameters
    ----------
    title : str
        Description for screen readers.
    width : int
        Width in px; the height is the figure's.
    """
    legend = list(_lay_out_legend(figure, width))
    rows = 1 + max((row for _, row, _ in legend), default=-1)
    margin, height = figure["layout"]["margin"], figure["layout"]["height"]
    legend_height = max(rows - 1, 0) * _LEGEND_ROW_PX  # the layout has room for one row
    box = (
        margin["l"],
        width - margin["r"],
        margin["t"] + legend_height,
        height + legend_height - margin["b"],
    )
    axes = build_axes(figure, box)
    parts = [
        *_draw_grid(figure, axes),
        *_draw_shapes(figure, axes, box),
        *(
            part
            for n, _ in enumerate(figure["data"])
            for part in _draw_trace(figure["data"], n, axes)
        ),
        *_draw_labels(figure, axes, box),
        *_draw_legend(legend),
    ]
    return Markup(
        f'<svg class="drawn" viewBox="0 0 {width} {height + legend_height}" role="img" '
        f'aria-label="{escape(title)}">{"".join(parts)}</svg>'
    )


def to_markup(text: str) -> str:
    """Convert a label to markup: bold and superscript stay, the rest is escaped."""
    return "".join(_TAG_SPANS.get(part) or str(escape(part)) for part in _TAG_PATTERN.split(text))


def _draw_grid(figure: Figure, axes: Mapping[str, SvgAxis]) -> Iterator[str]:
    for x, y in _axis_pairs(figure, axes):
        # If several plots share an axis, the plot that it is anchored to has its labels.
        is_below = figure["layout"][f"xaxis{x.name[1:]}"].get("anchor", "y") == y.name
        for axis in (x, y):
            for position, label in axis.tick_positions():
                yield _draw_tick(axis, x, y, position, label if axis is y or is_below else "")
        yield (f'<path class="frame" d="M{x.start:.1f} {y.stop:.1f}V{y.start:.1f}H{x.stop:.1f}"/>')


def _draw_tick(axis: SvgAxis, x: SvgAxis, y: SvgAxis, position: float, label: str) -> str:
    if axis is x:
        line = f"M{position:.1f} {y.start:.1f}V{y.stop:.1f}"
        at = f'x="{position:.1f}" y="{y.start + 15:.1f}" text-anchor="middle"'
    else:
        line = f"M{x.start:.1f} {position:.1f}H{x.stop:.1f}"
        at = f'x="{x.start - 6:.1f}" y="{position + 4:.1f}" text-anchor="end"'
    return f'<path class="grid" d="{line}"/><text {at}>{escape(label)}</text>'


def _axis_pairs(figure: Figure, axes: Mapping[str, SvgAxis]) -> list[tuple[SvgAxis, SvgAxis]]:
    """List the pairs of axes; plots that share a time axis each form a pair with it."""
    layout = figure["layout"]
    return [
        (axes[str(layout[f"yaxis{name[1:]}"].get("anchor", "x"))], axis)
        for name, axis in axes.items()
        if name.startswith("y")
    ]


def _draw_labels(
    figure: Figure, axes: Mapping[str, SvgAxis], box: tuple[float, float, float, float]
) -> Iterator[str]:
    for x, y in _axis_pairs(figure, axes):
        if y.title:
            at = f"translate({x.start - 48:.1f} {0.5 * (y.start + y.stop):.1f}) rotate(-90)"
            yield _draw_title(y.title, f'transform="{at}"')
    for axis in (
        titled_axis
        for name, titled_axis in axes.items()
        if name.startswith("x") and titled_axis.title
    ):
        below = str(figure["layout"][f"xaxis{axis.name[1:]}"].get("anchor", "y"))
        position = axes[below].start + 34
        yield _draw_title(axis.title, f'x="{axis.fraction_to_pixel(0.5):.1f}" y="{position:.1f}"')
    left, right, top, bottom = box
    for annotation in figure["layout"].get("annotations", ()):
        x_at = left + annotation["x"] * (right - left)
        if annotation.get("xref") != "paper":
            x_at = axes["x"].to_pixel(annotation["x"]) or left
        y_at = bottom - annotation["y"] * (bottom - top)
        drop = 12 if annotation.get("yanchor") == "top" else -annotation.get("yshift", 0)
        yield (
            f'<text x="{x_at + annotation.get("xshift", 0):.1f}" y="{y_at + drop:.1f}">'
            f"{to_markup(annotation['text'])}</text>"
        )


def _draw_title(text: str, at: str) -> str:
    return f'<text class="title" text-anchor="middle" {at}>{to_markup(text)}</text>'


def _draw_shapes(
    figure: Figure, axes: Mapping[str, SvgAxis], box: tuple[float, float, float, float]
) -> Iterator[str]:
    for shape in figure["layout"].get("shapes", ()):
        x = [_to_pixel(shape.get("xref", "x"), shape[k], axes, box[:2]) for k in ("x0", "x1")]
        y = [
            _to_pixel(shape.get("yref", "y"), shape[k], axes, (box[3], box[2]))
            for k in ("y0", "y1")
        ]
        positions = [position for position in (*x, *y) if position is not None]
        if len(positions) == 4:
            yield _draw_shape(shape, *positions)


def _draw_shape(shape: Mapping[str, Any], x0: float, x1: float, y0: float, y1: float) -> str:
    if shape["type"] == "rect":
        return (
            f'<rect x="{min(x0, x1):.1f}" y="{min(y0, y1):.1f}" width="{abs(x1 - x0):.1f}" '
            f'height="{abs(y1 - y0):.1f}" fill="{shape["fillcolor"]}"/>'
        )
    return f'<path d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" {_stroke_attributes(shape["line"])}/>'


def _to_pixel(
    ref: str, value: float, axes: Mapping[str, SvgAxis], paper: tuple[float, float]
) -> float | None:
    if ref == "paper":
        return paper[0] + value * (paper[1] - paper[0])
    name, _, domain = ref.partition(" ")
    return axes[name].fraction_to_pixel(value) if domain else axes[name].to_pixel(value)


def _draw_trace(
    data: Sequence[PlotlyTrace], number: int, axes: Mapping[str, SvgAxis]
) -> Iterator[str]:
    trace = data[number]
    x, y = axes[axis_name(trace, "x")], axes[axis_name(trace, "y")]
    if trace.get("fill") == "tonexty" and number:
        yield _draw_band(data[number - 1], trace, x, y)
    mode = trace.get("mode", "lines")
    if "lines" in mode and trace.get("line", {}).get("width", 1):
        yield (
            f'<path d="{_path_data(_thin_line(trace, x, y), trace)}" fill="none" '
            f"{_stroke_attributes(trace.get('line', {}))}/>"
        )
    if "markers" in mode:
        yield from _draw_error_bars(trace, x, y)
        yield from _draw_markers(trace, x, y)


def _thin_line(
    trace: PlotlyTrace, x: SvgAxis, y: SvgAxis
) -> list[tuple[float | None, float | None]]:
    """Compute the positions of a line, thinned for a drawing; None at a gap."""
    values = np.array([np.nan if v is None else v for v in trace["y"]], dtype=np.float64)
    whole = bool(np.isfinite(values).all())
    shown = (
        thin_indices(values, MAX_LINE_POINTS)
        if whole
        else stride_indices(values.size, MAX_LINE_POINTS)
    )
    return [(x.to_pixel(trace["x"][i]), y.to_pixel(trace["y"][i])) for i in shown]


def _path_data(places: Sequence[tuple[float | None, float | None]], trace: PlotlyTrace) -> str:
    is_held = trace.get("line", {}).get("shape") == "hv"
    words: list[str] = []
    before: tuple[str, str] | None = None
    for across, up in places:
        if across is None or up is None:
            before = None
            continue
        point = f"{across:.1f}", f"{up:.1f}"
        if point == before:
            continue
        if before is None:
            words.append(f"M{point[0]} {point[1]}")
        else:
            words.append(f"H{point[0]}V{point[1]}" if is_held else f"L{point[0]} {point[1]}")
        before = point
    return "".join(words)


def _draw_band(lower: PlotlyTrace, upper: PlotlyTrace, x: SvgAxis, y: SvgAxis) -> str:
    edge = [p for p in _thin_line(lower, x, y) if None not in p]
    other = [p for p in _thin_line(upper, x, y) if None not in p]
    path = _path_data([*edge, *reversed(other)], {}) + ("Z" if edge and other else "")
    return f'<path d="{path}" fill="{upper.get("fillcolor", "none")}"/>'


def _draw_error_bars(trace: PlotlyTrace, x: SvgAxis, y: SvgAxis) -> Iterator[str]:
    bars = trace.get("error_y")
    if not bars:
        return
    for across, up, reach in zip(trace["x"], trace["y"], bars["array"], strict=True):
        at = x.to_pixel(across)
        ends = (
            [y.to_pixel(up + sign * reach) for sign in (-1, 1)] if up is not None and reach else []
        )
        if at is None or not ends or None in ends:
            continue
        low, high = ends
        yield (
            f'<path d="M{at:.1f} {low:.1f}V{high:.1f}M{at - 4:.1f} {low:.1f}h8'
            f'M{at - 4:.1f} {high:.1f}h8" fill="none" stroke="{bars["color"]}"/>'
        )


def _draw_markers(trace: PlotlyTrace, x: SvgAxis, y: SvgAxis) -> Iterator[str]:
    marker = trace.get("marker", {})
    for i in stride_indices(len(trace["x"]), MAX_MARKERS):
        across, up = x.to_pixel(trace["x"][i]), y.to_pixel(trace["y"][i])
        if across is not None and up is not None:
            shape = _marker_property(marker.get("symbol", "circle"), i)
            colour = _marker_property(marker.get("color", "currentColor"), i)
            yield draw_marker(shape, across, up, 0.5 * marker.get("size", 6), colour)


def _marker_property(value: Any, index: int) -> str:
    return str(value[index] if isinstance(value, list) else value)


def _stroke_attributes(line: Mapping[str, Any]) -> str:
    dash = _DASH_ARRAYS.get(line.get("dash", ""))
    return f'stroke="{line.get("color", "currentColor")}" stroke-width="{line.get("width", 1)}"' + (
        f' stroke-dasharray="{dash}"' if dash else ""
    )


def _lay_out_legend(figure: Figure, width: int) -> Iterator[tuple[float, int, PlotlyTrace]]:
    """Yield left edge (px), row and trace of each legend entry."""
    if figure["layout"].get("showlegend") is False:
        return
    left, row = float(figure["layout"]["margin"]["l"]), 0
    for trace in figure["data"]:
        if not trace.get("showlegend", True):
            continue
        wide = _LEGEND_KEY_PX + 14 + _LETTER_PX * len(_trace_label(trace))
        if left + wide > width and left > figure["layout"]["margin"]["l"]:
            left, row = float(figure["layout"]["margin"]["l"]), row + 1
        yield left, row, trace
        left += wide


def _draw_legend(legend: Sequence[tuple[float, int, PlotlyTrace]]) -> Iterator[str]:
    for left, row, trace in legend:
        y = 12 + row * _LEGEND_ROW_PX
        mode = trace.get("mode", "lines")
        if "lines" in mode:
            yield (
                f'<path d="M{left:.1f} {y}h{_LEGEND_KEY_PX - 6}" '
                f"{_stroke_attributes(trace.get('line', {}))}/>"
            )
        if "markers" in mode:
            marker = trace.get("marker", {})
            yield draw_marker(
                _marker_property(marker.get("symbol", "circle"), 0),
                left + _LEGEND_KEY_PX / 2 - 3,
                y,
                4,
                _marker_property(marker.get("color", "currentColor"), 0),
            )
        yield (
            f'<text x="{left + _LEGEND_KEY_PX:.1f}" y="{y + 4}">'
            f"{escape(_trace_label(trace))}</text>"
        )


def _trace_label(trace: PlotlyTrace) -> str:
    return str(trace.get("name") or trace.get("legendgroup", ""))
