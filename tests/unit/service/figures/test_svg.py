"""Figures drawn without a script: places, ticks, and that nothing a user wrote becomes markup."""

import re
from typing import Any
from xml.etree import ElementTree

import pytest

from service.figures.svg import (
    MAX_LINE_POINTS,
    build_axes,
    format_tick,
    is_drawable,
    to_markup,
    to_svg,
)
from sysid.figures.plotly import base_layout

BOX = (100.0, 500.0, 20.0, 220.0)
SVG = "{http://www.w3.org/2000/svg}"


def figure(*traces: dict[str, Any], **more: Any) -> dict[str, Any]:
    shared = {"xaxis": {"title": {"text": "time [s]"}}, "yaxis": {"title": {"text": "y [m]"}}}
    return {
        "data": [{"type": "scatter", **one} for one in traces],
        "layout": base_layout(300, **{**shared, **more}),
    }


def parse_drawing(found: str) -> ElementTree.Element:
    return ElementTree.fromstring(found.replace("<svg ", f'<svg xmlns="{SVG[1:-1]}" ', 1))


def list_texts(found: str) -> list[str]:
    return ["".join(one.itertext()) for one in parse_drawing(found).iter(f"{SVG}text")]


def line(x: list[Any], y: list[Any], **more: Any) -> dict[str, Any]:
    return {"mode": "lines", "name": "line", "x": x, "y": y, "line": {"color": "#123456"}, **more}


def path_of(found: str, colour: str = "#123456") -> str:
    """The longest path of a colour: the line itself, not its key in the legend."""
    paths = re.findall(rf'd="([^"]*)"[^>]*stroke="{colour}"', found)
    return str(max(paths, key=len))


def test_an_axis_puts_its_ends_at_its_edges_and_y_goes_up() -> None:
    axes = build_axes(
        figure(line([0, 10], [0, 1]), xaxis={"range": [0, 10]}, yaxis={"range": [-1, 1]}), BOX
    )
    assert (axes["x"].to_pixel(0), axes["x"].to_pixel(10)) == (100, 500)
    assert (axes["y"].to_pixel(-1), axes["y"].to_pixel(1)) == (220, 20)


def test_a_logarithmic_axis_gives_every_decade_the_same_room() -> None:
    log = {"type": "log"}
    axis = build_axes(figure(line([0, 1, 2], [1, 10, 100]), yaxis=log), BOX)["y"]
    low, middle, high = (axis.to_pixel(10.0**n) for n in range(3))
    assert low is not None
    assert middle is not None
    assert high is not None
    assert low - middle == pytest.approx(middle - high)
    assert axis.to_pixel(0) is None
    assert axis.to_pixel(-1) is None


def test_axes_that_match_have_one_range() -> None:
    made = figure(
        line([0, 1], [0, 1]),
        line([5, 9], [0, 1], xaxis="x2", yaxis="y2"),
        xaxis2={"matches": "x"},
        yaxis2={"anchor": "x2"},
    )
    axes = build_axes(made, BOX)
    assert (axes["x"].low, axes["x"].high) == (axes["x2"].low, axes["x2"].high)


def test_all_points_lie_inside_and_errors_too() -> None:
    bars = {"error_y": {"array": [0.5, 3.0], "color": "#abcdef"}}
    made = figure({**line([0, 1], [1, 2]), "mode": "markers", **bars})
    axis = build_axes(made, BOX)["y"]
    assert axis.low <= 2 - 3
    assert axis.high >= 2 + 3


@pytest.mark.parametrize(
    ("value", "label"),
    [
        (0, "0"),
        (0.05, "0.05"),
        (-2, "−2"),
        (9000, "9000"),
        (20000, "20k"),
        (-1.5e6, "−1.5M"),
        (1e-6, "1·10⁻⁶"),
        (1e15, "1·10¹⁵"),
        (0.1 + 0.2, "0.3"),
    ],
)
def test_ticks_are_written_shortly(value: float, label: str) -> None:
    assert format_tick(value) == label


@pytest.mark.parametrize("span", [1e-12, 0.3, 1.0, 7.3, 1e9])
@pytest.mark.parametrize("start", [0.0, -0.4, 123.0])
def test_an_axis_has_some_ticks_but_not_too_many(span: float, start: float) -> None:
    made = figure(line([0, 1], [start, start + span * max(1.0, abs(start))]))
    ticks = list(build_axes(made, BOX)["y"].tick_positions())
    assert 2 <= len(ticks) <= 9
    assert len({text for _, text in ticks}) == len(ticks) or span == 1e-12
    assert all(20 - 1e-6 <= place <= 220 + 1e-6 for place, _ in ticks)


def test_a_constant_line_is_drawn_at_half_height() -> None:
    found = str(to_svg(figure(line([0, 1], [3, 3])), "flat"))
    _, top, bottom = re.findall(r'class="frame" d="M(\S+) (\S+)V(\S+)H', found)[0]
    middle = (float(top) + float(bottom)) / 2
    assert [float(up) for up in re.findall(r"[ML]\S+ ([\d.]+)", path_of(found))] == [middle] * 2


@pytest.mark.parametrize(("x", "y"), [([], []), ([1], [None])])
def test_of_a_line_without_points_only_the_axes_are_drawn(x: list[Any], y: list[Any]) -> None:
    found = str(to_svg(figure(line(x, y)), "empty"))
    assert {"time [s]", "y [m]", "0", "1"} <= set(list_texts(found))
    assert re.findall(r'd="([^"]*)" fill="none"', found) == [""]


def test_a_gap_parts_the_line() -> None:
    found = str(to_svg(figure(line([0, 1, 2, 3], [0, None, 1, 2])), "gap"))
    assert path_of(found).count("M") == 2


def test_a_held_line_goes_across_then_up() -> None:
    held = {"color": "#123456", "shape": "hv"}
    found = str(to_svg(figure(line([0, 1, 2], [0, 5, 5], line=held)), "held"))
    assert re.fullmatch(r"M[\d. ]+(H[\d.]+V[\d.]+)+", path_of(found))


def test_a_long_line_is_thinned_and_its_spike_stays() -> None:
    values = [0.0] * 20_000
    values[7_777] = 10.0
    made = figure(line(list(range(20_000)), values), yaxis={"range": [0, 10]})
    path = path_of(str(to_svg(made, "spike")))
    assert path.count("L") <= MAX_LINE_POINTS
    top = min(float(place) for place in re.findall(r"[ML][\d.]+ ([\d.]+)", path))
    assert top == pytest.approx(made["layout"]["margin"]["t"])


def test_the_band_is_closed_between_its_edges() -> None:
    fill = {"fill": "tonexty", "fillcolor": "rgba(1,2,3,0.2)", "line": {"width": 0}}
    made = figure(line([0, 1], [0, 0], line={"width": 0}), line([0, 1], [1, 2], **fill))
    [path] = re.findall(r'd="([^"]*)" fill="rgba\(1,2,3,0.2\)"', str(to_svg(made, "band")))
    assert path.endswith("Z")
    assert path.count("L") == 3


def test_title_legend_axes_and_captions_are_written() -> None:
    caption = {"text": "<b>T</b> = 2·x<sup>1.4</sup>", "xref": "paper", "x": 0, "y": 1}
    found = str(to_svg(figure(line([0, 1], [0, 1]), annotations=[caption]), "What it shows"))
    assert {"line", "time [s]", "y [m]", "T = 2·x1.4"} <= set(list_texts(found))
    assert parse_drawing(found).get("aria-label") == "What it shows"


def test_what_is_written_by_a_user_is_no_markup() -> None:
    evil = '<script>alert("1")</script>'
    made = figure(line([0, 1], [0, 1], name=evil), xaxis={"title": {"text": evil}})
    found = str(to_svg(made, evil))
    assert "<script" not in found
    assert evil in list_texts(found)
    assert to_markup("a<b>b</b>&") == 'a<tspan font-weight="600">b</tspan>&amp;'


def test_a_matrix_is_not_drawn() -> None:
    assert not is_drawable({"data": [{"type": "heatmap"}], "layout": {}})
    assert not is_drawable({"data": [], "layout": {}})
    assert is_drawable(figure(line([0], [0])))
