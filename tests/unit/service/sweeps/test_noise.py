"""What the command line of the noise sweep reads and prints, and what its figure draws."""

import numpy as np
import pytest
import typer

from service.cli.sweep_command import build_sweep_tables, parse_sigma_grid
from service.figures.noise_figure import QUANTILE_95, noise_group_keys, plot_noise_sweep
from service.sweeps.group_cramer_rao import StoredBounds, scale_to_sigma
from service.sweeps.sweep_schemas import GroupOut, ParameterSummaryOut, SummaryOut
from sysid.figures.theme import SERIES_DASHES

SIGMAS = (0.0, 0.5, 1.0)


def group(sigma, method, scale=1.0, **changes):
    quantiles = [scale * sigma * q for q in (0.1, 0.3, 0.5, 0.7, 0.9)]
    error = [q - 0.4 * scale * sigma for q in quantiles]
    parameter = ParameterSummaryOut(
        name="L",
        unit="s",
        value=[2.0 + one for one in error],
        stderr=0.1,
        reference=2.0,
        error=error,
        cramer_rao_bound=0.25 * sigma,
    )
    known = {
        "key": {"/noise/sigma": sigma, "/algorithm/method": method},
        "runs": 10,
        "succeeded": 8,
        "failed": 2,
        "success_rate": 0.8,
        "sigma": sigma,
        "evaluations": 1234.4,
        "seconds": 0.1,
        "rms": quantiles,
        "rms_noise_free": quantiles,
        "rms_cramer_rao_bound": 0.2 * sigma,
        "fit_percent": {},
        "parameters": [parameter],
    }
    return GroupOut(**{**known, **changes})


def read_summary(groups):
    return SummaryOut(
        job="job_1",
        by=["/noise/sigma", "/algorithm/method"],
        quantiles=[0.05, 0.25, 0.5, 0.75, 0.95],
        groups=groups,
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0:1:0.05", [i / 20 for i in range(21)]),
        ("0:0.3:0.1", [0.0, 0.1, 0.2, 0.3]),
        ("0:1:0.3", [0.0, 0.3, 0.6, 0.9]),
        ("0.5", [0.5]),
        (" 0, 1e-3 ,2", [0.0, 0.001, 2.0]),
        ("0:0.2:0.1,1", [0.0, 0.1, 0.2, 1.0]),
        ("1:1:1", [1.0]),
    ],
)
def test_a_grid_has_exactly_the_numbers_that_are_written(text, expected):
    assert parse_sigma_grid(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "",
        ",",
        "a",
        "0:1",
        "0:1:0",
        "0:1:-0.1",
        "1:0:0.1",
        "0:1:0.1:2",
        "nan",
        "0:inf:1",
        "0:1:1e-9",
    ],
)
def test_a_grid_that_cannot_be_read_is_one_line_and_exit_code_2(text, capsys):
    with pytest.raises(typer.Exit) as ended:
        parse_sigma_grid(text)
    assert ended.value.exit_code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_the_tables_have_a_row_for_each_group_and_at_most_four_parameters_each():
    names = "abcdefghi"
    one = group(0.5, "simple")
    many = [one.parameters[0].model_copy(update={"name": name}) for name in names]
    found = build_sweep_tables(
        read_summary([one.model_copy(update={"parameters": many})] * 3).model_dump()
    )
    assert [len(rows) for _, rows in found] == [3] * 4
    for headings, rows in found:
        assert all(len(row) == len(headings) for row in rows)
    assert [sum("error [" in one for one in headings) for headings, _ in found] == [1, 4, 4, 1]
    assert found[0][1][0] == ["0.5", "simple", "10", "80 %", "1234", "0.25 [0.05, 0.45]", "0.096"]
    assert found[1][1][0][2:4] == ["+0.05 [-0.15, +0.25]", "0.12"]


@pytest.mark.parametrize(
    ("unit", "sigma", "error"),
    [
        ("m", ">σ [m]", "RMS error in m [5 %, 95 %]"),
        ("1", ">σ", "RMS error [5 %, 95 %]"),
        ("σ", ">σ", "RMS error in σ [5 %, 95 %]"),
    ],
)
def test_the_noise_and_the_error_of_the_response_have_the_unit_of_the_output(unit, sigma, error):
    told = read_summary([group(0.5, "simple")]).model_copy(update={"rms_unit": unit})
    headings, _ = build_sweep_tables(told.model_dump())[0]
    assert headings[0] == sigma
    assert error in headings


def test_of_a_relative_sigma_what_was_typed_stands_beside_what_it_is_in_the_outputs_unit():
    one = group(0.1698, "simple")
    key = {"relative": 0.1, **one.key}
    told = read_summary([one.model_copy(update={"key": key})]).model_copy(
        update={"by": list(key), "rms_unit": "m"}
    )
    for headings, rows in build_sweep_tables(told.model_dump()):
        assert headings[:3] == [">relative σ", ">σ [m]", "method"]
        assert rows[0][:3] == ["0.1", "0.1698", "simple"]


@pytest.mark.parametrize(
    ("reference", "is_told"),
    [
        ({"kind": "estimate", "sigma": 0.0}, True),
        ({"kind": "estimate", "sigma": 0.1}, False),
        ({"kind": "truth"}, False),
        (None, False),
    ],
)
def test_a_row_without_noise_is_explained_where_errors_are_told_against_it(reference, is_told):
    problem = {"cell": {}, "reference": reference, "note": ""}
    notes = list(StoredBounds({"problems": [problem]}).list_notes())
    assert is_told == any("without added noise" in one for one in notes)


def test_what_is_not_known_is_a_dash():
    blank = ParameterSummaryOut(name="L", unit="s", value=[0.0] * 5, stderr=None)
    waiting = group(
        0.5,
        "simple",
        succeeded=0,
        failed=0,
        evaluations=None,
        rms_noise_free=None,
        rms_cramer_rao_bound=None,
        parameters=[blank],
    )
    first, second = (
        rows[0] for _, rows in build_sweep_tables(read_summary([waiting]).model_dump())
    )
    assert first == ["0.5", "simple", "0/10", "–", "–", "–", "–"]
    assert second == ["0.5", "simple", "–", "–"]


def lines(figure, axis, dash=None):
    return [
        one
        for one in figure["data"]
        if one["xaxis"] == axis and one["line"].get("dash") == dash and one["line"]["width"] > 0
    ]


def test_each_plot_has_a_median_and_a_band_for_each_method():
    groups = [group(s, m, 1 + n) for s in SIGMAS for n, m in enumerate(("simple", "improved"))]
    figure = plot_noise_sweep(read_summary(groups), "m")
    for axis in ("x", "x2"):
        medians = [
            one for one in figure["data"] if one["xaxis"] == axis and one["mode"] == "lines+markers"
        ]
        bands = [one for one in figure["data"] if one["xaxis"] == axis and "fill" in one]
        assert [one["legendgroup"] for one in medians] == ["simple", "improved"]
        assert [one["legendgroup"] for one in bands] == ["simple", "improved"]
        assert all(one["x"] == list(SIGMAS) for one in medians + bands)
    shown = [one["name"] for one in figure["data"] if one["showlegend"]]
    assert len(shown) == len(set(shown)) == 3
    assert figure["layout"]["yaxis"]["title"]["text"] == "RMS error [m]"


def test_the_bound_of_a_parameter_is_drawn_at_the_quantiles_of_the_band():
    figure = plot_noise_sweep(read_summary([group(s, "improved") for s in SIGMAS]), "m")
    assert "dash" in SERIES_DASHES
    (response,) = lines(figure, "x", "dash")
    median = np.median(np.random.default_rng(1).chisquare(1, 100_000)) ** 0.5  # one parameter
    assert response["y"] == pytest.approx([0.2 * s * median for s in SIGMAS], rel=0.02)
    below, above = lines(figure, "x2", "dash")
    expected = [QUANTILE_95 * 0.25 * s for s in SIGMAS]
    assert above["y"] == pytest.approx(expected)
    assert below["y"] == pytest.approx([-one for one in expected])


def test_groups_are_drawn_in_the_order_of_their_noise():
    figure = plot_noise_sweep(read_summary([group(s, "improved") for s in (1.0, 0.0, 0.5)]), "m")
    medians = [one for one in figure["data"] if one["mode"] == "lines+markers"]
    assert all(one["x"] == [0.0, 0.5, 1.0] for one in medians)
    assert medians[0]["y"] == pytest.approx([0.0, 0.25, 0.5])


def test_a_sweep_that_has_given_nothing_yet_has_an_empty_figure():
    waiting = [group(0.5, "simple", rms_noise_free=None, parameters=[])]
    assert plot_noise_sweep(read_summary(waiting), "m")["data"] == []


def test_only_a_sweep_over_the_deviation_has_the_figure():
    assert noise_group_keys([{"path": "/seed"}]) is None
    axes = [{"path": one} for one in ("/noise/sigma", "/noise/seed", "/seed", "/skip")]
    assert noise_group_keys(axes) == ["/noise/sigma", "/skip"]


def test_a_bound_is_told_where_the_runs_of_a_group_have_one_deviation_and_one_problem():
    assert scale_to_sigma(2.0, (0.5, 0.5)) == 1.0
    assert scale_to_sigma(2.0, (0.0, 0.0)) == 0.0
    assert scale_to_sigma(2.0, (0.0, 0.5)) is None
    assert scale_to_sigma(None, (0.5, 0.5)) is None
    problems = [
        {"cell": {"/datasets": [one]}, "reference": None, "stderr": {}, "rms": None, "note": ""}
        for one in ("ds_1", "ds_2")
    ]
    several = StoredBounds({"axes": ["/datasets"], "problems": problems})
    assert several.find_problem({"/datasets": ["ds_2"]}) is problems[1]
    assert several.find_problem({"/noise/sigma": 0.1}) is None
    assert StoredBounds({"axes": [], "problems": problems[:1]}).find_problem({}) is problems[0]
    assert StoredBounds(None).find_problem({}) is None
