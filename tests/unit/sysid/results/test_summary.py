"""Printed results: the verdict first, each finding once, and one dead time for one model."""

from dataclasses import replace
from typing import Any

from sysid.core.findings import Finding, note
from sysid.residuals.residual_tests import ResidualTest, ResidualTests
from sysid.results.findings import list_untold_reasons
from sysid.results.identification import Identification
from sysid.results.parts import NoiseSource, OrderFit, PlantNoise, compare_fits
from sysid.results.summary import (
    describe_order,
    describe_predictions,
    list_evidence,
    summarise_result,
)
from sysid.results.verdict import Verdict
from sysid.simulation.fit_metrics import PredictionError
from tests.support.storage.run_results import conclude

CAUTION = Finding("order", "structure", "caution", "the data prefer sopdt", "L is 1.3 s.", "", 30.0)
COLOURED = ResidualTests(
    "estimation", False, (ResidualTest(0, "y", "whiteness", None, "failed", 90, p=1e-5),)
)


def find(**fields: Any) -> Identification:
    return replace(conclude(K=(2.0, 0.05), L=(1.57, 0.07)).identification, **fields)


def compare(sopdt_bic: float) -> Any:
    first = OrderFit("fopdt", 1, 1.55, 0.01, {"L": 1.55}, 0.027, -1264.0)
    second = OrderFit("sopdt", 2, 1.33, 0.01, {"L": 1.33}, 0.019, sopdt_bic)
    return compare_fits("fopdt", "L", "s", "white", (first, second), 300)


def test_the_order_is_told_without_a_second_value_of_the_model() -> None:
    assert describe_order(compare(-1200.0)) == "order: the data prefer fopdt to sopdt"
    assert describe_order(compare(-1262.0)) == (
        "order: the data do not tell fopdt and sopdt apart; L is 1.330 ± 0.010 s with sopdt"
    )


def test_the_order_reassures_nobody_beside_another_doubt() -> None:
    order = compare(-1200.0)
    alone = find(order_comparison=order, findings=(note("ridge", "identifiability", "alike"),))
    assert describe_order(order) in list_evidence(alone)
    doubted = find(order_comparison=order, findings=(replace(CAUTION, explanation="drift"),))
    told = find(order_comparison=order, findings=(replace(CAUTION, severity="note"),))
    assert list_evidence(doubted) == list_evidence(told) == []


def test_times_are_told_in_the_unit_of_the_record_too() -> None:
    found = find(time_unit="min")
    estimates = tuple(
        replace(one, unit="s" if one.name == "L" else "1") for one in found.parameters
    )
    assert list_evidence(replace(found, parameters=estimates))[0] == "in min: L 0.0262 ± 0.0012"
    no_times = replace(found, parameters=tuple(replace(one, unit="1") for one in estimates))
    assert list_evidence(no_times) == []


def test_failed_tests_beside_a_trustworthy_result_are_explained() -> None:
    failed = "residuals on estimation data: failed: y is not white (p < 0.001)"
    calm = find(residual_tests=COLOURED)
    assert list_evidence(calm) == [f"{failed}; no explanation of that moves an estimate"]
    assert list_evidence(replace(calm, explained=False)) == [f"{failed}, weakly"]
    doubted = replace(calm, verdict=Verdict("limited", "trustworthy, but L drifts"))
    assert list_evidence(doubted) == [failed]


def test_reasons_of_statuses_are_told_once_and_outside_the_table() -> None:
    parameters = tuple(replace(one, reason="it is at the end") for one in find().parameters)
    found = find(parameters=parameters, findings=(CAUTION,), warnings=(CAUTION.sentences,))
    lines = summarise_result(found).splitlines()
    assert lines[1] == "verdict: trustworthy"
    assert lines[-2:] == ["note: L is 1.3 s.", "note: K and L: it is at the end"]
    told = replace(CAUTION, parameters=("L",))
    assert list_untold_reasons(parameters, [told]) == ["K: it is at the end"]
    failed = replace(CAUTION, severity="serious")
    doubted = [replace(one, status="dependent", reason=failed.brief) for one in parameters]
    assert list_untold_reasons(doubted, [failed]) == []


def test_a_search_that_did_not_settle_is_told_by_its_finding() -> None:
    found = find()
    assert "the search settled: 5 of 10 independent starts ended here" in repr(found)
    restless = replace(found, search=replace(found.search, settled=False, because=None))
    assert "independent starts" not in repr(restless)


def test_sources_of_noise_stand_beside_the_free_run() -> None:
    sensor = NoiseSource("y", "sensor", 0.02, "K", None)
    load = NoiseSource("u", "load", 0.05, "1", 20.0)
    told = "noise: sensor at y 0.02 K, load at u 0.05 with 20 s; the free run"
    noise = PlantNoise((sensor, load), 0.3, 91.04)
    assert f"{told} fits 91.0 %" in list_evidence(find(plant_noise=noise))
    assert f"{told} diverges" in list_evidence(
        find(plant_noise=PlantNoise((sensor, load), None, None))
    )


def test_errors_of_predictions_lead_to_the_free_run() -> None:
    sensor = NoiseSource("y", "sensor", 0.02, "K", None)
    errors = tuple(
        PredictionError(samples, 0.25 * samples, 0.02 + 0.001 * samples) for samples in (1, 2, 5)
    )
    noise = PlantNoise((sensor,), 0.0912, 91.04, errors)
    told = "RMS of predictions so many samples ahead"
    assert describe_predictions(noise, "K") == [
        f"{told} [K]: 0.021 at 1, 0.022 at 2, 0.025 at 5, free run 0.0912"
    ]
    assert any(line.startswith(told) for line in list_evidence(find(plant_noise=noise)))
    diverged = replace(noise, rms_free=None, prediction_errors=(PredictionError(1, 0.25, None),))
    assert describe_predictions(diverged, "1") == [f"{told}: diverged at 1, free run diverged"]
    many = tuple(PredictionError(samples, 1.0, 0.5) for samples in (1, 2, 5, 10, 20, 50, 100, 200))
    (line,) = describe_predictions(replace(noise, prediction_errors=many), "K")
    assert [part.split(" at ")[-1] for part in line.split(", ")[:-1]] == [
        "1",
        "5",
        "20",
        "100",
        "200",
    ]
