"""Figure and table of the residual tests, and what pages show beside the estimates."""

import json
import math
import re
from typing import Any

import numpy as np
import pytest

from service.figures.csv import to_csv
from service.pages.render import template_environment
from service.pages.result_filters import describe_onset, format_excess_bic, format_onset_text
from sysid.core.text import format_p_value
from sysid.figures.data import CorrelationTrace
from sysid.figures.residual_figures import plot_residuals, residuals_height
from sysid.residuals.onset_delay import OnsetDelay
from sysid.residuals.residual_tests import ResidualTest, ResidualTests
from sysid.results.parts import OrderComparison, OrderFit


def make_trace(
    *, is_auto: bool = True, period: float | None = 0.1, spike: float = 0.0
) -> CorrelationTrace:
    lags = np.arange(0.0 if is_auto else -25.0, 26.0)
    values = 0.01 * np.cos(lags)
    values[-3] += spike
    if is_auto:
        values[0] = 1.0
    band = np.full(lags.size, 0.05)
    return CorrelationTrace("of y", is_auto, period, lags, values, band, 1.3 * band)


def bars(figure: dict[str, Any]) -> list[dict[str, Any]]:
    return [one for one in figure["data"] if one["type"] == "bar"]


def test_every_function_is_drawn_over_its_bands_and_lag_0_of_an_autocorrelation_is_not() -> None:
    figure = plot_residuals([make_trace(), make_trace(is_auto=False)])
    first, second = bars(figure)
    assert first["x"] == list(range(1, 26))
    assert second["x"] == list(range(-25, 26))
    assert {one["name"] for one in figure["data"]} == {"of y", "95 % band", "99 % band"}
    reach = figure["layout"]["yaxis"]["range"][1]
    assert 0.065 < reach < 0.2


def test_a_lag_outside_the_band_has_another_colour_and_stays_in_sight() -> None:
    figure = plot_residuals([make_trace(spike=0.4)])
    colours = bars(figure)[0]["marker"]["color"]
    assert len(set(colours)) == 2
    assert colours.count(colours[-3]) == 1
    assert figure["layout"]["yaxis"]["range"][1] > 0.4


@pytest.mark.parametrize("count", [1, 2, 3, 7])
@pytest.mark.parametrize("columns", [1, 2])
def test_the_plots_lie_inside_the_figure_and_apart(count: int, columns: int) -> None:
    figure = plot_residuals([make_trace()] * count, columns)
    shown = figure["layout"]
    assert shown["height"] == residuals_height(count, columns)
    axes = [str(k) if k > 1 else "" for k in range(1, count + 1)]
    boxes = [(*shown[f"xaxis{k}"]["domain"], *shown[f"yaxis{k}"]["domain"]) for k in axes]
    assert all(0 <= low < high <= 1 for box in boxes for low, high in (box[:2], box[2:]))
    for i, (left, right, bottom, top) in enumerate(boxes):
        for other in boxes[i + 1 :]:
            assert right < other[0] or other[1] < left or bottom > other[3] or top < other[2]


def test_without_functions_there_is_nothing_to_draw() -> None:
    assert plot_residuals([])["data"] == []


def test_the_axis_says_what_a_lag_is() -> None:
    title = plot_residuals([make_trace()])["layout"]["xaxis"]["title"]["text"]
    assert title == "lag [samples of 0.1 s]"
    assert (
        plot_residuals([make_trace(period=None)])["layout"]["xaxis"]["title"]["text"]
        == "lag [samples]"
    )


def test_the_figure_is_json_and_its_numbers_are_csv() -> None:
    figure = plot_residuals([make_trace(), make_trace(is_auto=False)])
    json.dumps(figure, allow_nan=False)
    rows = to_csv(figure).splitlines()
    assert rows[0] == "series,x,y"
    assert sum(row.startswith("of y,") for row in rows) == 25 + 51


def test_a_test_that_was_not_made_says_why() -> None:
    reason = "the input is constant"
    untested = ResidualTest(0, "y", "independence", "u", "not tested", 0, reason=reason)
    parts = template_environment().get_template("parts.html").module
    row = parts.residual_tests([untested])  # type: ignore[attr-defined]
    assert "independent of u" in row
    assert 'data-label="p">–</td>' in row
    assert "not tested" in row
    assert reason in row
    tests = ResidualTests("estimation", None, (untested,))
    assert "not tested" in parts.residual_verdict(tests)  # type: ignore[attr-defined]
    assert parts.residual_verdict(ResidualTests("estimation", None, ())) == ""  # type: ignore[attr-defined]


def test_onset_delays_tell_steps_and_spread_or_the_reason() -> None:
    known = OnsetDelay(0, "u", "y", 0.129, 0.005, 9, 0.02)
    unknown = OnsetDelay(0, "u", "y", None, reason="it does not rest")
    assert re.fullmatch(r"0\.1290\s*s", format_onset_text(known))
    assert describe_onset(known).startswith("9 steps, spread 0.0050")
    assert format_onset_text(unknown) == ""
    assert describe_onset(unknown) == "it does not rest"


@pytest.mark.parametrize(("p", "text"), [(None, "–"), (0.0, "< 0.001"), (0.0414, "0.041")])
def test_chances(p: float | None, text: str) -> None:
    assert format_p_value(p) == text


def test_orders_are_shown_by_the_difference_of_bic_also_where_one_has_none() -> None:
    fits = [
        OrderFit(f"m{n}", 1, 1.0, None, {}, 1.0, bic)
        for n, bic in enumerate([-30.0, -24.5, -math.inf])
    ]
    orders = OrderComparison("m0", "m0", "L", "s", (1.0, 1.0), "white", tuple(fits))
    assert [format_excess_bic(fit, orders) for fit in fits] == ["0.0", "5.5", "–"]
