"""Figures one below the other: each keeps its traces and its place, and nothing overlaps."""

import re
from itertools import pairwise

import numpy as np
import plotly.graph_objects as go

from sysid.figures import plotly
from sysid.figures.data import (
    CorrelationTrace,
    ExperimentTraces,
    OutputTraces,
    SignalTrace,
)
from sysid.figures.plotly import Figure
from sysid.figures.residual_figures import plot_residuals
from sysid.figures.signal_figures import plot_response
from sysid.figures.stack import stack_figures
from sysid.search.state import IslandSummary
from sysid.uncertainty.estimates import CorrelationMatrix

T = np.linspace(0.0, 1.0, 30)


def compute_response() -> Figure:
    output = OutputTraces(SignalTrace("y", "bar", T, T), T + 0.1)
    return plot_response(
        ExperimentTraces("one", (output,), (SignalTrace("u", "1", T, T),), validation_from=0.7)
    )


def compute_residuals() -> Figure:
    band = np.full(9, 0.2)
    lags = np.arange(9.0)
    one = CorrelationTrace("white: passed", True, 0.1, lags, 0.1 * np.cos(lags), band, 1.3 * band)
    return plot_residuals([one, one])


ISLANDS = [IslandSummary(0.4, 0.3, (), 1), IslandSummary(0.5, None, (), 1)]
CORRELATION = CorrelationMatrix(("K", "T"), np.eye(2))


def parts() -> list[tuple[str, Figure]]:
    return [
        ("Response", compute_response()),
        ("Residuals", compute_residuals()),
        ("Correlation", plotly.plot_correlation(CORRELATION)),
        ("Waterfall", plotly.plot_waterfall(ISLANDS, "bar")),
    ]


def axis_name(reference: str) -> str:
    return f"{reference[0]}axis{reference[1:]}"


def bands(figure: Figure) -> list[tuple[float, float]]:
    """Lowest and highest place of every part, by the legends that stand at their tops."""
    layout = figure["layout"]
    tops = [layout[f"legend{'' if n == 0 else n + 1}"]["y"] for n in range(4)]
    domains = [axis["domain"] for name, axis in layout.items() if name.startswith("yaxis")]
    return [
        (
            min(low for low, high in domains if high <= top + 1e-9 and high > following),
            top,
        )
        for top, following in zip(tops, [*tops[1:], -1.0], strict=True)
    ]


def test_every_trace_stays_and_has_its_axes_and_legend() -> None:
    stacked = stack_figures(parts())
    before = [trace for _, figure in parts() for trace in figure["data"]]
    assert len(stacked["data"]) == len(before)
    for trace, original in zip(stacked["data"], before, strict=True):
        assert trace["x"] == original["x"]
        assert axis_name(trace["xaxis"]) in stacked["layout"]
        assert axis_name(trace["yaxis"]) in stacked["layout"]
        assert trace["legend"] in stacked["layout"]


def test_parts_follow_one_another_without_overlap() -> None:
    placed = bands(stack_figures(parts()))
    for (low, high), (_, high_below) in pairwise(placed):
        assert 0.0 <= high_below < low < high <= 1.0


def test_every_plot_keeps_its_height() -> None:
    stacked = stack_figures(parts())["layout"]
    assert stacked["height"] > sum(figure["layout"]["height"] for _, figure in parts())
    alone = compute_response()["layout"]
    margin = alone["margin"]
    room = alone["height"] - margin["t"] - margin["b"]
    for name in ("yaxis", "yaxis2", "yaxis3"):
        low, high = alone[name]["domain"]
        stacked_low, stacked_high = stacked[name]["domain"]
        height = (stacked_high - stacked_low) * stacked["height"]
        assert np.isclose(height, (high - low) * room)


def test_axes_of_parts_are_their_own() -> None:
    stacked = stack_figures(parts())
    axes = [
        {trace["yaxis"] for trace in stacked["data"] if trace["legend"] == name}
        for name in ("legend", "legend2", "legend3", "legend4")
    ]
    assert all(axes)
    assert sum(map(len, axes)) == len(set().union(*axes))


def test_shapes_and_captions_move_with_their_part() -> None:
    stacked = stack_figures(parts())["layout"]
    (low, high), *_ = bands(stack_figures(parts()))
    [shade] = [shape for shape in stacked["shapes"] if shape["type"] == "rect"]
    assert shade["xref"] == "x"
    assert (shade["y0"], shade["y1"]) == (low, high)
    titles = [note["text"] for note in stacked["annotations"] if note["text"].startswith("<b>")]
    assert titles == [
        "<b>Response</b>",
        "<b>Residuals</b>",
        "<b>Correlation</b>",
        "<b>Waterfall</b>",
    ]
    captions = [note for note in stacked["annotations"] if note["text"] == "white: passed"]
    second = bands(stack_figures(parts()))[1]
    assert all(second[0] < note["y"] <= second[1] for note in captions)


def test_the_parts_are_not_changed() -> None:
    given = parts()
    stack_figures(given)
    assert [figure for _, figure in given] == [figure for _, figure in parts()]


def test_plotly_accepts_the_stack() -> None:
    figure = go.Figure(stack_figures(parts()))
    assert len([name for name in figure.to_dict()["layout"] if re.match(r"yaxis\d*$", name)]) == 7
