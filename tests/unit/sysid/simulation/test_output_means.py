"""Values that are means over a period: what acts, and what an output is compared with."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.settings import PredictionKind
from sysid.core.types import FloatArray
from sysid.data.interpolation import interpolate_channel
from sysid.data.records import Channel, History, HoldSetting, Record
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model, replace_substeps
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
from tests.support.library.judged_records import FAST, FINE, STEP, TIMES, N, draw_levels, hold
from tests.support.library.small_models import difference

U = draw_levels(4)
VALUES = {**FAST.values, "x(0)": 0.0}


def average_periods(fine: FloatArray) -> FloatArray:
    """Average a signal on the fine grid over each sampling period, (N,)."""
    whole = np.append(fine, fine[-1])
    middle = 0.5 * (whole[1:] + whole[:-1])
    return np.asarray(middle.reshape(N, FINE).mean(axis=1))


def predict(reading: HoldSetting, values: FloatArray) -> FloatArray:
    """Predict an output by the parameters of the plant."""
    record = Record((Channel("u", TIMES, U, hold="zero"),), (Channel("y", TIMES, values),))
    model = replace_substeps(load_model("fopdt"), 10)
    problem = Problem.build(model, [record.replace_holds({"y": reading})], initial="rest")
    point = np.array([[VALUES[name] for name in problem.free_names]])
    return np.asarray(problem.predict(point)[0])


def test_the_simulated_output_is_averaged_over_the_same_period() -> None:
    response = FAST.respond(hold(U))
    means, size = average_periods(response), float(np.ptp(response))
    after = predict("mean-after", response[::FINE])
    np.testing.assert_allclose(after[:-1], means[:-1], atol=3e-4 * size)
    up_to = predict("mean", response[::FINE])
    np.testing.assert_allclose(up_to[1:], means[:-1], atol=3e-4 * size)
    assert up_to[0] == pytest.approx(response[0])
    plain = predict("auto", response[::FINE])
    np.testing.assert_allclose(plain, response[::FINE], atol=3e-4 * size)
    assert np.max(np.abs(up_to - plain)) > 0.05 * size


@pytest.mark.parametrize("reading", ["mean", "mean-after"])
def test_other_values_are_averaged_over_the_same_period(reading: HoldSetting) -> None:
    """A sweep replaces the values of outputs, and nothing else."""
    first, second = (
        Record((Channel("u", TIMES, U),), (Channel("y", TIMES, seed * TIMES, hold=reading),))
        for seed in (1.0, 2.0)
    )
    problem = Problem.build(load_model("fopdt"), [first])
    point = 0.5 * (problem.evaluator.lower + problem.evaluator.upper)[None]
    replaced, built = (
        problem.replace_outputs([second]),
        Problem.build(load_model("fopdt"), [second]),
    )
    bounded = built.rebuild(parameters={p.name: {"lower": p.lower} for p in built.free_parameters})
    np.testing.assert_array_equal(replaced.predict(point), bounded.predict(point))
    np.testing.assert_array_equal(replaced.predict(point), problem.predict(point))


def test_a_mean_of_an_input_acts_from_the_sample_before_on() -> None:
    record = Channel("u", [0.0, 1.0, 2.0, 3.0], [0.0, 5.0, 7.0, 1.0], hold="mean")
    acting = record.acting
    assert acting.hold == "zero"
    np.testing.assert_array_equal(acting.times, [-1.0, 0.0, 1.0, 2.0])
    np.testing.assert_array_equal(
        interpolate_channel(record, np.array([-2.0, -0.5, 0.5, 1.5, 2.5, 9.0])),
        [0.0, 0.0, 5.0, 7.0, 1.0, 1.0],
    )
    assert replace(record, hold="mean-after").acting.hold == "zero"
    np.testing.assert_array_equal(replace(record, hold="mean-after").acting.times, record.times)


def test_a_mean_has_the_period_of_the_samples_before_it() -> None:
    past = History(np.array([-3.0, -1.0]), np.array([8.0, 9.0]))
    acting = Channel("u", [0.0, 1.0], [2.0, 3.0], hold="mean", history=past).acting
    assert acting.history is not None
    np.testing.assert_array_equal(acting.history.times, [-4.0, -3.0])
    np.testing.assert_array_equal(acting.times, [-1.0, 0.0])
    plain = Channel("u", [0.0, 1.0], [2.0, 3.0], hold="first")
    assert plain.acting is plain


def test_means_move_a_response_by_a_whole_period() -> None:
    """Held values that are logged as the mean of the period before."""
    late = np.append(U[:1], U[:-1])
    means = simulate("fopdt", Channel("u", TIMES, late, hold="mean"), VALUES)
    values = simulate("fopdt", Channel("u", TIMES, U, hold="zero"), VALUES)
    np.testing.assert_array_equal(means["y"].values[:-1], values["y"].values[:-1])


UNEVEN = np.append(TIMES[:-1], TIMES[-1] + 0.3 * STEP)


@pytest.mark.parametrize(
    ("model", "times", "prediction", "detail"),
    [
        (load_model("fopdt"), UNEVEN, "simulation", "its times are irregular"),
        (load_model("fopdt"), TIMES, "one-step", "a prediction one step ahead needs values"),
        (
            difference({"x": "b*x(k-1) + u(k-1)"}, "x"),
            TIMES,
            "simulation",
            "a recursion needs values",
        ),
    ],
)
def test_means_that_cannot_be_used_are_refused(
    model: Model, times: FloatArray, prediction: PredictionKind, detail: str
) -> None:
    record = Record((Channel("u", times, U),), (Channel("y", times, U, hold="mean"),))
    with pytest.raises(InvalidSettings, match=f"/hold/y: .*{detail}"):
        Problem.build(model, [record], prediction=prediction)


def test_experiments_share_what_an_output_is() -> None:
    records = [
        Record((Channel("u", scale * TIMES, U),), (Channel("y", scale * TIMES, U, hold=reading),))
        for scale, reading in ((1.0, "mean"), (1.0, "auto"), (2.0, "mean"))
    ]
    for other in records[1:]:
        with pytest.raises(InvalidSettings, match=r"/hold/y: .*means of one period in all"):
            Problem.build(load_model("fopdt"), [records[0], other])


def test_an_input_of_means_at_irregular_times_is_refused() -> None:
    record = Record((Channel("u", UNEVEN, U, hold="mean"),), (Channel("y", UNEVEN, U),))
    with pytest.raises(InvalidRecord, match=r"channel 'u' has means .*Resample it first"):
        Problem.build(load_model("fopdt"), [record])
