"""A recorded channel that acts is another input; copies, sensors, clocks and set points are not."""

import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from sysid.core.findings import Finding
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record, Recording
from sysid.judgement.judge import Explained, explain_residuals
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from tests.support.library.judged_records import (
    FAST,
    FINE,
    NOISE,
    PLANTS,
    SLOW,
    STEP,
    TIMES,
    N,
    Process,
    build_context,
    draw_levels,
    draw_noise,
    explain,
    hold,
    make_record,
)


def lag(values: FloatArray, samples: float) -> FloatArray:
    """Filter values (n,) by a time constant of some samples."""
    pole = np.exp(-1.0 / samples)
    return np.asarray(lfilter([0.0, 1.0 - pole], [1.0, -pole], values - values[0]))


def add_channels(record: Record, **channels: FloatArray) -> Record:
    others = tuple(Channel(name, TIMES, values) for name, values in channels.items())
    return replace(record, others=others)


def find_others(explained: Explained) -> list[Finding]:
    return [one for one in explained.findings if one.explanation == "another input"]


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.model)
@pytest.mark.parametrize(
    "act",
    [
        pytest.param(lambda w: lag(w, 9.0), id="slowly"),
        pytest.param(lambda w: np.append(np.zeros(7), lag(w, 3.0)[:-7]), id="late"),
    ],
)
def test_a_channel_that_acts_beside_the_plant_is_found(
    plant: Process, act: Callable[[FloatArray], FloatArray]
) -> None:
    u, w = draw_levels(1), draw_levels(11)
    y = plant.respond(hold(u))[::FINE] + 0.3 * act(w) + NOISE * draw_noise(1)
    first = explain(plant, add_channels(make_record(u, y), w=w)).findings[0]
    assert first.explanation == "another input"
    assert first.family == "input"
    assert "w acts" in first.brief
    assert "Add w to the inputs" in first.advice


def test_a_channel_that_acts_at_the_input_of_the_plant_is_found() -> None:
    u, w = draw_levels(1), 20.0 + 5.0 * draw_levels(11)
    y = SLOW.respond(hold(u + 0.05 * (w - w[0])))[::FINE] + NOISE * draw_noise(1)
    first = explain(SLOW, add_channels(make_record(u, y), w=w)).findings[0]
    assert first.explanation == "another input"
    assert "at the input of the plant, as u does" in first.text
    assert "a term c*w to u" in first.advice


def test_the_advice_is_a_model_that_explains_the_record() -> None:
    u, w = draw_levels(1), draw_levels(11)
    clean = FAST.respond(hold(u + 0.4 * (w - w[0])))[::FINE]
    record = make_record(u, clean + NOISE * draw_noise(1))
    document = dict(load_model("fopdt").document)
    document["inputs"] = {**document["inputs"], "w": "1"}
    document["parameters"] = {**document["parameters"], "c": {"lower": -2.0, "upper": 2.0}}
    document["equations"] = {"x": "(K*(u(t - L) + c*w(t - L)) - x)/T"}
    second = replace(record, inputs=(*record.inputs, Channel("w", TIMES, w - w[0], hold="zero")))
    model = parse_model(document)
    context = build_context([second], model, {**FAST.values, "c": 0.3}, initial="free")
    assert explain_residuals(context).findings == ()


def draw_innocents(clean: FloatArray, y: FloatArray, u: FloatArray) -> dict[str, FloatArray]:
    random = np.random.default_rng(5)
    return {
        "y_in_another_unit": 1.8 * y + 32.0,
        "second_sensor": clean + 3.0 * NOISE * random.standard_normal(N),
        "better_sensor": clean,
        "slow_sensor": lag(y, 8.0) + y[0],
        "rounded_y": np.round(5.0 * y) / 5.0,
        "u_in_per_cent": 50.0 * u,
        "counter": np.arange(float(N)),
        "walk": np.cumsum(random.standard_normal(N)),
        "day": np.sin(TIMES / 20.0),
        "valve": draw_levels(17),
        "constant": np.full(N, 4.0),
        "noise": random.standard_normal(N),
    }


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.model)
@pytest.mark.parametrize("pole", [0.0, 0.8])
def test_innocent_channels_leave_a_sound_record_plain(plant: Process, pole: float) -> None:
    u = draw_levels(2)
    clean = plant.respond(hold(u))[::FINE]
    y = clean + NOISE * draw_noise(2, pole)
    record = add_channels(make_record(u, y), **draw_innocents(clean, y, u))
    assert explain(plant, record).findings == ()


def test_innocent_channels_are_no_reason_where_the_model_is_wrong() -> None:
    u = draw_levels(2)
    third = Process("sopdt", (4.0, 1.5, 1.2), gain=-1.5, delay=1.4)
    clean = third.respond(hold(u))[::FINE]
    y = clean + 0.2 * NOISE * draw_noise(2)
    record = add_channels(make_record(u, y), **draw_innocents(clean, y, u))
    explained = explain(Process("fopdt", (4.0,), gain=-1.5, delay=2.0), record)
    assert explained.findings
    assert not find_others(explained)


def test_a_set_point_acts_through_the_input_only() -> None:
    for seed in range(3):
        target, noise = draw_levels(seed, most=60), draw_noise(seed)
        y, u, state, late = np.zeros(N), np.zeros(N), 0.0, np.zeros(5)
        total = 0.0
        for k in range(N):
            y[k] = state + NOISE * noise[k]
            total += 0.06 * (target[k] - y[k])
            u[k] = 0.4 * (target[k] - y[k]) + total
            late = np.append(u[k], late[:-1])
            state += (2.0 * late[-1] - state) * -np.expm1(-STEP / 3.0)
        record = add_channels(make_record(u, y), set_point=target)
        explained = explain(Process("fopdt", (3.0,), delay=4.0 * STEP, offset=0.0), record)
        assert not find_others(explained)


def test_a_channel_with_gaps_and_other_times_is_read() -> None:
    u, w = draw_levels(1), draw_levels(11)
    y = FAST.respond(hold(u))[::FINE] + 0.3 * lag(w, 9.0) + NOISE * draw_noise(1)
    values = np.where(np.arange(N) % 50 == 7, np.nan, w)
    other = Channel("w", TIMES[:-40], values[:-40])
    record = replace(make_record(u, y), others=(other,))
    assert find_others(explain(FAST, record))


def test_what_is_not_used_stays_beside_the_record() -> None:
    names = ("t", "u", "y", "w", "v")
    recording = Recording({name: TIMES if name == "t" else draw_levels(3) for name in names})
    record = recording.to_record({"u": "u"}, {"y": "y"})
    assert [one.name for one in record.others] == ["w", "v"]
    assert [*record] == ["u", "y"]


def test_a_search_is_not_sent_what_it_does_not_read() -> None:
    u = draw_levels(1)
    record = add_channels(make_record(u, FAST.respond(hold(u))[::FINE]), w=draw_levels(11))
    problem = build_context([record], "fopdt", FAST.values).problem
    assert problem.records[0].others
    assert not pickle.loads(pickle.dumps(problem)).records[0].others


def test_what_an_input_drives_late_is_no_input() -> None:
    """The plant has a second path, which a sensor on it sees before the output does."""
    for seed in range(3):
        u = draw_levels(seed)
        late = np.append(np.full(45, u[0]), u[:-45])
        acts = lag(np.append(np.full(6, u[0]), late[:-6]), 5.0)
        y = FAST.respond(hold(u))[::FINE] + 0.3 * acts + NOISE * draw_noise(seed)
        record = add_channels(make_record(u, y), w=late + 0.02 * draw_noise(seed + 50))
        assert not find_others(explain(FAST, record))


def test_a_better_sensor_of_a_load_is_no_input() -> None:
    for seed in (0, 2):
        u = draw_levels(seed)
        load = lfilter([1.0], [1.0, -0.97], draw_noise(seed + 70))
        clean = FAST.respond(hold(u))[::FINE] + load
        record = make_record(u, clean + draw_noise(seed))
        second = add_channels(record, w=clean + 0.01 * draw_noise(seed + 50))
        assert not find_others(explain(FAST, second))
