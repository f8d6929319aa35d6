import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.figures.csv import to_csv
from sysid.core.findings import note
from sysid.core.settings import LossKind
from sysid.figures import plotly, signal_figures
from sysid.figures.data import (
    ExperimentTraces,
    OutputTraces,
    SearchTraces,
    SignalTrace,
)
from sysid.figures.theme import (
    MAX_POINTS,
    SERIES_COLOURS,
    SERIES_DASHES,
    series_style,
    stride_indices,
    thin_indices,
    window_slice,
)
from sysid.models.parameters import Parameter
from sysid.results.figures import label_fitness
from sysid.search.state import Improvement, IslandSummary
from sysid.uncertainty.estimates import CorrelationMatrix, Estimate


def make_island(points: int, start: float = 100.0) -> list[Improvement]:
    return [
        Improvement(n, 50 * n, start * 0.99**n, "sequence" if n % 5 == 4 else "genetic", (n / 10,))
        for n in range(points)
    ]


LAG = Estimate("L", "s", 0.1127, 0.0, 0.5, 0.0002, (0.1123, 0.1131), "identified")
CORRELATION = CorrelationMatrix(("T", "L"), np.array([[1.0, -0.7], [-0.7, 1.0]]))


def make_islands(*reached: tuple[float, float | None]) -> list[IslandSummary]:
    return [IslandSummary(champion, refined, (), 1) for champion, refined in reached]


ISLANDS = make_islands((2.0, 1.1), (1.5, 1.0), (9.0, None))


def run(**more: object) -> SearchTraces:
    known = {
        "generations": 400,
        "parameters": [Parameter("L", 0.0, 0.5, "s")],
        "estimates": {"L": LAG},
        "history": [make_island(30), make_island(20, 80.0)],
        "epoch": 25,
        "migrations": [1, 2, 3],
    }
    return SearchTraces("kPa", **{**known, **more})  # type: ignore[arg-type]


def make_signal(samples: int, name: str = "y") -> SignalTrace:
    times = np.arange(samples) * 0.01
    return SignalTrace(name, "V", times, np.sin(times))


def make_experiment(samples: int, since: float | None = None) -> ExperimentTraces:
    measured = make_signal(samples)
    outputs = (OutputTraces(measured, measured.values + 0.5),)
    return ExperimentTraces("record 1", outputs, (make_signal(samples, "u"),), since)


def drawn(figure: plotly.Figure, name: str) -> dict[str, Any]:
    return next(trace for trace in figure["data"] if trace.get("name") == name)


@pytest.mark.parametrize(
    "figure",
    [
        plotly.plot_history(run()),
        plotly.plot_history(SearchTraces("V")),
        plotly.plot_convergence(run()),
        plotly.plot_convergence(SearchTraces("V")),
        plotly.plot_correlation(CORRELATION),
        plotly.plot_correlation(None),
        plotly.plot_waterfall(ISLANDS, "V"),
        plotly.plot_waterfall([], "V"),
    ],
)
def test_every_figure_is_json_without_nan(figure: plotly.Figure) -> None:
    assert json.loads(json.dumps(figure, allow_nan=False))["layout"]["height"] > 0


def test_a_history_has_a_line_per_island_on_a_log_axis_with_its_unit() -> None:
    figure = plotly.plot_history(run())
    lines = [trace for trace in figure["data"] if trace["mode"] == "lines"]
    assert [line["name"] for line in lines] == ["island 1", "island 2"]
    assert figure["layout"]["yaxis"]["type"] == "log"
    assert figure["layout"]["yaxis"]["title"]["text"] == "RMS [kPa]"


def test_the_axis_of_a_number_without_dimension_names_no_unit() -> None:
    for figure in (
        plotly.plot_history(replace(run(), unit="1")),
        plotly.plot_waterfall(ISLANDS, "1"),
    ):
        assert figure["layout"]["yaxis"]["title"]["text"] == "RMS"


@pytest.mark.parametrize(("smallest", "digits"), [(0.5, None), (0.05, "D2"), (1e-6, None)])
def test_digits_of_a_log_axis_do_not_lie_upon_each_other(
    smallest: float, digits: str | None
) -> None:
    reached = make_islands((1.0, None), (1.0, smallest))
    axis = plotly.plot_waterfall(reached, "kPa")["layout"]["yaxis"]
    assert axis.get("dtick") == digits


def test_a_history_line_goes_on_to_the_last_generation_at_its_last_value() -> None:
    line = drawn(plotly.plot_history(run()), "island 2")
    assert line["x"][-1] == 400
    assert line["y"][-1] == line["y"][-2]


def test_a_history_over_evaluations_has_the_evaluations_as_abscissa() -> None:
    figure = plotly.plot_history(run(), "evaluations")
    assert drawn(figure, "island 1")["x"][:3] == [0, 50, 100]
    assert figure["layout"]["shapes"] == []


def test_the_phases_of_a_history_are_marked_where_they_improved() -> None:
    marks = drawn(plotly.plot_history(run()), "sequence")
    assert marks["x"] == [4, 9, 14, 19, 24, 29, 4, 9, 14, 19]


def test_migrations_stand_at_the_end_of_their_epochs() -> None:
    shapes = plotly.plot_history(run())["layout"]["shapes"]
    assert [shape["x0"] for shape in shapes] == [25, 50, 75]


@pytest.mark.parametrize("points", [999, 1000, 1001, 50_000])
def test_no_line_of_a_history_or_convergence_has_over_a_thousand_points(points: int) -> None:
    evidence = run(history=[make_island(points)], generations=10 * points)
    for figure in (plotly.plot_history(evidence), plotly.plot_convergence(evidence)):
        assert all(len(trace["x"]) <= MAX_POINTS for trace in figure["data"])


def test_a_parameter_is_drawn_between_its_bounds_and_its_caption_has_its_error() -> None:
    figure = plotly.plot_convergence(run())
    low, high = figure["layout"]["yaxis"]["range"]
    assert low < 0.0 < 0.5 < high
    assert [shape["y0"] for shape in figure["layout"]["shapes"]] == [0.0, 0.5]
    assert figure["layout"]["annotations"][0]["text"] == "<b>L</b> = 0.11270 ± 0.00020 s"


def test_a_parameter_over_decades_has_a_log_axis() -> None:
    sought = Parameter("T", 0.01, 100.0, "s", "log")
    axis = plotly.plot_convergence(run(parameters=[sought]))["layout"]["yaxis"]
    assert axis["type"] == "log"
    assert axis["range"][0] < -2 < 2 < axis["range"][1]


@pytest.mark.parametrize("count", [1, 2, 3, 5, 12])
@pytest.mark.parametrize("columns", [1, 2, 3])
def test_small_plots_lie_inside_the_figure_and_beside_each_other(count: int, columns: int) -> None:
    sought = [Parameter(f"p{n}", 0.0, 1.0) for n in range(count)]
    history = [[Improvement(0, 0, 1.0, "genetic", (0.5,) * count)]]
    layout = plotly.plot_convergence(run(parameters=sought, history=history), columns)["layout"]
    boxes = []
    for n in range(count):
        axis = "" if n == 0 else str(n + 1)
        boxes.append((*layout[f"xaxis{axis}"]["domain"], *layout[f"yaxis{axis}"]["domain"]))
    for left, right, bottom, top in boxes:
        assert 0 <= left < right <= 1
        assert 0 <= bottom < top <= 1
    for i, a in enumerate(boxes):
        for b in boxes[i + 1 :]:
            assert a[1] <= b[0] or b[1] <= a[0] or a[3] <= b[2] or b[3] <= a[2]


def test_the_waterfall_puts_the_best_island_first() -> None:
    after = drawn(plotly.plot_waterfall(ISLANDS, "kPa"), "after refinement")
    assert after["text"] == ["island 2", "island 1", "island 3"]
    assert after["y"] == [1.0, 1.1, None]


def test_a_response_shows_measured_minus_identified_as_residual() -> None:
    figure = signal_figures.plot_response(make_experiment(50))
    assert drawn(figure, "residual")["y"] == [-0.5] * 50


def test_every_row_of_a_response_has_the_same_time_axis() -> None:
    figure = signal_figures.plot_response(make_experiment(50))
    assert all("xaxis" not in trace for trace in figure["data"])
    assert {trace["yaxis"] for trace in figure["data"]} == {"y", "y2", "y3"}


def test_validation_is_shaded_from_its_first_sample_to_the_last() -> None:
    shape = signal_figures.plot_response(make_experiment(100, since=0.7))["layout"]["shapes"][0]
    assert (shape["x0"], shape["x1"]) == (0.7, 0.99)


def test_a_record_kept_for_validation_is_shaded_from_its_start() -> None:
    shape = signal_figures.plot_response(make_experiment(100, since=-math.inf))["layout"]["shapes"][
        0
    ]
    assert shape["x0"] == 0.0


def before_record(name: str, known: SignalTrace) -> ExperimentTraces:
    return replace(make_experiment(100), inputs=(replace(make_signal(100, name), history=known),))


def test_what_an_input_was_before_the_record_is_dotted_as_far_as_a_tenth_of_it() -> None:
    times = np.arange(-50, 0) * 0.01
    record = before_record("u", SignalTrace("u", "V", times, np.cos(times)))
    trace = drawn(signal_figures.plot_response(record), "u, before the record")
    assert trace["x"] == pytest.approx(times[-9:])
    assert trace["yaxis"] == drawn(signal_figures.plot_response(record), "u")["yaxis"]
    assert trace["line"]["dash"] == "dot"  # type: ignore[index]
    whole = drawn(signal_figures.plot_signals(record.inputs), "u, before the record")
    assert whole["x"] == pytest.approx(times)
    names = [one["name"] for one in signal_figures.plot_response(make_experiment(100))["data"]]
    assert not any("before the record" in name for name in names)


def test_a_long_response_is_thinned_and_a_stretch_of_it_is_not() -> None:
    record = make_experiment(20_000)
    whole = signal_figures.plot_response(record)
    part = signal_figures.plot_response(record, 50.0, 53.0)
    assert all(len(trace["x"]) <= MAX_POINTS for trace in whole["data"])
    assert whole["layout"]["meta"]["thinned"]
    inside = [x for x in drawn(part, "measured")["x"] if 50.0 <= x <= 53.0]
    assert len(inside) == 301


def test_pooled_samples_are_drawn_as_points() -> None:
    times = np.repeat(np.arange(500) * 0.01, 4)
    output = OutputTraces(SignalTrace("y", "1", times, times), times)
    figure = signal_figures.plot_response(ExperimentTraces("record 1", (output,), ()))
    assert drawn(figure, "measured")["mode"] == "markers"


def test_the_heights_that_a_page_reserves_are_those_of_the_figures() -> None:
    assert signal_figures.plot_response(make_experiment(9))["layout"][
        "height"
    ] == signal_figures.response_height(1, 1)
    assert signal_figures.plot_signals([make_signal(9), make_signal(9)])["layout"][
        "height"
    ] == signal_figures.signals_height(2)
    assert plotly.plot_convergence(run(), 3)["layout"]["height"] == plotly.convergence_height(1, 3)
    assert plotly.plot_correlation(CORRELATION)["layout"]["height"] == plotly.correlation_height(2)


def test_the_numbers_of_a_figure_are_one_row_each_in_csv() -> None:
    lines = to_csv(signal_figures.plot_signals([make_signal(3, "a,b")])).splitlines()
    assert lines[0] == "series,x,y"
    assert lines[1:3] == ['"a,b",0.0,0.0', '"a,b",0.01,0.009999833']
    assert to_csv(plotly.plot_correlation(CORRELATION)).splitlines()[2] == ",L,T,-0.7"
    line = to_csv(signal_figures.plot_signals([make_signal(3, "=1+1")])).splitlines()[1]
    assert line.startswith("'=1+1")  # no formula in a spreadsheet


def test_a_figure_in_the_dark_has_the_same_data() -> None:
    light = plotly.plot_history(run())
    dark = plotly.apply_theme(light, "dark")
    assert dark["data"] == light["data"]
    assert dark["layout"]["template"] != light["layout"]["template"]


def test_no_two_of_the_first_islands_look_alike() -> None:
    styles = [(style["color"], style["dash"]) for style in map(series_style, range(24))]
    assert len(set(styles)) == len(SERIES_COLOURS) * len(SERIES_DASHES)


def test_thinning_keeps_the_ends_and_a_spike_of_one_sample() -> None:
    values = np.zeros(100_000)
    values[77_777] = 5.0
    kept = thin_indices(values)
    assert {0, 77_777, 99_999} <= set(kept.tolist())
    assert kept.size <= MAX_POINTS
    assert np.all(np.diff(kept) > 0)


def test_thinning_passes_over_missing_values() -> None:
    values = np.full(5000, np.nan)
    values[2500] = 1.0
    assert 2500 in thin_indices(values)


def test_strides_keep_first_and_last() -> None:
    assert stride_indices(3).tolist() == [0, 1, 2]
    assert stride_indices(7777)[[0, -1]].tolist() == [0, 7776]
    assert stride_indices(7777).size <= MAX_POINTS


def test_a_window_has_one_sample_more_at_each_side() -> None:
    times = np.arange(10.0)
    assert window_slice(times, 3.0, 5.0) == slice(2, 7)
    assert window_slice(times, None, None) == slice(0, 10)
    assert window_slice(times, -5.0, 50.0) == slice(0, 10)


def test_a_robust_loss_is_not_called_the_rms() -> None:
    def name_axes(loss: LossKind) -> set[str]:
        label = label_fitness(loss)
        history = plotly.plot_history(run(fitness_label=label))
        waterfall = plotly.plot_waterfall(ISLANDS, "kPa", label)
        return {figure["layout"]["yaxis"]["title"]["text"] for figure in (history, waterfall)}

    assert name_axes("soft-l1") == {"soft-l1 loss, as RMS [kPa]"}
    assert name_axes("squares") == {"RMS [kPa]"}


def test_what_happened_to_a_record_is_marked_in_the_plot_of_its_channel() -> None:
    event = replace(note("outage", "record", "silent"), channels=("y",), spans=((0.0, 0.1),))
    u, y = make_signal(9, "u"), make_signal(9, "y")
    layout = signal_figures.plot_signals([u, y], findings=[event])["layout"]
    (mark,), (name,) = layout["shapes"], layout["annotations"]
    assert (mark["x0"], mark["x1"], mark["yref"]) == (0.0, 0.1, "y2 domain")
    assert name["text"] == "outage"
    assert "shapes" not in signal_figures.plot_signals([u, y])["layout"]
