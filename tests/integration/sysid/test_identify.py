"""The library call, end to end in this process."""

import numpy as np
import pytest

from sysid.core.errors import DivergedEverywhere, InvalidSettings
from sysid.core.settings import GeneticAlgorithm, Loss, Stop
from sysid.data.noise import Noise
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.islands.run_state import RunState
from sysid.models.catalogue.load import load_model
from sysid.results.identification import Identification
from sysid.search.refine import refine_candidates
from tests.support.library.search_problems import COULOMB, DUFFING, clean, example, noisy, record

DUFFING_MODEL = load_model("duffing-eq16")


def read_values(found: Identification) -> dict[str, float]:
    return {estimate.name: estimate.value for estimate in found.parameters}


@pytest.mark.parametrize(("model", "truth"), [("duffing-eq16", DUFFING), ("coulomb-eq16", COULOMB)])
def test_the_truth_is_recovered_without_noise(model: str, truth: dict[str, float]) -> None:
    found = identify(load_model(model), record(clean(model)))
    assert read_values(found) == pytest.approx(truth, abs=1e-6)
    assert found.rms < 1e-7
    assert found.fit_percent.estimation > 99.999


@pytest.mark.parametrize("model", ["duffing-eq16", "coulomb-eq16"])
@pytest.mark.parametrize("seed", range(5))
def test_the_least_squares_optimum_is_reached_within_20000_evaluations(
    model: str, seed: int
) -> None:
    truth = DUFFING if model == "duffing-eq16" else COULOMB
    problem = example(model, seed=seed)
    start = np.array([truth[p.name] for p in problem.free_parameters])
    optimum = refine_candidates(problem, [start])[0]
    assert optimum is not None
    settings = GeneticAlgorithm(stop=Stop(evaluations=20_000), generations=100_000)
    found = identify(load_model(model), record(noisy(model, seed=seed)), settings, seed=seed)
    assert found.rms <= optimum.rms * 1.0001
    assert found.evaluations <= 20_000


def test_a_result_repeats_bit_for_bit() -> None:
    def once() -> Identification:
        return identify(DUFFING_MODEL, record(noisy()), seed=4)

    assert once().parameters == once().parameters
    assert once().history == once().history


def test_the_methods_of_the_paper_are_reported_as_found() -> None:
    for method in ("simple", "improved-paper"):
        settings = GeneticAlgorithm(method=method)  # type: ignore[arg-type]
        found = identify(DUFFING_MODEL, record(noisy()), settings)
        best = min(found.history, key=lambda steps: steps[-1].rms)[-1]
        assert tuple(read_values(found).values()) == best.parameters
        assert found.islands[0].refined_rms is None
        assert any("not a local optimum" in warning for warning in found.warnings)
        assert all(estimate.stderr is not None for estimate in found.parameters)


def test_refinement_is_in_history_islands_and_count() -> None:
    found = identify(DUFFING_MODEL, record(clean()))
    plain = identify(DUFFING_MODEL, record(clean()), GeneticAlgorithm(refine=False))
    assert found.rms < plain.rms
    assert found.evaluations > plain.evaluations
    assert any(steps[-1].phase == "refinement" for steps in found.history)
    assert any(island.refined_rms is not None for island in found.islands)
    assert all(island.refined_rms is None for island in plain.islands)


def test_validation_data_are_judged_but_not_fitted() -> None:
    alone = identify(DUFFING_MODEL, record(noisy()))
    found = identify(DUFFING_MODEL, record(noisy()), validation=record(noisy(seed=8)))
    assert found.parameters == alone.parameters
    assert found.rms_validation == pytest.approx(0.01, rel=0.2)
    assert found.fit_percent.validation is not None
    assert found.simulated_validation[0][0].shape == (300,)
    assert alone.rms_validation is None


def test_several_records_are_fitted_jointly() -> None:
    both = [record(noisy(seed=1)), record(noisy(seed=2))]
    found, single = identify(DUFFING_MODEL, both), identify(DUFFING_MODEL, both[0])
    assert [len(experiment) for experiment in found.simulated] == [1, 1]
    for two, one in zip(found.parameters, single.parameters, strict=True):
        assert two.stderr is not None
        assert one.stderr is not None
        assert two.stderr == pytest.approx(one.stderr / np.sqrt(2), rel=0.25)


def test_noise_is_added_before_fitting() -> None:
    found = identify(DUFFING_MODEL, record(clean()), noise=Noise(0.05, seed=1))
    assert found.rms == pytest.approx(0.05, rel=0.15)


def test_a_robust_loss_withstands_outliers() -> None:
    y = noisy()
    y[::20] += 2.0
    found = identify(DUFFING_MODEL, record(y), loss=Loss("soft-l1", 0.02))
    assert read_values(found)["L"] == pytest.approx(0.5, abs=0.02)


def test_a_result_above_the_safe_limit_is_not_valid() -> None:
    found = identify(DUFFING_MODEL, record(noisy()), GeneticAlgorithm(safe_limit=0.001))
    assert not found.valid
    assert any("safe limit" in warning for warning in found.warnings)
    assert identify(DUFFING_MODEL, record(noisy()), GeneticAlgorithm(safe_limit=0.1)).valid


def test_a_model_worse_than_a_straight_line_is_told() -> None:
    times = 0.02 * np.arange(300)
    ramp = Record(record(clean()).inputs, (Channel("y", times, 50.0 + 3.0 * times),))
    found = identify(DUFFING_MODEL, ramp)
    assert any("straight line" in warning for warning in found.warnings)
    assert found.verdict.trust == "not trustworthy"


def test_an_estimate_at_its_bound_is_told() -> None:
    found = identify(DUFFING_MODEL, record(noisy()), parameters={"a": {"lower": 1.5, "upper": 5.0}})
    assert any(w.startswith("a lies at its lower bound 1.5 N/m³.") for w in found.warnings)


def test_a_bound_that_is_to_be_widened_is_told_once() -> None:
    found = identify(
        DUFFING_MODEL, record(clean()), parameters={"c": (5.0, 9.0)}, loss=Loss(noise_model="white")
    )
    assert found["c"].status == "at bound"
    [note] = [w for w in found.warnings if w.startswith(("c is at its", "c lies at its"))]
    assert note.startswith("c is at its lower bound 5 N·s/m and L lies at its lower bound 0 s. ")
    assert note.endswith(
        "To widen: lower the bound of c. Or set parameters={'c': {'physical': 'lower'}} if it is a "
        "physical limit."
    )


def test_progress_is_told_and_ends_at_the_result() -> None:
    states: list[RunState] = []
    found = identify(DUFFING_MODEL, record(noisy()), progress=states.append)
    assert states
    assert states[-1].generation == found.generations


def test_a_model_that_diverges_everywhere_fails_with_that_message() -> None:
    document = {
        "name": "wild",
        "form": "difference",
        "inputs": {"q": "N"},
        "states": {"x": "m"},
        "parameters": {"g": {"lower": 10.0, "upper": 20.0}},
        "equations": {"x": "exp(g*(x(k-1)**2 + 1))"},
        "outputs": {"y": "x"},
        "initial": {"x": 1},
    }
    with pytest.raises(DivergedEverywhere, match="diverged for every one of"):
        identify(load_model(document), record(clean()))


def test_a_problem_without_a_free_parameter_is_refused() -> None:
    fixed = {name: {"fixed": value} for name, value in DUFFING.items()}
    with pytest.raises(InvalidSettings, match="at least one free"):
        identify(DUFFING_MODEL, record(clean()), parameters=fixed)


def test_a_seed_out_of_range_is_refused() -> None:
    with pytest.raises(InvalidSettings, match="/seed"):
        identify(DUFFING_MODEL, record(clean()), seed=-1)
