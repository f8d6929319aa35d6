"""The example that reproduces the paper: the pure parts of its tables, figures and parts."""

import numpy as np
import pytest

from examples.paper import figures, force_noise, noise, oscillators, published, study
from examples.paper.bench import ArchipelagoImprovement, MethodRun, champion_history
from examples.paper.cramer_rao import cramer_rao_bound
from examples.paper.document import (
    Check,
    ReportTable,
    Section,
    format_estimate,
    format_number,
    to_markdown,
)
from service.datasets.dataset_schemas import SimulateIn
from service.jobs.job_schemas import JobIn
from sysid.core import text
from sysid.data.records import Channel
from sysid.models.catalogue.load import copy_catalogue_document
from sysid.models.parse import parse_model


def make_point(generation: int, rms: float, value: float) -> dict[str, object]:
    return {"generation": generation, "rms": rms, "parameters": [value]}


def test_the_champion_of_an_archipelago_is_the_best_of_its_islands_so_far() -> None:
    islands = [
        [make_point(0, 3.0, 1), make_point(4, 1.0, 2)],
        [make_point(0, 2.0, 3), make_point(2, 2.5, 4)],
    ]
    found = champion_history({"names": ["a"], "islands": islands})
    assert [(one.generation, one.rms, one.parameters["a"]) for one in found] == [
        (0, 3.0, 1),
        (0, 2.0, 3),
        (4, 1.0, 2),
    ]


@pytest.mark.parametrize(
    ("only", "parts"),
    [
        ("table2,table1", ["table1", "table2"]),
        ("figure15", ["noise"]),
        ("figure21, Table4", ["table4"]),
        (None, list(study.PARTS)),
    ],
)
def test_parts_are_named_by_table_or_figure(only: str | None, parts: list[str]) -> None:
    assert study.choose_parts(only) == parts


@pytest.mark.parametrize("only", ["table9", "figure16", ",", "table1,tabel2"])
def test_an_unknown_part_is_refused_with_those_there_are(only: str) -> None:
    with pytest.raises(study.UnknownPart, match="need some of series, table1, table2, noise"):
        study.choose_parts(only)


def test_every_figure_of_the_paper_that_is_to_be_reproduced_belongs_to_a_part() -> None:
    numbers = [2, 3, *range(7, 16), 17, 18, 20, 21]
    assert all(study.choose_parts(f"figure{number}") for number in numbers)


def test_the_printed_errors_of_the_proposed_search_are_those_of_its_columns() -> None:
    printed = [
        (published.TABLE_1.proposed, published.TRUE_1, [0.0049, 0.0024, 0.0049, 0.0127]),
        (published.TABLE_2.proposed, published.TRUE_2, [0.0154, 0.0171, 0.0440, 0.0200]),
    ]
    for column, true, errors in printed:
        assert [abs(column[n] - true[n]) for n in true] == pytest.approx(errors, abs=1e-4)


def test_the_bound_of_a_mean_is_the_deviation_over_the_root_of_the_samples() -> None:
    model = {
        "name": "mean",
        "form": "difference",
        "states": {"x": "1"},
        "parameters": {"p": {"lower": 0, "upper": 5}},
        "equations": {"x": "x(k-1)"},
        "outputs": {"y": "x + p"},
        "initial": {"x": 0},
    }
    times = np.arange(100, dtype=np.float64)
    assert cramer_rao_bound(model, [], {"p": 2.0}, 0.5, times)["p"] == pytest.approx(0.05, rel=1e-6)


def test_the_bound_of_example_1_is_that_of_the_literature_on_it() -> None:
    times = 0.02 * np.arange(300, dtype=np.float64)
    force = Channel("q", times, 10 * np.cos(5 * times), "N")
    found = cramer_rao_bound("duffing-eq16", [force], published.TRUE_1, 0.01, times)
    expected = {"c": 0.00486, "L": 0.00247, "b": 0.01980, "a": 0.02684}
    assert found == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("example", [oscillators.EXAMPLE_1, oscillators.EXAMPLE_2])
def test_every_reading_gives_bodies_that_the_service_takes(example: oscillators.Example) -> None:
    for reading in oscillators.list_readings(example):
        SimulateIn.model_validate(oscillators.record_body(example, reading))
        body = JobIn.model_validate(oscillators.job_body(example, reading, "ds_1"))
        assert body.to_normal_form()["algorithm"]["population"] == 50
        assert set(example.true) == set(example.columns.simple) == set(example.columns.proposed)


def test_the_noise_sweep_has_one_cell_for_each_level_draw_and_method() -> None:
    body = JobIn.model_validate(noise.job_body("ds_1", "ds_2", 3))
    lengths = {one.path: len(one.values or range(*(one.range or ()))) for one in body.sweep.axes}
    assert lengths == {
        "/noise/sigma": len(noise.SIGMAS),
        "/noise/seed": 3,
        "/seed": 3,
        "/algorithm/method": 3,
    }


def test_the_spread_of_a_sweep_is_taken_for_each_level_and_method_by_itself() -> None:
    runs = [
        {"cell": {"/algorithm/method": method, "/noise/sigma": sigma}, "rms": weight * sigma + draw}
        for weight, method in enumerate(("simple", "improved-paper", "improved"))
        for sigma in noise.SIGMAS
        for draw in (0.0, 1.0, 2.0)
    ]
    found = noise.group_replicates(runs, "rms")
    medians = [one.quantiles[1] for one in found["improved"]]
    assert medians == pytest.approx([2 * sigma + 1 for sigma in noise.SIGMAS])
    assert all(len(one.values) == 3 for spread in found.values() for one in spread)


def test_a_table_in_the_terminal_has_one_width_and_keeps_its_marks() -> None:
    table = ReportTable("T", ["name", "x"], [["a|b", "1"], ["longer", "−2.5"]])
    shown = to_markdown(Section("S", "", [table], checks=[Check("it is so", holds=False)]))
    rows = [row for row in shown.splitlines() if row.startswith("|")]
    assert len(rows) == 4
    assert len({len(row) for row in rows}) == 1
    assert "a\\|b" in shown
    assert "does NOT hold: it is so" in shown


@pytest.mark.parametrize("value", [-52.04, 0.0, 0.0996, 0.00247, 950.4, 5.0])
@pytest.mark.parametrize("stderr", [4.1e-6, 0.0996, 1.0, 416.0])
def test_numbers_have_the_digits_that_lagid_shows(value: float, stderr: float) -> None:
    assert format_number(value, 2) == text.format_number(value, 2)
    assert format_estimate(value, stderr).replace("-", "−") == text.join_estimate(value, stderr)


def test_a_line_of_convergence_reaches_the_last_generation() -> None:
    run = {"generations": 40, "parameters": [{"name": "a", "unit": "s", "value": 2.0}]}
    progress = [
        ArchipelagoImprovement(0, 3.0, {"a": 1.0}),
        ArchipelagoImprovement(7, 1.0, {"a": 2.0}),
    ]
    figure = figures.draw_convergence({"simple": MethodRun(run, progress, {})}, ["a"], {"a": 2.5})
    drawn = {trace.name: trace for trace in figure.data}
    assert drawn["simple"].x == (0, 7, 40)
    assert drawn["simple"].y == (1, 2, 2)
    assert drawn["true value"].y == (2.5, 2.5)
    assert figure.layout.yaxis.title.text == "a [s]"


def test_the_noise_enters_the_recursion_as_a_force_or_as_printed() -> None:
    known = copy_catalogue_document("duffing-eq16")
    force, printed = (
        str(force_noise.model_document(known, kind)["equations"]["x"])
        for kind in force_noise.NOISE_TERMS
    )
    assert force.endswith("- q(k-2) - sigma*phi(k-2))/m")  # h² and 1/m stand before the bracket
    assert printed.endswith("- q(k-2))/m + sigma*phi(k-2)")
    for kind in force_noise.NOISE_TERMS:
        model = parse_model(force_noise.model_document(known, kind))
        assert [one.name for one in model.inputs] == ["q", "phi"]


def test_a_recursion_without_that_place_for_noise_is_refused() -> None:
    with pytest.raises(ValueError, match="must contain 'q"):
        force_noise.model_document(
            {**copy_catalogue_document("duffing-eq16"), "equations": {"x": "x(k-1)"}}, "force"
        )
