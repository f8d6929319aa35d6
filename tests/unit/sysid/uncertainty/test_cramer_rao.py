"""The Cramér–Rao bound: that of a linear model is known, and how it is written changes nothing."""

import numpy as np
import pytest

from sysid.core.errors import InvalidSettings
from sysid.data.noise import Noise, add_output_noise
from sysid.data.records import Channel, Record
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.uncertainty.cramer_rao import cramer_rao_bound
from tests.support.library.small_models import LINE
from tests.support.profiles import draw_seeds

TIMES = np.arange(200) * 0.1
INPUT = np.sin(1.3 * TIMES) + 0.2 * TIMES


def build_problem(document=LINE, skip=0, **options):
    model = parse_model(document)
    signals = Channel("u", TIMES, INPUT), Channel("y", TIMES, 2.0 * INPUT + 1.0)
    record = Record(inputs=signals[:1], outputs=signals[1:])
    return Problem.build(model, [record], skip=skip, **{"weights": {"y": 1.0}, **options})


@pytest.mark.parametrize("skip", [0, 50])
def test_the_bound_of_a_linear_model_is_that_of_its_regressors(skip):
    found = cramer_rao_bound(build_problem(skip=skip), np.array([2.0, 1.0]))
    regressors = np.column_stack([INPUT, np.ones(INPUT.size)])[skip:]
    expected = np.sqrt(np.diag(np.linalg.inv(regressors.T @ regressors)))
    assert found.names == ("a", "b")
    np.testing.assert_allclose(found.stderr, expected, rtol=1e-6)
    assert found.samples == 200 - skip
    assert found.response_rms == pytest.approx(np.sqrt(2 / (200 - skip)))


def test_bounds_and_scale_of_the_search_do_not_change_the_bound():
    theta = np.array([2.0, 1.0])
    linear = cramer_rao_bound(build_problem(), theta)
    changed = {"a": {"lower": 0.5, "upper": 200.0, "scale": "log"}, "b": {"lower": 1.0}}
    np.testing.assert_allclose(
        cramer_rao_bound(build_problem(parameters=changed), theta).stderr, linear.stderr, rtol=1e-4
    )


def test_a_product_of_which_the_data_tell_no_factor_has_none_but_the_others_keep_theirs():
    document = {
        **LINE,
        "outputs": {"y": "a*c*u(t) + b + x"},
        "parameters": {**LINE["parameters"], "c": {"lower": 0.1, "upper": 10}},
    }
    found = cramer_rao_bound(build_problem(document), np.array([1.0, 1.0, 2.0]))
    known = dict(zip(found.names, found.stderr.tolist(), strict=True))
    assert np.isinf(known["a"])
    assert np.isinf(known["c"])
    assert known["b"] == pytest.approx(
        cramer_rao_bound(build_problem(), np.array([2.0, 1.0])).stderr[1], rel=1e-5
    )
    assert found.response_rms == pytest.approx(np.sqrt(2 / 200))


def test_no_least_squares_estimate_is_better_than_the_bound_and_its_spread_reaches_it():
    generator = np.random.default_rng(5)
    regressors = np.column_stack([INPUT, np.ones(INPUT.size)])
    noisy = (regressors @ [2.0, 1.0])[:, None] + 0.3 * generator.standard_normal((200, 4000))
    spread = np.std(np.linalg.lstsq(regressors, noisy, rcond=None)[0], axis=1)
    least = 0.3 * cramer_rao_bound(build_problem(), np.array([2.0, 1.0])).stderr
    np.testing.assert_allclose(spread, least, rtol=0.05)


def test_weights_that_are_not_one_are_refused():
    model = parse_model({**LINE, "outputs": {"y": "a*u(t) + b + x", "z": "b*u(t)"}})
    outputs = tuple(Channel(name, TIMES, INPUT) for name in "yz")
    record = Record(inputs=(Channel("u", TIMES, INPUT),), outputs=outputs)
    weighted = Problem.build(model, [record], weights={"y": 1.0, "z": 2.0})
    with pytest.raises(InvalidSettings, match="weight 1"):
        cramer_rao_bound(weighted, np.array([2.0, 1.0]))


LAGGED = {
    "name": "lagged",
    "form": "differential",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {
        "K": {"lower": 0.1, "upper": 10},
        "T": {"lower": 0.1, "upper": 10, "unit": "s"},
        "L": {"lower": 0, "upper": 1, "unit": "s"},
        "y0": {"lower": -1, "upper": 1},
    },
    "equations": {"x": "(K*u(t - L) - x)/T"},
    "outputs": {"y": "x + y0"},
    "initial": {"x": {"lower": -1, "upper": 1}},
}


def few(samples: int, document=LAGGED) -> Problem:
    times = 2.0 * np.arange(samples)
    signals = Channel("u", times, np.where(times > 0.5, 1.0, 0.0)), Channel("y", times, times)
    return Problem.build(
        parse_model(document), [Record(signals[:1], signals[1:])], weights={"y": 1.0}
    )


@pytest.mark.parametrize("samples", [2, 3])
def test_fewer_samples_than_parameters_tell_none_of_those_they_mix(samples):
    found = cramer_rao_bound(few(samples), np.array([0.5, 1.0, 0.3, 0.1, 0.2]))
    assert found.samples == samples
    assert found.response_rms <= 1.0
    assert np.isinf(found.stderr).all()


def test_what_few_samples_tell_by_itself_keeps_its_bound():
    document = {
        **LINE,
        "inputs": {},
        "outputs": {"y": "a + b*c*0 + x"},
        "parameters": {**LINE["parameters"], "c": {"lower": 0.1, "upper": 10}},
    }
    times = np.array([0.0, 1.0])
    record = Record((), (Channel("y", times, np.ones(2)),))
    posed = Problem.build(parse_model(document), [record], weights={"y": 1.0})
    found = dict(
        zip(["a", "b", "c"], cramer_rao_bound(posed, np.array([1.0, 1.0, 2.0])).stderr, strict=True)
    )
    assert found["a"] == pytest.approx(np.sqrt(1 / 2), rel=1e-6)
    assert np.isinf([found["b"], found["c"]]).all()


def test_the_bound_of_two_outputs_is_that_of_the_noise_that_a_job_adds_to_them():
    """It is drawn for each by itself: were it common, y and w would tell a no better than y."""
    two = {**LINE, "outputs": {"y": "a*u(t) + b + x", "w": "a*u(t) - b + x"}}
    model = parse_model(two)
    u = Channel("u", TIMES, INPUT)
    exact = (Channel("y", TIMES, 2.0 * INPUT + 1.0), Channel("w", TIMES, 2.0 * INPUT - 1.0))
    weights = {"y": 1.0, "w": 1.0}
    found = cramer_rao_bound(
        Problem.build(model, [Record((u,), exact)], weights=weights), np.array([2.0, 1.0])
    )
    noises, estimates, seeds = [], [], draw_seeds(gate=400, night=4000)
    regressors = np.vstack([np.column_stack([INPUT, sign * np.ones(200)]) for sign in (1.0, -1.0)])
    for seed in seeds:
        outputs = add_output_noise(Record((u,), exact), Noise(0.1, seed=seed)).outputs
        values = np.concatenate([one.values for one in outputs])
        noises.append(values - regressors @ [2.0, 1.0])
        estimates.append(np.linalg.lstsq(regressors, values, rcond=None)[0])
    first, second = np.array(noises)[:, :200].ravel(), np.array(noises)[:, 200:].ravel()
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(first.size)
    room = 3.9 / np.sqrt(2 * len(seeds))  # of a standard deviation, in its standard errors
    np.testing.assert_allclose(np.std(estimates, axis=0), 0.1 * found.stderr, rtol=room)


@pytest.mark.parametrize("at_bound", [False, True])
def test_a_rounded_lag_has_no_bound_and_the_others_keep_theirs(at_bound):
    """The response jumps with it, on both sides or at a bound on one."""
    document = {**LAGGED, "solver": {"interpolation": "nearest"}, "initial": {"x": 0}}
    times = 0.1 * np.arange(100)
    u = np.sign(np.sin(2.0 * times) + 0.3 * np.cos(5.0 * times))
    record = Record((Channel("u", times, u, hold="zero"),), (Channel("y", times, np.sin(times)),))
    found = {}
    for lag in ({"lower": 0.2 if at_bound else 0.0, "upper": 1.0}, {"fixed": 0.2}):
        posed = Problem.build(
            parse_model(document), [record], weights={"y": 1.0}, parameters={"L": lag}
        )
        truth = {"K": 0.5, "T": 1.0, "L": 0.2, "y0": 0.1}
        bound = cramer_rao_bound(posed, np.array([truth[name] for name in posed.free_names]))
        found[len(bound.names)] = dict(zip(bound.names, bound.stderr.tolist(), strict=True))
    assert np.isinf(found[4].pop("L"))
    assert np.all(np.isfinite(list(found[3].values())))
    if at_bound:
        assert found[4] == pytest.approx(found[3], rel=1e-6)
    else:
        assert min(found[4][name] / value for name, value in found[3].items()) >= 1.0 - 1e-6
        assert max(found[4].values()) < np.inf
