"""The integration step is halved until it has no part in the estimates or their errors."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from sysid.core.settings import FitSettings, GeneticAlgorithm, Loss, Stop
from sysid.data.records import Channel, Record
from sysid.identification.conclude import conclude_run
from sysid.identification.fit_problems import prepare_records
from sysid.identification.identify import identify
from sysid.identification.resimulate import resimulate_run
from sysid.identification.run import advance_run, begin_run
from sysid.judgement import integration_step
from sysid.judgement.integration_step import (
    HalfStep,
    choose_starts,
    compare_half_step,
    find_limit,
)
from sysid.models.catalogue.load import load_model
from sysid.models.model import MAX_SUBSTEPS, Model, replace_substeps
from sysid.models.parse import parse_model
from sysid.results.identification import Identification
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
from sysid.uncertainty.analysis import analyse_estimate
from sysid.uncertainty.estimates import Estimate
from tests.support.library.catalogue_cases import CASES, make_record

FINE = 16
N = 200
QUICK = GeneticAlgorithm(population=32, generations=60)
TWO_LAGS: dict[str, Any] = {
    "name": "two-lags",
    "form": "differential",
    "inputs": {"u": "1"},
    "states": {"w": "1", "x": "1"},
    "parameters": {
        "K": {"lower": -10, "upper": 10},
        "T1": {"lower": 0.5, "upper": 50, "unit": "s", "scale": "log"},
        "r": {"lower": 0.002, "upper": 1, "scale": "log"},
        "L": {"lower": 0, "upper": 20, "unit": "s"},
    },
    "equations": {"w": "(K*u(t - L) - w)/T1", "x": "(w - x)/(r*T1)"},
    "outputs": {"y": "x"},
    "initial": {"w": 0, "x": 0},
}
STIFF = {"K": 2.0, "T1": 8.0, "r": 0.01, "L": 4.0}  # a lag of 0.08 s, sampled each second
SLOW = {"K": 2.0, "T1": 8.0, "r": 0.9, "L": 4.0}


def two_lags(substeps: int) -> Model:
    return parse_model({**TWO_LAGS, "solver": {"substeps": substeps}})


def sample_plant(values: Mapping[str, float], sd: float = 0.02, substeps: int = 200) -> Record:
    """A record of the plant itself: of steps far below its time constants, with white noise."""
    random = np.random.default_rng(3)
    times = np.arange(N, dtype=np.float64)
    inlet = Channel("u", times, np.repeat(random.standard_normal(N // 5), 5), hold="zero")
    outlet = simulate(two_lags(substeps), [inlet], values, times=times).channel("y")
    return Record((inlet,), (replace(outlet, values=outlet.values + random.normal(0.0, sd, N)),))


def by_name(found: Identification) -> dict[str, Estimate]:
    return {one.name: one for one in found.parameters}


def deviation(one: Estimate, value: float) -> float:
    assert one.stderr
    return abs(one.value - value) / one.stderr


def make_noisy(name: str, times: int, share: float) -> Record:
    """A record of a catalogue model with a finer step, with white noise of a share of it."""
    model = load_model(name)
    model = replace_substeps(model, times * model.solver.substeps)
    clean = make_record(model, replace(CASES[name], sigma=0.0))
    random = np.random.default_rng(0)
    outputs = tuple(
        replace(
            y, values=y.values + share * np.std(y.values) * random.standard_normal(y.values.size)
        )
        for y in clean.outputs
    )
    return Record(clean.inputs, outputs)


def halve_step(model: Model, name: str, record: Record) -> tuple[tuple[Estimate, ...], HalfStep]:
    """The estimate from the truth on, and what half the step changes."""
    problem, case = Problem.build(model, [record]), CASES[name]
    truth = {**case.truth, **case.initial}
    (end,) = refine_candidates(
        problem, [np.array([truth[one.name] for one in problem.free_parameters])]
    )
    assert end is not None
    analysis = analyse_estimate(problem, end.theta)
    half = compare_half_step(problem, end.theta, analysis)
    assert half is not None
    return analysis.estimates, half


def test_a_small_error_of_the_step_counts_where_the_noise_is_smaller() -> None:
    """It moves the output by 5e-4 of its size, and the estimates by nine standard errors."""
    model, record = load_model("fopdt"), make_noisy("fopdt", FINE, 1e-3)
    coarse, half = halve_step(model, "fopdt", record)
    exact, fine = halve_step(replace_substeps(model, FINE * model.solver.substeps), "fopdt", record)
    assert fine.changes == {}
    assert half.problem.model.solver.substeps == 2 * model.solver.substeps
    values = {one.name: one.value for one in exact}
    far = {one.name: deviation(one, values[one.name]) for one in coarse}
    assert max(far.values()) > 5
    assert {name for name, distance in far.items() if distance > 2} <= set(half.changes)
    ends = dict(zip(half.problem.free_names, half.theta.tolist(), strict=True))
    for one in coarse:  # half of the step's error, or more, is gone with half the step
        if far[one.name] > 2:
            assert abs(ends[one.name] - values[one.name]) < 0.7 * abs(one.value - values[one.name])


def test_of_a_record_that_was_simulated_with_the_step_nothing_changes() -> None:
    for name in ("duffing-delay", "fopdt"):
        assert halve_step(load_model(name), name, make_noisy(name, 1, 1e-5))[1].changes == {}


def test_estimates_that_stand_still_do_not_count_though_the_output_moves() -> None:
    """What no parameter can make up for is no error of an estimate."""
    estimates, half = halve_step(load_model("tube"), "tube", make_noisy("tube", FINE, 2e-4))
    assert all(one.stderr is not None for one in estimates if one.status == "identified")
    assert half.changes == {}


@pytest.mark.parametrize("substeps", [1, 2, 4, 8])
def test_a_stiff_plant_is_identified_at_any_substeps(substeps: int) -> None:
    record = sample_plant(STIFF)
    found = identify(two_lags(substeps), record, QUICK)
    exact = by_name(identify(two_lags(32), record, QUICK))
    assert found.substeps >= 8
    for name, one in by_name(found).items():
        assert one.stderr
        assert exact[name].stderr
        assert deviation(one, STIFF[name]) < 3
        assert deviation(one, exact[name].value) < 0.6
        assert 0.7 < one.stderr / exact[name].stderr < 1.4
    notes = [text for text in found.warnings if f"substeps: {found.substeps}" in text]
    assert len(notes) == (found.substeps > substeps)
    assert not any("substeps" in text for text in found.warnings if text not in notes)


def test_signals_of_a_finer_step_are_computed_again_bit_for_bit() -> None:
    record = sample_plant(STIFF)
    found = identify(two_lags(1), record, QUICK, validation_fraction=0.3)
    assert found.substeps > 1
    records = prepare_records(two_lags(1), [record], fraction=0.3)
    again = resimulate_run(two_lags(1), records, FitSettings(), found.parameters, found.substeps)
    assert [one.tobytes() for one in again.simulated[0]] == [
        one.tobytes() for one in found.simulated[0]
    ]
    assert [one.tobytes() for one in again.simulated_validation[0]] == [
        one.tobytes() for one in found.simulated_validation[0]
    ]


@pytest.mark.parametrize("substeps", [2, 4])
def test_a_standard_error_from_the_edge_of_stability_counts(substeps: int) -> None:
    """The fast lag lies at its bound, where the method is just stable: no value moves by much."""
    edge = 1.0 / (2.7 * substeps * STIFF["T1"])
    record = sample_plant({**STIFF, "r": 2e-4}, substeps=1000)
    problem = Problem.build(
        two_lags(substeps), [record], parameters={"r": {"lower": edge, "upper": 1}}
    )
    start = np.array([STIFF["K"], STIFF["T1"], edge, STIFF["L"]])
    (end,) = refine_candidates(problem, [start])
    assert end is not None
    half = compare_half_step(problem, end.theta, analyse_estimate(problem, end.theta))
    assert half is not None
    assert half.changes["L"].startswith("the standard error of L is 2")


def test_a_lag_that_the_data_do_not_tell_has_the_error_of_a_short_step() -> None:
    wide = {"r": {"lower": 2e-4, "upper": 1}}
    record = sample_plant({**STIFF, "r": 2e-4}, substeps=1000)
    long, short = (
        by_name(identify(two_lags(substeps), record, QUICK, parameters=wide))["L"].stderr
        for substeps in (1, 32)
    )
    assert long is not None
    assert short is not None
    assert 0.5 < long / short < 2


def test_half_a_standard_error_is_a_change_and_a_tenth_is_none() -> None:
    model, record = load_model("fopdt"), make_noisy("fopdt", FINE, 0.01)
    _, half = halve_step(model, "fopdt", record)
    assert 0.3 < float(half.changes["L"].split()[-6]) < 1.0
    quiet = replace_substeps(model, 4 * model.solver.substeps)
    assert halve_step(quiet, "fopdt", record)[1].changes == {}


def test_a_plant_that_is_not_stiff_keeps_its_step() -> None:
    found = identify(two_lags(4), sample_plant(SLOW), QUICK)
    assert found.substeps == 4
    assert not any("substeps" in text for text in found.warnings)


def test_the_signals_of_a_result_are_those_of_its_step() -> None:
    model, record = two_lags(1), sample_plant(STIFF)
    found = identify(model, record, QUICK, validation_fraction=0.3)
    used = replace_substeps(model, found.substeps)
    assert found.substeps > 1
    values = {one.name: one.value for one in found.parameters}
    (outlet,) = simulate(used, record.inputs, values, times=record.outputs[0].times).channels
    first, last = found.simulated[0][0], found.simulated_validation[0][0]
    np.testing.assert_allclose(first, outlet.values[: first.size], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(last, outlet.values[-last.size :], rtol=1e-9, atol=1e-12)
    residual = record.outputs[0].values[: first.size] - first
    assert found.rms == pytest.approx(float(np.sqrt(np.mean(residual**2))))
    assert parse_model(used.document).solver == used.solver


def list_unsettled(found: Identification) -> list[str]:
    """What is said of the estimates that half the step would change."""
    return [
        one.reason
        for one in found.parameters
        if one.status == "unidentifiable"
        and one.reason.startswith("half the integration step still changes it")
    ]


def identify_within(most: int) -> Identification:
    tight = replace(QUICK, stop=Stop(evaluations=most, settled=None))
    return identify(two_lags(1), sample_plant(STIFF), tight)


@pytest.mark.parametrize("most", [300, 800])
def test_a_budget_that_leaves_no_finer_fit_is_kept(most: int) -> None:
    assert identify_within(most).evaluations <= most


@pytest.mark.parametrize("most", [300, 800])
def test_a_budget_that_leaves_no_finer_fit_is_told(most: int) -> None:
    found = identify_within(most)
    reasons = list_unsettled(found)
    assert reasons
    assert all(reason.endswith("the budget of evaluations") for reason in reasons)


def test_a_time_limit_that_leaves_no_finer_fit_is_told() -> None:
    problem = Problem.build(two_lags(1), [sample_plant(STIFF)])
    limited = replace(QUICK, stop=Stop(seconds=1.0))
    state = advance_run(problem, QUICK, begin_run(problem, QUICK, 1))
    late = conclude_run(problem, limited, replace(state, seconds=1e9), clock=lambda: 0.0)
    assert late.substeps == 1
    reasons = list_unsettled(late)
    assert reasons
    assert all(reason.endswith("the time limit") for reason in reasons)
    assert all(any(reason in text for text in late.warnings) for reason in reasons)


def test_estimates_that_are_not_refined_stay_and_are_not_called_identified() -> None:
    found = identify(two_lags(1), sample_plant(STIFF), replace(QUICK, refine=False))
    assert found.substeps == 1
    assert list_unsettled(found)


def test_under_a_noise_model_estimates_that_still_change_are_not_called_identified(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    record = sample_plant(STIFF)
    (outlet,) = record.outputs
    slow = lfilter([1.0], [1.0, -0.8], np.random.default_rng(5).normal(0.0, 0.02, N))
    record = replace(record, outputs=(replace(outlet, values=outlet.values + slow),))
    monkeypatch.setattr(integration_step, "_MAX_STEPS", 3 * N)
    found = identify(two_lags(1), record, QUICK, loss=Loss(noise_model="ar1"))
    assert found.substeps == 1
    assert found.correlation_times["y"] > 0
    assert list_unsettled(found)


def test_the_limits_of_a_finer_fit_have_names() -> None:
    record = sample_plant(STIFF)
    finest, coarse = (
        HalfStep(Problem.build(two_lags(substeps), [record]), np.zeros(4), {}, {}, 0)
        for substeps in (MAX_SUBSTEPS, 2)
    )
    work = 10**9
    assert "1000 substeps" in find_limit(finest, work)
    assert find_limit(coarse, work) == ""
    few = 10 * coarse.problem.n_steps
    beyond = "a finer step is beyond the "
    assert find_limit(coarse, few) == f"{beyond}limit on the work of finer fits"
    assert find_limit(coarse, work, 10) == f"{beyond}budget of evaluations"
    assert find_limit(coarse, work, None, lambda: True) == f"{beyond}time limit"


def test_a_finer_fit_starts_from_what_is_best_with_the_finer_step() -> None:
    """The last champion may owe its fit to the longer step."""
    truth = np.array([STIFF[name] for name in ("K", "T1", "r", "L")])
    far = truth * np.array([1.0, 1.0, 4.0, 1.3])
    half = HalfStep(Problem.build(two_lags(8), [sample_plant(STIFF)]), far, {}, {}, 0)
    starts, rms, count = choose_starts(half, [[truth, far], [far]])
    np.testing.assert_array_equal(starts, [truth, far])
    np.testing.assert_array_equal(rms, half.problem.evaluate_fitness(np.array([truth, far])))
    assert count == 3
    many = [far] * 100 + [truth]
    assert choose_starts(half, [many])[0][0] is truth
    assert choose_starts(half, [many])[2] <= 32


@pytest.mark.parametrize(("half_range", "status"), [(0.5, "unidentifiable"), (1.0, "identified")])
def test_an_interval_wider_than_the_range_identifies_nothing(
    half_range: float, status: str
) -> None:
    bounds = {"lower": STIFF["L"] - half_range, "upper": STIFF["L"] + half_range}
    fields = {"r": {"fixed": SLOW["r"]}, "L": bounds}
    lag = by_name(identify(two_lags(4), sample_plant(SLOW, sd=0.5), QUICK, parameters=fields))["L"]
    assert lag.stderr is not None
    assert 0.3 < lag.stderr < 0.5
    assert lag.status == status
    assert lag.reason.endswith("is wider than its range") == (status == "unidentifiable")


def exact_first_order(sd: float = 0.0) -> Record:
    """Gain 2, time constant 1 s, dead time 0.5 s: the solution of the equation, no solver's."""
    times = 0.1 * np.arange(300)
    u = np.where((times // 7) % 2 == 0, 0.0, 1.0)
    decay = np.exp(-0.1)
    y = lfilter([0.0] * 6 + [2.0 * (1 - decay)], [1.0, -decay], u)
    y += np.random.default_rng(1).normal(0.0, sd, y.size)
    return Record((Channel("u", times, u, hold="zero"),), (Channel("y", times, y),))


@pytest.mark.slow
def test_without_noise_a_small_move_is_an_error_and_no_doubt() -> None:
    """No step is short enough for the standard errors of residuals that are the solver's."""
    bounds = {"T": {"upper": 10.0}, "L": {"upper": 2.0}}
    found = identify(load_model("fopdt"), exact_first_order(), QUICK, parameters=bounds)
    estimates = by_name(found)
    for name, truth in {"K": 2.0, "T": 1.0, "L": 0.5}.items():
        one = estimates[name]
        assert one.status == "identified"
        assert one.value == pytest.approx(truth, rel=1e-4)
        assert one.interval95 is not None
        assert one.interval95[0] <= truth <= one.interval95[1]
    assert "half the step moves it" in estimates["L"].reason


def test_a_move_that_is_not_small_or_of_a_noisy_record_is_a_doubt() -> None:
    small = Estimate("L", "s", 0.5, 0.0, 2.0, 1e-6, (0.499998, 0.500002), "identified")
    half = HalfStep(
        Problem.build(two_lags(8), [sample_plant(STIFF)]), np.zeros(4), {"L": "far"}, {"L": 4e-6}, 0
    )
    (kept,) = integration_step.mark_changing((small,), half, "limit")
    assert (kept.status, kept.value) == ("identified", 0.5)
    assert kept.stderr == pytest.approx(np.hypot(1e-6, 4e-6))
    assert kept.interval95 == pytest.approx((0.5 - 2 * kept.stderr, 0.5 + 2 * kept.stderr))
    (marked,) = integration_step.mark_changing((small,), replace(half, small_moves={}), "limit")
    assert (marked.status, marked.reason) == (
        "unidentifiable",
        "half the integration step still changes it: far; limit",
    )
    for noise, is_small in ((0.0, True), (0.02, False)):
        problem = Problem.build(load_model("fopdt"), [exact_first_order(noise)])
        one = replace(small, name="L")
        moved = {"L": "L moved"}
        end = np.array([0.5 + 4e-6 if name == "L" else 1.0 for name in problem.free_names])
        found = integration_step._find_small_moves(problem, max(noise, 1e-6), (one,), end, moved)
        assert bool(found) is is_small
        end[problem.free_names.index("L")] = 0.51
        assert integration_step._find_small_moves(problem, 1e-6, (one,), end, moved) == {}
