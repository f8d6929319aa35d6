"""Problems: which channel is which, what is scored, what cannot be used and how that is said."""

import pickle
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.errors import InvalidBounds, InvalidRecord, InvalidSettings, RecordTooShort
from sysid.core.jit import jit_compile
from sysid.core.settings import FitSettings, Loss, PredictionKind
from sysid.core.types import FloatArray
from sysid.data.records import Channel, History, Record
from sysid.simulation.evaluator import Evaluator, evaluate_population
from sysid.simulation.problem import Problem, build_simulation_problem, compute_metrics
from tests.support.library.small_models import (
    difference,
    differential,
    duffing,
    individuals,
    lag_element,
    record,
)


@jit_compile
def least(evaluator: Evaluator, theta: FloatArray) -> float:
    """Stands for a search: compiled, kept on disk, called with the evaluator as it is."""
    return float(np.min(evaluate_population(evaluator, theta)))


def test_an_evaluator_goes_into_compiled_functions_as_it_is() -> None:
    problem = Problem.build(duffing(), [record()])
    theta = individuals(problem, 20)
    assert least(problem.evaluator, theta) == problem.evaluate_fitness(theta).min()


def test_a_problem_is_rebuilt_from_a_pickle_and_gives_the_same_bits() -> None:
    problem = Problem.build(duffing(), [record()], parameters={"c": {"fixed": 0.2}}, skip=2)
    again: Problem = pickle.loads(pickle.dumps(problem))
    theta = individuals(problem, 5)
    assert [p.name for p in again.free_parameters] == ["L", "b", "a"]
    np.testing.assert_array_equal(again.evaluate_fitness(theta), problem.evaluate_fitness(theta))


def test_a_problem_that_only_simulates_is_rebuilt_from_a_pickle() -> None:
    parameters = tuple(replace(p, fixed=p.upper, scale="linear") for p in duffing().parameters)
    problem = build_simulation_problem(replace(duffing(), parameters=parameters), record())
    again: Problem = pickle.loads(pickle.dumps(problem))
    assert again.simulates_only
    empty = np.empty((1, 0))
    np.testing.assert_array_equal(again.predict(empty), problem.predict(empty))


def test_a_problem_with_changed_settings_keeps_the_others_and_equals_one_built_so() -> None:
    loss, changes = Loss("soft-l1", 0.5), {"c": {"tied": "b/20"}}
    problem = Problem.build(duffing(), [record()], parameters=changes, loss=loss, skip=2)
    changed = problem.rebuild(skip=4, scored_from=(0.3,))
    alone = Problem.build(
        duffing(), [record()], parameters=changes, loss=loss, skip=4, scored_from=[0.3]
    )
    theta = individuals(problem, 5)
    assert changed.settings == alone.settings
    assert changed.free_names == alone.free_names == ("L", "b", "a")
    assert (changed.loss_scale, problem.rebuild(loss=Loss()).loss_scale) == (0.5, 0.0)
    np.testing.assert_array_equal(changed.evaluate_fitness(theta), alone.evaluate_fitness(theta))
    with pytest.raises(TypeError, match="skips"):
        problem.rebuild(skips=1)


def test_settings_do_not_change_with_what_they_were_made_of() -> None:
    parameters, weights = {"c": {"fixed": 0.2}}, {"y": 2.0}
    settings = FitSettings(parameters, weights=weights)
    parameters.clear()
    weights.clear()
    assert settings == FitSettings({"c": {"fixed": 0.2}}, weights={"y": 2.0})


def test_a_recursion_is_scored_from_the_first_value_that_it_computes() -> None:
    model = difference({"x": "b*x(k - 1) + c*x(k - 2) + u(k - 1)"}, "x", initial={"x": "measured"})
    weight = Problem.build(model, [record(samples=30)]).evaluator.weight
    assert model.memory == 2
    assert not weight[:2].any()
    assert weight[2:].all()


def test_j_is_the_rms_error_over_the_scored_samples() -> None:
    model, blank = duffing(), record()
    y = blank.outputs[0].values.copy()
    y[[7, 12]] = np.nan
    problem = Problem.build(
        model, [replace(blank, outputs=(Channel("y", blank.outputs[0].times, y),))], skip=5
    )
    theta = individuals(problem, 3)
    error = (problem.predict(theta) - y)[:, 5:]
    expected = np.sqrt(np.nanmean(error**2, axis=1))
    np.testing.assert_allclose(problem.evaluate_fitness(theta), expected, rtol=1e-12)
    assert problem.n_scored == 23
    metrics = compute_metrics(problem, problem.predict(theta)[1])
    assert metrics.rms == pytest.approx(expected[1])
    assert metrics.unit == problem.unit == "m"
    assert metrics.channels[0].samples == 23
    assert metrics.fit_percent == pytest.approx(metrics.channels[0].fit_percent)


def test_soft_l1_is_squares_for_small_errors_and_linear_for_large_ones() -> None:
    problem = Problem.build(duffing(), [record()])
    theta = individuals(problem, 3)
    wide = Problem.build(duffing(), [record()], loss=Loss("soft-l1", 1e6))
    np.testing.assert_allclose(
        wide.evaluate_fitness(theta), problem.evaluate_fitness(theta), rtol=1e-9
    )
    narrow = Problem.build(duffing(), [record()], loss=Loss("soft-l1", 0.1))
    error = problem.predict(theta) - record().outputs[0].values
    cost = 2 * 0.01 * (np.sqrt(1 + (error / 0.1) ** 2) - 1)
    np.testing.assert_allclose(
        narrow.evaluate_fitness(theta), np.sqrt(cost.mean(axis=1)), rtol=1e-12
    )


def test_outputs_are_weighted_by_their_deviation_or_as_asked() -> None:
    outputs = {"y": "x", "z": "2*x"}
    model = differential({"x": "(u(t) - x)*b"}, "x", outputs=outputs)
    data = record(outputs=("y", "z"))
    problem = Problem.build(model, [data])
    deviation = [np.std(channel.values) for channel in data.outputs]
    parts = problem.split_by_output(problem.evaluator.weight)[0]
    np.testing.assert_allclose(parts["y"], 1 / deviation[0])
    np.testing.assert_allclose(parts["z"], 1 / deviation[1])
    assert problem.unit == "1"
    assert problem.output_scale == pytest.approx(1.0)
    chosen = Problem.build(model, [data], weights={"y": 3.0, "z": 0.5})
    theta = individuals(chosen, 2)
    part = chosen.split_by_output(chosen.predict(theta)[0])[0]
    errors = [
        (3.0 * (part["y"] - data.outputs[0].values)),
        (0.5 * (part["z"] - data.outputs[1].values)),
    ]
    expected = np.sqrt(np.mean(np.concatenate(errors) ** 2))
    assert chosen.evaluate_fitness(theta)[0] == pytest.approx(expected)


def test_outputs_of_which_every_sample_is_skipped_are_not_called_constant() -> None:
    model = differential({"x": "(u(t) - x)*b"}, "x", outputs={"y": "x", "z": "2*x"})
    with pytest.raises(InvalidRecord, match="'y' has no value after the first 9999 samples"):
        Problem.build(model, [record(outputs=("y", "z"))], skip=9999)


def test_channels_are_found_by_name_and_others_are_ignored() -> None:
    data = record()
    times = data.inputs[0].times
    extra = Channel("temperature", times, np.full(times.size, np.nan))
    more = Record((extra, *data.inputs), (extra, *data.outputs))
    theta = individuals(Problem.build(duffing(), [data]), 2)
    first, second = (
        Problem.build(duffing(), [one]).evaluate_fitness(theta) for one in (data, more)
    )
    np.testing.assert_array_equal(first, second)


def test_a_measured_start_takes_the_first_value_and_its_rate_the_first_difference() -> None:
    model = differential({"x": "v", "v": "-b*x"}, "x", initial={"x": "measured", "v": "measured"})
    data = record()
    y, times = data.outputs[0].values, data.outputs[0].times
    starts = Problem.build(model, [data]).experiments[0].starts
    assert starts[0].first_values[0] == y[0]
    assert starts[1].first_values[0] == pytest.approx((y[1] - y[0]) / times[1])


def test_times_with_few_digits_are_on_the_grid() -> None:
    times = np.round(np.arange(3000) / 610.35, 5)
    data = Record((Channel("u", times, np.sin(times)),), (Channel("y", times, times),))
    grid = Problem.build(lag_element(), [data]).experiments[0].grid
    assert grid.points == 3000
    assert grid.step == pytest.approx(1 / 610.35, rel=1e-5)


def test_an_output_that_begins_after_the_input_is_simulated_from_the_input_on() -> None:
    data = record(40)
    late = replace(data, outputs=(data.outputs[0].slice_time(0.5, 9.0),))
    whole, part = (Problem.build(lag_element(), [one]) for one in (data, late))
    theta = individuals(whole, 3)
    np.testing.assert_allclose(part.predict(theta), whole.predict(theta)[:, 10:])


def _with(values: FloatArray, role: str, name: str = "") -> Record:
    data = record()
    channel = getattr(data, role)[0]
    changed = replace(channel, values=values, name=name or channel.name)
    return replace(data, **{role: (changed,)})


GAP = np.where(np.arange(30) == 4, np.nan, 1.0)
MISSING = np.full(30, np.nan)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (_with(np.ones(30), "inputs", "u1"), r"no input 'u'; did you mean 'u1'\?"),
        (_with(np.ones(30), "outputs", "yy"), r"no output 'y'; did you mean 'yy'\?"),
        (_with(GAP, "inputs"), r"input 'u' has no finite value at 0\.2 s \(sample 4"),
        (_with(MISSING, "outputs"), r"output 'y' has 30 samples, but none with a value"),
        (record(irregular=True), r"output 'y' is not sampled regularly: sample \d+ at"),
    ],
)
def test_a_record_that_cannot_be_used_is_said_to_be_so(data: Record, message: str) -> None:
    with pytest.raises(InvalidRecord, match=message):
        Problem.build(duffing(), [data])


def test_no_record_and_a_constant_output_among_several_are_refused() -> None:
    with pytest.raises(InvalidRecord, match="no record"):
        Problem.build(duffing(), [])
    model = differential({"x": "(u(t) - x)*b"}, "x", outputs={"y": "x", "z": "2*x"})
    data = record(outputs=("y", "z"))
    flat = replace(
        data, outputs=(data.outputs[0], replace(data.outputs[1], values=np.full(30, 0.1)))
    )
    with pytest.raises(InvalidRecord, match="'z' is constant"):
        Problem.build(model, [flat])


def test_a_record_shorter_than_the_largest_lag_is_refused() -> None:
    with pytest.raises(
        RecordTooShort, match=r"lasts 0\.25 s, but the delay of 'x' needs more than"
    ):
        Problem.build(duffing(), [record(6)])
    with pytest.raises(RecordTooShort, match=r"the delay of 'u' needs more than 0\.4 s"):
        Problem.build(lag_element(), [record(6)])
    with pytest.raises(RecordTooShort, match=r"upper bound of L is .*of L: below 0\.25"):
        Problem.build(lag_element(), [record(6)])
    with pytest.raises(RecordTooShort, match=r"\(L is 0\.3.*, or a smaller L: below 0\.25"):
        Problem.build(lag_element(), [record(6)], parameters={"L": {"fixed": 0.3}})
    far = difference({"x": "0.5*x(k-12)"}, "x")
    bounds = {"F": {"lower": 0.5, "upper": 4}, "b": {"lower": 0.1, "upper": 1}}
    flow = differential({"x": "(u(t - 1/F) - x)/b"}, "x", parameters=bounds)
    with pytest.raises(RecordTooShort, match=r"lower bound of F is 0\.5\).*bound of F: above 4"):
        Problem.build(flow, [record(6)], parameters={"F": {"upper": 8}})
    with pytest.raises(RecordTooShort, match=r"\(F is 2\).*, or a larger F: above 4"):
        Problem.build(flow, [record(6)], parameters={"F": {"fixed": 2}})
    with pytest.raises(RecordTooShort, match="the model's memory"):
        Problem.build(far, [record(10)])


def test_options_that_cannot_be_used_are_refused() -> None:
    model, data = duffing(), [record()]
    with pytest.raises(InvalidSettings, match="/prediction"):
        Problem.build(model, data, prediction="free")  # type: ignore[arg-type]
    with pytest.raises(InvalidSettings, match="/skip"):
        Problem.build(model, data, skip=-1)
    with pytest.raises(InvalidSettings, match="/weights/z: the model has no output"):
        Problem.build(model, data, weights={"z": 1.0})
    with pytest.raises(InvalidSettings, match="is not a weight"):
        Problem.build(model, data, weights={"y": 0.0})
    with pytest.raises(InvalidSettings, match="no parameter 'q'"):
        Problem.build(model, data, parameters={"q": {"fixed": 1.0}})
    with pytest.raises(InvalidBounds):
        Problem.build(model, data, parameters={"c": {"lower": 2.0}})
    with pytest.raises(InvalidSettings, match=r"Need \(P, 4\)"):
        Problem.build(model, data).evaluate_fitness(np.zeros((3, 5)))
    tiny_steps = lag_element(solver={"step": 1e-9})
    with pytest.raises(InvalidSettings, match="the limit is"):
        Problem.build(tiny_steps, data)


def test_a_state_that_nothing_measures_cannot_start_measured() -> None:
    model = differential({"x": "v", "v": "-b*x"}, "2*x", initial={"x": 0, "v": 0})
    measured = Problem.build(
        differential({"x": "v", "v": "-b*x"}, "x", initial={"x": "measured", "v": 0}), [record()]
    ).model.initial
    with pytest.raises(InvalidRecord, match="state 'x' must start at its measured value"):
        Problem.build(replace(model, initial=measured), [record()])


@pytest.mark.parametrize("loss", [Loss(), Loss("soft-l1", 0.1)])
def test_the_weight_of_a_single_output_changes_nothing(loss: Loss) -> None:
    plain = Problem.build(duffing(), [record()], loss=loss)
    weighted = Problem.build(duffing(), [record()], loss=loss, weights={"y": 100.0})
    theta = individuals(plain, 3)
    np.testing.assert_array_equal(weighted.evaluate_fitness(theta), plain.evaluate_fitness(theta))


@pytest.mark.parametrize("weight", [1e-300, 1e308, np.inf, np.nan, -1.0])
def test_weights_that_no_number_can_square_are_refused(weight: float) -> None:
    with pytest.raises(InvalidSettings, match=r"/weights/y: .*need a number from"):
        Problem.build(duffing(), [record()], weights={"y": weight})


@pytest.mark.parametrize(
    ("initial", "name", "told"),
    [
        (
            0,
            "x(0)",
            "an initial state is a parameter if the model's document gives it bounds, "
            "initial: {x: {",
        ),
        (
            {"lower": -1, "upper": 1},
            "x(0)[2]",
            "the records have 1 initial state(s) of 'x': x(0) and so on",
        ),
    ],
)
def test_a_start_that_is_no_parameter_is_told_how_to_become_one(
    initial: Any, name: str, told: str
) -> None:
    model = differential({"x": "-b*x"}, "x", initial={"x": initial})
    with pytest.raises(InvalidSettings, match=re.escape(told)):
        Problem.build(model, [record()], parameters={name: {"fixed": 0.5}})


@pytest.mark.parametrize("prediction", ["simulation", "one-step"])
@pytest.mark.parametrize("is_even", [True, False])
def test_other_outputs_make_the_arrays_of_a_new_problem(
    is_even: bool, prediction: PredictionKind
) -> None:
    """Also where other samples are missing, and where the start is the first measured value."""
    t = 0.1 * np.arange(40.0)
    when = t if is_even else t + 0.03 * np.sin(7.0 * t)
    force = Channel("u", t, np.sin(t), "V")
    model = differential({"x": "u(t - L) - b*x"}, "x", initial={"x": "measured"})
    records = []
    for seed, missing in ((1, []), (2, []), (3, [0, 7, 8]), (4, [7])):
        values = np.cos(when) + np.random.default_rng(seed).normal(0.0, 0.1, when.size)
        values[missing] = np.nan
        records.append(Record((force,), (Channel("y", when, values, "m"),)))
    before = Problem.build(model, records[:1], prediction=prediction, skip=1)
    for one in records[1:]:
        before = before.replace_outputs([one])
        alone = Problem.build(model, [one], prediction=prediction, skip=1)
        for replaced, built in zip(before.evaluator, alone.evaluator, strict=True):
            np.testing.assert_array_equal(replaced, built)
        assert before.output_scale == alone.output_scale


def _list_other_inputs(force: Channel, side: Channel) -> list[tuple[Channel, Channel]]:
    """Inputs of other values, holds and histories, on the same times."""
    before = History(force.times[:5] - 0.5, np.full(5, 2.0))
    return [
        (replace(force, values=np.clip(force.values, -0.5, 0.5), hold="zero"), side),
        (replace(force, values=force.values**2, hold="zero", history=before), side),
        (replace(force, values=np.roll(force.values, 1), hold="first"), side),
        (force, replace(side, values=-side.values)),
    ]


@pytest.mark.parametrize("delay", ["L", "L + abs(v)"])
@pytest.mark.parametrize("number", range(4))
def test_other_inputs_make_the_arrays_of_a_new_problem(number: int, delay: str) -> None:
    """Also those of another hold, and of an input that a delay reads."""
    t = 0.1 * np.arange(60.0)
    force, side = Channel("u", t, np.sin(t), "V", hold="zero"), Channel("v", t, np.cos(t), "s")
    outputs = (Channel("y", t, np.cos(t), "m"),)
    equation = f"u(t - ({delay})) - b*x(t - L) + v(t)"
    inputs = {"u": "V", "v": "s"}
    model = differential({"x": equation}, "x", inputs=inputs, initial={"x": "measured"})
    other = Record((replace(force, values=np.cos(t)), side), outputs)
    first = [Record((force, side), outputs), other]
    changed = [Record(_list_other_inputs(force, side)[number], outputs), other]
    problem = Problem.build(model, first, skip=1)
    before = [array.copy() for array in map(np.asarray, problem.evaluator)]
    replaced, alone = problem.replace_inputs(changed), Problem.build(model, changed, skip=1)
    for one, built in zip(replaced.evaluator, alone.evaluator, strict=True):
        np.testing.assert_array_equal(one, built)
    for one, kept in zip(problem.evaluator, before, strict=True):
        np.testing.assert_array_equal(one, kept)


def test_nothing_that_depends_on_inputs_is_shared_with_a_problem_of_others() -> None:
    problem = Problem.build(duffing(), [record()])
    (force,) = record().inputs
    other = replace(record(), inputs=(replace(force, hold="first"),))
    assert problem.share("hold", lambda: problem.records[0].inputs[0].hold) == force.hold
    replaced = problem.replace_inputs([other])
    assert replaced.share("hold", lambda: replaced.records[0].inputs[0].hold) == "first"


def test_what_outputs_do_not_change_is_computed_once_for_all_of_them() -> None:
    calls: list[int] = []
    first = Problem.build(duffing(), [record()])

    def compute() -> int:
        calls.append(1)
        return len(calls)

    (channel,) = record().outputs
    other = replace(record(), outputs=(replace(channel, values=channel.values + 0.1),))
    assert first.share("number", compute) == 1
    assert first.replace_outputs([other]).share("number", compute) == 1
    assert first.rebuild(skip=3).share("number", compute) == 2
