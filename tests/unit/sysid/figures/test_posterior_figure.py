"""The corner plot: its cells, regions and ellipses, and which parameters it shows."""

import numpy as np
import pytest

from service.figures.csv import to_csv
from sysid.figures.data import Floats
from sysid.figures.plotly import Figure
from sysid.figures.posterior_figures import (
    MAX_SHOWN,
    Corner,
    choose_shown,
    estimate_region,
    plot_posterior,
    posterior_height,
)
from sysid.uncertainty.estimates import CorrelationMatrix, Estimate, Posterior, PosteriorParameter


def make_corner(
    name: str, samples: Floats, stderr: float | None = 1.0, bounds: tuple[float, float] = (-9, 9)
) -> Corner:
    low, middle, high = np.quantile(samples, [0.025, 0.5, 0.975])
    interval = None if stderr is None else (-1.96 * stderr, 1.96 * stderr)
    return Corner(
        Estimate(name, "s", 0.0, *bounds, stderr, interval, "identified"),
        PosteriorParameter(name, "s", middle, (low, high), 100.0),
        samples,
    )


def plot(corners: list[Corner], correlation: Floats) -> Figure:
    names = tuple(one.sampled.name for one in corners)
    matrix = CorrelationMatrix(names, correlation)
    samples = np.column_stack([one.samples for one in corners])
    sampled = tuple(one.sampled for one in corners)
    posterior = Posterior(sampled, samples, matrix, 8, 100, 0.4, 800, True, "")
    return plot_posterior(posterior, [one.estimate for one in corners], matrix)


def draw(count: int, n: int = 1000) -> list[Corner]:
    values = np.random.default_rng(1).standard_normal((count, n))
    return [make_corner(f"p{i}", row) for i, row in enumerate(values)]


def test_a_corner_has_a_histogram_of_each_and_a_cell_of_each_pair() -> None:
    figure = plot(draw(3), np.eye(3))
    kinds = [trace["type"] for trace in figure["data"]]
    assert (kinds.count("bar"), kinds.count("contour")) == (3, 3)
    assert figure["layout"]["height"] == posterior_height(3)
    axes = [name for name in figure["layout"] if name.startswith("xaxis")]
    titles = [figure["layout"][name].get("title", {}).get("text") for name in axes]
    assert [title for title in titles if title] == ["p0 [s]", "p1 [s]", "p2 [s]"]
    legend = [trace["name"] for trace in figure["data"] if trace["showlegend"]]
    assert sorted(legend) == [
        "95 % ellipse of the standard errors",
        "95 % region",
        "estimate",
        "samples",
    ]


def test_the_region_holds_95_percent_of_the_samples() -> None:
    pair = draw(2)
    x, y, density, level = estimate_region(*pair)
    columns = np.searchsorted(x, pair[0].samples).clip(1, x.size - 1)
    rows = np.searchsorted(y, pair[1].samples).clip(1, y.size - 1)
    inside = density[rows, columns] >= level
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)
    # A normal law of two dimensions has its region inside the radius 2.45.
    radius = np.hypot(pair[0].samples, pair[1].samples)
    assert np.mean(inside[radius < 2.2]) > 0.98
    assert np.mean(inside[radius > 3.0]) < 0.1


def test_the_region_ends_at_the_bounds() -> None:
    samples = np.abs(np.random.default_rng(1).standard_normal(500))
    x, _, _, _ = estimate_region(make_corner("L", samples, bounds=(0.0, 9.0)), *draw(1, 500))
    assert x[0] == 0.0


def test_a_parameter_without_standard_error_has_no_ellipse() -> None:
    first, second = draw(2)
    names = {trace["name"] for trace in plot([first, second], np.eye(2))["data"]}
    assert "95 % ellipse of the standard errors" in names
    bare = make_corner("p1", second.samples, None)
    names = {trace["name"] for trace in plot([first, bare], np.eye(2))["data"]}
    assert "95 % ellipse of the standard errors" not in names


def test_the_ellipse_has_the_correlation_of_the_estimates() -> None:
    figure = plot(draw(2), np.array([[1.0, 0.8], [0.8, 1.0]]))
    (ellipse,) = [trace for trace in figure["data"] if "ellipse" in trace["name"]]
    assert np.corrcoef(ellipse["x"], ellipse["y"])[0, 1] == pytest.approx(0.8, abs=0.03)
    assert max(ellipse["x"]) == pytest.approx(2.448, abs=0.01)


def test_of_many_parameters_the_most_correlated_are_shown_in_their_order() -> None:
    many = draw(MAX_SHOWN + 2)
    many[3] = make_corner("p3", -many[7].samples + 0.1 * many[3].samples)
    shown = choose_shown(many)
    assert len(shown) == MAX_SHOWN
    assert {3, 7} <= set(shown)
    assert shown == sorted(shown)
    title = plot(many, np.eye(len(many)))["layout"]["title"]["text"]
    assert title == f"the {MAX_SHOWN} most correlated of {MAX_SHOWN + 2} parameters"


def test_samples_that_are_all_equal_are_drawn_without_a_region() -> None:
    figure = plot([make_corner("p0", np.ones(50)), *draw(1, 50)], np.eye(2))
    assert not any(trace["type"] == "contour" for trace in figure["data"])


def test_without_samples_the_figure_is_empty() -> None:
    assert plot_posterior(None, [], None)["data"] == []


def test_the_csv_has_the_samples_and_no_contour() -> None:
    lines = to_csv(plot(draw(2), np.eye(2))).splitlines()
    assert lines[0] == "series,x,y"
    assert {len(line.split(",")) for line in lines} == {3}
