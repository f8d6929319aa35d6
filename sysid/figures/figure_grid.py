"""Lay out small plots in rows and columns: domains, axes and captions."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Domain = tuple[float, float]
PlotArea = tuple[Domain, Domain]
"""Horizontal and vertical domain of a plot in the figure."""

WIDE_MARGIN = {"l": 72, "r": 16, "t": 36, "b": 6}


@dataclass(frozen=True, slots=True)
class PlotGrid:
    """Layout of small plots; heights are in px or in any other unit.

    Attributes
    ----------
    count, columns : int
        Number of plots, and most plots per row.
    caption, plot, axis : float
        Heights of the parts of a row, from the top.
    gap : float
        Gap between two columns, as a share of the whole width.
    has_last_axis : bool
        Whether the grid has room for the axis of the last row; else the margin has.
    """

    count: int
    columns: int
    caption: float
    plot: float
    axis: float
    gap: float
    has_last_axis: bool = True

    @property
    def n_columns(self) -> int:
        """Plots per row."""
        return max(1, min(self.columns, self.count))

    @property
    def n_rows(self) -> int:
        """Number of rows, at least one."""
        return max(-(-self.count // self.n_columns), 1)

    def height(self, margin: Mapping[str, int]) -> int:
        """Compute the height (px) of the figure, so that a page can reserve its room."""
        return self.n_rows * int(self._row) + margin["t"] + margin["b"]

    def get_area(self, number: int) -> PlotArea:
        """Compute the horizontal and vertical domain of a plot, counted from 0."""
        row, column = divmod(number, self.n_columns)
        width = (1 - self.gap * (self.n_columns - 1)) / self.n_columns
        left = column * (width + self.gap)
        total = self.n_rows * self._row - (0 if self.has_last_axis else self.axis)
        top = 1 - (row * self._row + self.caption) / total
        return (left, min(left + width, 1.0)), (max(top - self.plot / total, 0.0), top)

    @property
    def _row(self) -> float:
        return self.caption + self.plot + self.axis


def wide_grid(count: int, columns: int) -> PlotGrid:
    """Build the grid of figures over a label or σ; their margin is `WIDE_MARGIN`."""
    return PlotGrid(count, columns, caption=30, plot=250, axis=54, gap=0.1)


def add_axes(
    figure: dict[str, Any], number: int, domain: PlotArea, x: dict[str, Any], y: dict[str, Any]
) -> dict[str, str]:
    """Add the axes of a plot, counted from 0; return the axis names for its traces."""
    suffix = "" if number == 0 else str(number + 1)
    across, upward = domain
    figure["layout"][f"xaxis{suffix}"] = {"domain": across, "anchor": f"y{suffix}", **x}
    figure["layout"][f"yaxis{suffix}"] = {"domain": upward, "anchor": f"x{suffix}", **y}
    return {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}"}


def add_caption(figure: dict[str, Any], text: str, domain: PlotArea, shift: int = 4) -> None:
    """Write a caption above a plot, `shift` px away."""
    across, upward = domain
    caption: dict[str, Any] = {
        "text": text,
        "xref": "paper",
        "yref": "paper",
        "x": across[0],
        "y": upward[1],
        "xanchor": "left",
        "yanchor": "bottom",
        "yshift": shift,
        "showarrow": False,
        "align": "left",
    }
    figure["layout"]["annotations"].append(caption)
