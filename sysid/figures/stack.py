"""Stack figures: draw several one below the other as one figure, each with its title and legend."""

import re
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from typing import Any

from sysid.figures.plotly import MARGIN, Figure, base_layout

_TITLE_PX = 26
_AXIS = re.compile(r"([xy])axis(\d*)")
_REFERENCE = re.compile(r"([xy])(\d*)( domain)?")


def stack_figures(titled: Sequence[tuple[str, Figure]]) -> Figure:
    """Draw figures one below the other; the height is the sum of theirs and of their titles."""
    heights = [figure["layout"]["height"] + _TITLE_PX for _, figure in titled]
    total = sum(heights)
    stacked: Figure = {
        "data": [],
        "layout": base_layout(
            total,
            margin={**_find_sides(figure for _, figure in titled), "t": 0, "b": 0},
            showlegend=True,
            shapes=[],
            annotations=[],
        ),
    }
    del stacked["layout"]["legend"]
    top, used = float(total), {"x": 0, "y": 0}
    for number, ((title, figure), height) in enumerate(zip(titled, heights, strict=True), 1):
        part = _Part(figure, number, top - _TITLE_PX, total, used)
        part.add_to(stacked, title)
        used = part.count_axes()
        top -= height
    return stacked


def _find_sides(figures: Iterable[Figure]) -> dict[str, int]:
    """Find the margins at the sides, the widest of all figures."""
    margins = [figure["layout"].get("margin", MARGIN) for figure in figures]
    return {side: max((margin[side] for margin in margins), default=0) for side in "lr"}


class _Part:
    """One figure of a stack: its position, and the numbers of its axes in the whole.

    The whole has no margin at top and bottom, so that every part keeps its own.
    """

    def __init__(
        self, figure: Figure, number: int, top: float, total: float, used: Mapping[str, int]
    ) -> None:
        self._figure, self._number, self._used = deepcopy(figure), number, used
        self._layout = self._figure["layout"]
        margin = {**MARGIN, **self._layout.get("margin", {})}
        self._title_shift = margin["t"]
        self._top: float = (top - margin["t"]) / total
        self._bottom: float = (top - self._layout["height"] + margin["b"]) / total

    def count_axes(self) -> dict[str, int]:
        """Count the axes that are used up to this part."""
        counts = {
            kind: max([int(m[2] or 1) for m in self._match_axes() if m[1] == kind], default=1)
            for kind in "xy"
        }
        return {kind: self._used[kind] + count for kind, count in counts.items()}

    def add_to(self, stacked: Figure, title: str) -> None:
        """Add traces, axes, shapes, annotations and the legend of this part."""
        layout = stacked["layout"]
        legend = f"legend{self._number if self._number > 1 else ''}"
        layout[legend] = {
            **self._layout["legend"],
            "y": self._upward(self._layout["legend"]["y"]),
            "visible": self._layout.get("showlegend", True),
        }
        stacked["data"] += [self._move_trace(trace, legend) for trace in self._figure["data"]]
        for match in self._match_axes():
            number = self._used[match[1]] + int(match[2] or 1)
            name = f"{match[1]}axis{number if number > 1 else ''}"
            layout[name] = self._move_axis(self._layout[match[0]], match[1])
        layout["shapes"] += [self._move(shape) for shape in self._layout.get("shapes", ())]
        layout["annotations"] += [self._move(note) for note in self._layout.get("annotations", ())]
        layout["annotations"].append(
            {
                "text": f"<b>{title}</b>",
                "xref": "paper",
                "yref": "paper",
                "x": 0,
                "y": self._top,
                "yshift": self._title_shift,
                "xanchor": "left",
                "yanchor": "bottom",
                "showarrow": False,
            }
        )

    def _match_axes(self) -> list[re.Match[str]]:
        matches = (_AXIS.fullmatch(name) for name in self._layout)
        return [match for match in matches if match is not None]

    def _upward(self, share: float) -> float:
        """Convert a share of this part's height to one of the whole."""
        return self._bottom + share * (self._top - self._bottom)

    def _renumber(self, reference: str) -> str:
        match = _REFERENCE.fullmatch(reference)
        if match is None:
            return reference
        number = self._used[match[1]] + int(match[2] or 1)
        return f"{match[1]}{number if number > 1 else ''}{match[3] or ''}"

    def _move_trace(self, trace: Mapping[str, Any], legend: str) -> dict[str, Any]:
        moved = {
            **trace,
            "xaxis": self._renumber(trace.get("xaxis", "x")),
            "yaxis": self._renumber(trace.get("yaxis", "y")),
            "legend": legend,
        }
        if "legendgroup" in trace:
            moved["legendgroup"] = f"{trace['legendgroup']} {self._number}"
        if "colorbar" in trace:
            position = {"y": self._upward(0.5), "len": self._top - self._bottom}
            moved["colorbar"] = {**trace["colorbar"], **position}
        return moved

    def _move_axis(self, axis: Mapping[str, Any], kind: str) -> dict[str, Any]:
        moved = dict(axis)
        if kind == "y":
            moved["domain"] = [self._upward(share) for share in axis.get("domain", (0.0, 1.0))]
        other = "y" if kind == "x" else "x"
        moved["anchor"] = self._renumber(axis.get("anchor", other))
        if "matches" in axis:
            moved["matches"] = self._renumber(axis["matches"])
        return moved

    def _move(self, item: Mapping[str, Any]) -> dict[str, Any]:
        """Move a shape or an annotation; what refers to the paper refers to this part."""
        moved = dict(item)
        for kind in "xy":
            moved[f"{kind}ref"] = self._renumber(item.get(f"{kind}ref", kind))
        if item.get("yref") == "paper":
            heights = {name: self._upward(item[name]) for name in ("y", "y0", "y1") if name in item}
            moved.update(heights)
        return moved
