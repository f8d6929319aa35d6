"""Standard errors, correlations and identifiability, against theory and repetition."""

from typing import Any

import numpy as np
import pytest

from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit, to_unit
from sysid.simulation.simulate import simulate
from sysid.uncertainty.analysis import analyse_estimate
from sysid.uncertainty.estimates import AT_LIMIT, Estimate
from tests.support.library.search_problems import COULOMB, DUFFING, example, force, noisy, record
from tests.support.profiles import draw_seeds
from tests.support.random_bounds import bound_count, bound_mean

# Cramér-Rao bound of Example 1, measurement noise of sd 0.01, 300 samples (from theory).
BOUND = {"c": 0.0049, "L": 0.0025, "b": 0.0198, "a": 0.0268}


def read_truth(problem: Problem) -> FloatArray:
    return np.array([DUFFING[p.name] for p in problem.free_parameters])


def by_name(estimates: tuple[Estimate, ...]) -> dict[str, Estimate]:
    return {e.name: e for e in estimates}


def test_standard_errors_of_example_1_are_the_cramer_rao_bound() -> None:
    problem = example()
    start = refine_candidates(problem, [read_truth(problem)])[0]
    assert start is not None
    for estimate in analyse_estimate(problem, start.theta).estimates:
        assert estimate.stderr == pytest.approx(BOUND[estimate.name], rel=0.15)
        assert estimate.status == "identified"


def test_estimates_scatter_as_their_standard_errors_say() -> None:
    squares = []
    for seed in draw_seeds(gate=40, night=400):
        problem = Problem.build(load_model("duffing-eq16"), [record(noisy(seed=seed))])
        end = refine_candidates(problem, [read_truth(problem)])[0]
        assert end is not None
        estimates = analyse_estimate(problem, end.theta).estimates
        errors = [(one.value - DUFFING[one.name]) / (one.stderr or np.nan) for one in estimates]
        squares.append(np.mean(np.square(errors)))
    assert np.mean(squares) == pytest.approx(1.0, abs=bound_mean(squares, 0.05))


def test_records_of_unequal_noise_each_count_with_their_own() -> None:
    # The sandwich of White (1980) for two series, each of its own variance, by what degrees of
    # freedom the estimates leave it.
    exact, vague = record(noisy(seed=1)), record(noisy(n=80, sd=0.06, seed=2))
    problem = Problem.build(load_model("duffing-eq16"), [exact, vague])
    end = refine_candidates(problem, [read_truth(problem)])[0]
    assert end is not None
    found = analyse_estimate(problem, end.theta)
    assert found.uncertainty is not None
    assert found.uncertainty.noise_colour == "white"
    step = 1e-5 * np.eye(end.theta.size)
    slopes = (problem.predict(end.theta + step) - problem.predict(end.theta - step)).T / 2e-5
    error = problem.evaluator.measured - problem.predict(end.theta[None])[0]
    bread = np.linalg.inv(slopes.T @ slopes)
    inner = 0.0
    for rows in (slice(0, 300), slice(300, 380)):
        squares = slopes[rows].T @ slopes[rows]
        left = error[rows].size - np.trace(bread @ squares)
        inner = inner + np.sum(error[rows] ** 2) / left * squares
    expected = np.sqrt(np.diag(bread @ inner @ bread))
    pooled = np.sqrt(np.diag(bread) * np.sum(error**2) / 376)
    assert [one.stderr for one in found.estimates] == pytest.approx(expected, rel=1e-3)
    assert np.max(np.abs(expected / pooled - 1)) > 0.1


def test_intervals_that_a_short_exact_output_tells_cover_the_truth() -> None:
    # y tells a, T and c by 20 samples, z tells b by 1000: s² of y by 17 degrees of freedom.
    truth_ = np.array([2.0, 0.8, 0.3, 1.0])
    spans = {"a": (0.1, 5), "T": (0.1, 3), "c": (-3, 3), "b": (-3, 3)}
    model = parse_model(
        {
            "name": "two",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "m", "w": "m"},
            "parameters": {name: {"lower": low, "upper": up} for name, (low, up) in spans.items()},
            "equations": {"x": "(u - x)/T", "w": "u - w"},
            "initial": {"x": 0, "w": 0},
            "outputs": {"y": "a*x + c", "z": "b*w"},
        }
    )
    times = 0.05 * np.arange(1000.0)
    levels = np.random.default_rng(7).normal(size=50)
    u = Channel("u", times, np.repeat(levels, 20), hold="zero")
    given = dict(zip(spans, truth_.tolist(), strict=True))
    y, z = (one.values for one in simulate(model, [u], given, times=times).channels)
    covered, seeds = [], draw_seeds(gate=200, night=2000)
    for seed in seeds:
        random = np.random.default_rng([7, seed])
        data = (
            Channel("y", times[::50], y[::50] + random.normal(0, 0.02, 20), "m"),
            Channel("z", times, z + random.normal(0, 0.2, 1000), "m"),
        )
        problem = Problem.build(model, [Record((u,), data)], weights={"y": 1.0, "z": 1.0})
        end = refine_candidates(problem, [truth_])[0]
        assert end is not None
        found = [one.interval95 for one in analyse_estimate(problem, end.theta).estimates]
        covered.append([a <= v <= b for (a, b), v in zip(filter(None, found), truth_, strict=True)])
    # 88 to 91 % with one s² and one t for all.
    assert np.min(np.sum(covered, axis=0)) >= bound_count(len(seeds), 0.945)[0]
    shares = np.mean(np.array(covered)[:, :3], axis=1)
    assert np.mean(shares) >= 0.95 - bound_mean(shares)


def test_what_has_a_small_part_in_an_unknown_direction_is_not_identified() -> None:
    spans = {"a": (0.1, 5.0), "b": (0.1, 5.0), "T": (0.1, 3.0)}
    model = parse_model(
        {
            "name": "two",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "m"},
            "parameters": {name: {"lower": low, "upper": up} for name, (low, up) in spans.items()},
            "equations": {"x": "(u - x)/T"},
            "outputs": {"y": "a*x", "z": "b*x"},
            "initial": {"x": 0},
        }
    )
    times = 0.1 * np.arange(3.0)
    noise = np.random.default_rng(3).normal(0, 0.1, 3)
    data = tuple(Channel(name, times, np.sin(times) + noise, "m") for name in "yz")
    problem = Problem.build(model, [Record((Channel("u", times, np.sin(1.3 * times)),), data)])
    for one in analyse_estimate(problem, np.array([5.0, 5.0, 0.635])).estimates:
        assert one.stderr is not None
        assert one.stderr > one.upper - one.lower
        assert one.status in ("group", "unidentifiable"), one


def test_standard_errors_beside_the_jumps_of_coulomb_friction_are_those_of_repetition() -> None:
    values, errors = [], []
    for seed in draw_seeds(gate=40, night=200):
        problem = Problem.build(
            load_model("coulomb-eq16"), [record(noisy("coulomb-eq16", seed=seed))]
        )
        end = refine_candidates(
            problem, [np.array([COULOMB[p.name] for p in problem.free_parameters])]
        )[0]
        assert end is not None
        values.append([end.theta])
        errors.append([e.stderr for e in analyse_estimate(problem, end.theta).estimates])
    spread = np.std(np.concatenate(values), axis=0, ddof=1)
    found = np.array(errors, dtype=float)
    assert np.all(found > spread / 2)
    assert np.all(found < spread * 2)


def test_intervals_are_of_the_t_distribution() -> None:
    problem = Problem.build(load_model("duffing-eq16"), [record(noisy())], skip=288)
    analysis = analyse_estimate(problem, read_truth(problem))
    estimate = analysis.estimates[0]
    assert estimate.stderr is not None
    assert estimate.interval95 is not None
    half = 0.5 * (estimate.interval95[1] - estimate.interval95[0])
    assert half / estimate.stderr == pytest.approx(2.306, abs=1e-3)  # 8 degrees of freedom


def test_without_noise_the_standard_errors_vanish() -> None:
    problem = example(sd=0.0)
    analysis = analyse_estimate(problem, read_truth(problem))
    assert all(e.stderr is not None and e.stderr < 1e-9 for e in analysis.estimates)
    assert all(e.status == "identified" for e in analysis.estimates)


def test_the_correlation_matrix_is_one_of_correlations() -> None:
    uncertainty = analyse_estimate(example(), read_truth(example())).uncertainty
    assert uncertainty is not None
    assert np.allclose(uncertainty.correlation, uncertainty.correlation.T)
    assert np.allclose(np.diag(uncertainty.correlation), 1.0)
    assert np.all(np.linalg.eigvalsh(uncertainty.correlation) > 0)
    assert uncertainty.noise_sd == pytest.approx(0.01, rel=0.15)
    assert uncertainty.condition > 1


def build_document(equation: str) -> dict[str, object]:
    return {
        "name": "test",
        "form": "difference",
        "inputs": {"q": "N"},
        "states": {"x": "m"},
        "parameters": {
            "g": {"lower": 0.0, "upper": 10.0},
            "h2": {"lower": 0.0, "upper": 10.0},
            "u": {"lower": 0.0, "upper": 10.0},
        },
        "equations": {"x": equation},
        "outputs": {"y": "x"},
        "initial": {"x": 0},
    }


def analyse_equation(
    equation: str, theta: list[float], **changes: dict[str, Any]
) -> dict[str, Estimate]:
    model = load_model(build_document(equation))
    input_ = force(50)
    y = 0.9 * np.concatenate([[0.0], input_.values[:-1]])
    y = y + 0.1 * np.random.default_rng(0).standard_normal(50)
    output = record(y).outputs
    problem = Problem.build(model, [Record((input_,), output)], parameters=changes)
    return by_name(analyse_estimate(problem, np.array(theta)).estimates)


def test_a_parameter_without_effect_is_unidentifiable_and_says_so() -> None:
    found = analyse_equation("g*q(k-1) + h2*0.1*sin(k) + 0*u", [0.9, 0.3, 5.0])
    assert found["u"].status == "unidentifiable"
    assert found["u"].stderr is None
    assert "does not change" in found["u"].reason
    assert found["g"].status == "identified"


def test_factors_of_one_product_are_a_group() -> None:
    found = analyse_equation("g*h2*q(k-1) + u*sin(k)", [0.3, 3.0, 0.5])
    assert [found[name].status for name in ("g", "h2", "u")] == ["group", "group", "identified"]
    assert found["g"].stderr is None
    assert "combination" in found["g"].reason


def test_an_estimate_at_its_bound_has_a_standard_error() -> None:
    found = analyse_equation("g*q(k-1) + h2*sin(k) + u*cos(2*k)", [0.9, 0.0, 0.1])
    assert found["h2"].status == "at bound"
    assert found["h2"].stderr is not None
    assert found["h2"].reason


def test_an_estimate_at_a_physical_limit_is_identified_unless_the_data_pull_it_over() -> None:
    equation, theta = "g*q(k-1) + h2*sin(k) + u*cos(2*k)", [0.9, 0.0, 0.1]
    held = analyse_equation(equation, theta, h2={"physical": "lower"})["h2"]
    assert (held.status, held.reason) == ("identified", AT_LIMIT)
    assert analyse_equation(equation, theta, h2={"physical": "upper"})["h2"].status == "at bound"
    low = {"upper": 0.3, "physical": "upper"}
    assert analyse_equation(equation, [0.3, 0.1, 0.1], g=low)["g"].status == "at bound"


def test_as_many_samples_as_parameters_give_no_standard_error() -> None:
    model = load_model("duffing-eq16")
    problem = Problem.build(model, [record(noisy())], skip=296)
    analysis = analyse_estimate(problem, read_truth(problem))
    assert analysis.uncertainty is None
    assert all(e.stderr is None and "4 samples" in e.reason for e in analysis.estimates)


def test_fixed_parameters_are_reported_as_given() -> None:
    changes = {"b": {"fixed": 5.0}}
    problem = Problem.build(load_model("duffing-eq16"), [record(noisy())], parameters=changes)
    found = by_name(analyse_estimate(problem, np.array([0.2, 0.5, 1.0])).estimates)
    assert found["b"].status == "fixed"
    assert found["b"].value == 5.0
    assert found["b"].stderr is None


def test_outliers_widen_robust_standard_errors_little() -> None:
    y = noisy()
    outliers = y.copy()
    outliers[::30] += 1.0
    loss = Loss("soft-l1", 0.02)

    def errors(values: FloatArray, loss: Loss) -> FloatArray:
        problem = Problem.build(load_model("duffing-eq16"), [record(values)], loss=loss)
        end = refine_candidates(problem, [read_truth(problem)])[0]
        assert end is not None
        return np.array(
            [e.stderr for e in analyse_estimate(problem, end.theta).estimates], dtype=float
        )

    plain, robust = errors(y, Loss()), errors(outliers, loss)
    assert np.all(robust < 2 * plain)
    assert np.all(errors(outliers, Loss()) > 5 * plain)


def build_rounded(n: int = 300) -> Problem:
    """Example 1 where the model's lag is rounded to whole samples of 20 ms."""
    model = load_model("duffing-eq16").document
    solver = {"history": "constant", "interpolation": "nearest"}
    return Problem.build(load_model({**model, "solver": solver}), [record(noisy(n=n))])


def test_a_rounded_lag_is_no_surer_than_its_plateau() -> None:
    problem = build_rounded()
    errors = []
    for lag in (0.4912, 0.4951, 0.5, 0.5049, 0.5088, 0.5099, 0.50999):  # all the same samples
        analysis = analyse_estimate(problem, np.array([0.2, lag, 5.0, 1.0]))
        found = by_name(analysis.estimates)["L"]
        assert found.status == "identified"
        assert found.stderr is not None
        errors.append(found.stderr)
    expected = np.hypot(0.02 / np.sqrt(12), BOUND["L"])
    assert errors == pytest.approx([expected] * len(errors), rel=0.1)


def test_a_plateau_is_seen_although_the_place_of_another_parameter_is_rounded() -> None:
    """Estimates lie anywhere, and few of them stay the same as a place and back."""
    problem = build_rounded()
    thetas = np.array([[0.2, 0.5, b, 1.0] for b in np.linspace(4.99, 5.01, 50)])
    back = from_unit(problem.evaluator, to_unit(problem.evaluator, thetas))
    theta = thetas[np.argmax(back[:, 2] != thetas[:, 2])]
    assert from_unit(problem.evaluator, to_unit(problem.evaluator, theta[None]))[0, 2] != theta[2]
    found = by_name(analyse_estimate(problem, theta).estimates)["L"]
    assert found.status == "identified"
    assert found.stderr == pytest.approx(np.hypot(0.02 / np.sqrt(12), BOUND["L"]), rel=0.1)


def test_the_interval_of_a_rounded_lag_does_not_depend_on_where_the_search_ended() -> None:
    problem = build_rounded()
    for lag in (0.4901, 0.4912, 0.5, 0.5088, 0.5099):  # all the same samples
        found = by_name(analyse_estimate(problem, np.array([0.2, lag, 5.0, 1.0])).estimates)["L"]
        assert found.value == pytest.approx(lag)
        assert found.interval95 is not None
        lower, upper = found.interval95
        assert 0.5 * (lower + upper) == pytest.approx(0.5, abs=5e-4)
        assert lower <= 0.49
        assert upper >= 0.51


def test_a_rounded_lag_leaves_the_other_standard_errors_alone() -> None:
    found = by_name(analyse_estimate(build_rounded(), np.array([0.2, 0.5, 5.0, 1.0])).estimates)
    for name in ("c", "b", "a"):
        assert found[name].stderr == pytest.approx(BOUND[name], rel=0.25)


def test_a_rounded_lag_at_its_bound_has_no_standard_error_and_says_why() -> None:
    changes = {"L": {"lower": 0.5, "upper": 1.0}}
    model = load_model(
        {
            **load_model("duffing-eq16").document,
            "solver": {"history": "constant", "interpolation": "nearest"},
        }
    )
    problem = Problem.build(model, [record(noisy())], parameters=changes)
    found = by_name(analyse_estimate(problem, np.array([0.2, 0.5, 5.0, 1.0])).estimates)["L"]
    assert found.stderr is None
    assert found.interval95 is None
    assert "jumps" in found.reason


@pytest.mark.parametrize("most", [0, 1, 5, 8])
def test_of_a_budget_that_does_not_suffice_is_told_what_was_simulated(
    monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    theta, simulated = np.array([0.2, 0.5, 5.0, 1.0]), []
    problem, inner = example(), Problem.predict

    def count_and_simulate(self: Problem, places: FloatArray) -> FloatArray:
        simulated.append(len(places))
        return inner(self, places)

    monkeypatch.setattr(Problem, "predict", count_and_simulate)
    short = analyse_estimate(problem, theta, most)
    assert short.uncertainty is None
    assert short.evaluations <= most
    shown = 1 if most == 0 else 0  # what every result shows, which no budget counts
    assert sum(simulated) - shown == short.evaluations
    assert short.criteria == analyse_estimate(problem, theta).criteria
