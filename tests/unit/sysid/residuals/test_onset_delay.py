"""The onset delay: read from the measurement, against systems whose delay is known."""

import numpy as np
import pytest

from service.formats.tabular.csv_recordings import read_csv
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Hold, Record
from sysid.models.catalogue.load import load_model
from sysid.residuals import onset_delay
from sysid.residuals.onset_delay import OnsetDelay, estimate_onset_delays, find_unprompted_output
from tests.support.requirements import DATA

STEP, HOLD = 0.01, 300
LEVELS = np.array([0.0, 1.0, 0.4, 0.9, 0.1, 0.6])
K, T, L = 2.0, 0.35, 0.127


def compute_response(times: FloatArray, delay: float = L) -> FloatArray:
    """Exact response of a first-order system behind a delay to the steps of `LEVELS`."""
    y = np.zeros(times.size)
    before = 0.0
    for number, level in enumerate(LEVELS):
        begins = number * HOLD * STEP + delay
        y += K * (level - before) * np.where(times < begins, 0, 1 - np.exp(-(times - begins) / T))
        before = level
    return y


TIMES = np.arange(LEVELS.size * HOLD) * STEP
EXPECTED = L - T * np.log(1 - 0.02)  # 2 % of a first-order response come so much later


def delays(
    u: FloatArray,
    y: FloatArray,
    *,
    times: FloatArray = TIMES,
    hold: Hold = "zero",
    others: tuple[Channel, ...] = (),
) -> OnsetDelay:
    record = Record(
        (Channel("u", TIMES[: u.size], u, hold=hold), *others), (Channel("y", times, y),)
    )
    return estimate_onset_delays(load_model("fopdt"), (record,))[0]


def make_steps() -> FloatArray:
    return np.repeat(LEVELS, HOLD)


def test_without_noise_it_is_the_delay_and_two_per_cent_of_the_rise() -> None:
    found = delays(make_steps(), compute_response(TIMES))
    assert found.delay == pytest.approx(EXPECTED, abs=0.002)
    assert found.events == LEVELS.size - 1
    assert found.threshold == 0.02
    assert found.spread is not None
    assert found.spread < 0.003


@pytest.mark.parametrize("seed", range(5))
def test_with_noise_it_is_a_few_samples_off_at_most(seed: int) -> None:
    noise = 0.005 * np.random.default_rng(seed).normal(size=TIMES.size)
    found = delays(make_steps(), compute_response(TIMES) + noise)
    assert found.delay == pytest.approx(EXPECTED, abs=0.02)
    assert found.threshold is not None
    assert found.threshold >= 0.02


def test_a_later_output_has_a_delay_that_is_longer_by_as_much() -> None:
    first, later = (delays(make_steps(), compute_response(TIMES, lag)).delay for lag in (0.1, 0.35))
    assert first is not None
    assert later == pytest.approx(first + 0.25, abs=0.003)


def test_one_event_that_is_answered_late_does_not_move_it() -> None:
    late = compute_response(TIMES)
    turn = 3 * HOLD
    held_back = compute_response(TIMES, L + 0.5)
    late[turn : turn + HOLD] = held_back[turn : turn + HOLD]  # one step of five
    found = delays(make_steps(), late)
    assert found.events == LEVELS.size - 1
    assert found.delay == pytest.approx(EXPECTED, abs=0.002)
    assert found.spread is not None
    assert found.spread > 0.1


def test_a_ramp_of_the_input_is_not_counted_as_delay() -> None:
    ramp = np.interp(TIMES, [1.0, 1.4], [0.0, 1.0])
    late = np.interp(TIMES - 0.3, [1.0, 1.4], [0.0, 1.0])
    assert delays(ramp, late, hold="first").delay == pytest.approx(0.3, abs=0.002)


def test_missing_and_irregular_samples_of_the_output_do_no_harm() -> None:
    draw = np.random.default_rng(1)
    times = np.sort(draw.uniform(0, TIMES[-1], TIMES.size))
    y = compute_response(times)
    y[draw.random(times.size) < 0.1] = np.nan
    assert delays(make_steps(), y, times=times).delay == pytest.approx(EXPECTED, abs=0.02)


def test_the_unit_of_neither_signal_matters() -> None:
    plain = delays(make_steps(), compute_response(TIMES))
    other = delays(1e5 * make_steps() + 3e5, -4e3 * compute_response(TIMES) + 7.0)
    assert other.delay == pytest.approx(plain.delay, abs=1e-9)
    assert other.events == plain.events


@pytest.mark.parametrize(
    ("u", "y", "reason"),
    [
        (np.sin(TIMES), compute_response(TIMES), "does not rest"),
        (np.ones(TIMES.size), compute_response(TIMES), "does not rest"),
        (make_steps(), np.random.default_rng(0).normal(size=TIMES.size), "not clear"),
        (make_steps(), 0.3 * TIMES + compute_response(TIMES), "does not rest before any step"),
        (make_steps(), np.zeros(TIMES.size), "not clear"),
    ],
    ids=["sine", "constant", "noise", "drift", "nothing"],
)
def test_what_has_no_clear_onset_says_why(u: FloatArray, y: FloatArray, reason: str) -> None:
    found = delays(u, y)
    assert found.delay is None
    assert found.events == 0
    assert reason in found.reason


def test_steps_at_which_another_input_moves_too_do_not_count() -> None:
    model = load_model("fopdt")
    two = Channel("u", TIMES, make_steps(), hold="zero")
    moving = Channel("other", TIMES, np.sin(9 * TIMES))
    record = Record((two, moving), (Channel("y", TIMES, compute_response(TIMES)),))
    # The model has one input only: what else was recorded is no cause.
    assert estimate_onset_delays(model, (record,))[0].delay is not None
    assert len(estimate_onset_delays(model, (record,))) == 1


@pytest.mark.data
@pytest.mark.parametrize("length", [20, 40, 80])
@pytest.mark.parametrize("pattern", [1, 2])
def test_of_a_long_tube_it_is_about_3_46_ms_a_metre(length: int, pattern: int) -> None:
    file = DATA / "tube_reference" / f"tube_{length:03d}m_pattern{pattern}.csv"
    recording, _ = read_csv(file)
    record = recording.to_record({"u": "P1_meas_Pa"}, {"y": "P2_meas_Pa"})
    found = estimate_onset_delays(load_model("fopdt"), (record,))[0]
    assert found.delay == pytest.approx(3.46e-3 * length, rel=0.1)


def test_a_channel_s_noise_is_taken_as_often_for_many_events_as_for_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[int] = []
    noise = onset_delay._estimate_noise

    def count_and_estimate(values: FloatArray) -> float:
        calls.append(values.size)
        return noise(values)

    monkeypatch.setattr(onset_delay, "_estimate_noise", count_and_estimate)
    counts = []
    for u in (np.where(make_steps() > 0, 1.0, 0.0), make_steps()):
        calls.clear()
        onset_delay._find_cached_rests.cache_clear()  # of what other tests have looked at
        other = Channel("v", TIMES, np.zeros(TIMES.size))
        assert delays(u, compute_response(TIMES), others=(other,)).events > 0
        counts.append(len(calls))
    assert counts[0] == counts[1]


def test_of_many_events_an_even_part_gives_the_same_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    times = np.arange(200 * HOLD) * STEP
    u = np.tile(make_steps(), 34)[: times.size]
    lag = 13
    y = np.concatenate([np.zeros(lag), u[:-lag]])
    record = Record((Channel("u", times, u, hold="zero"),), (Channel("y", times, y),))
    (every,) = estimate_onset_delays(load_model("fopdt"), (record,))
    monkeypatch.setattr(onset_delay, "_MAX_EVENTS", 40)
    (some,) = estimate_onset_delays(load_model("fopdt"), (record,))
    assert every.events > 150
    assert 20 < some.events <= 40
    assert some.delay == pytest.approx(every.delay, abs=1e-9)


def test_of_a_square_wave_both_edges_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onset_delay, "_MAX_EVENTS", 40)
    times, falls = 0.1 * np.arange(79 * 30 + 20), np.arange(79) % 2 == 1
    u, y = np.zeros(times.size), np.zeros(times.size)
    for event, does_fall in enumerate(falls):
        at, late = 20 + 30 * event, 8 if does_fall else 3  # samples: it opens faster than it shuts
        u[at:], y[at + late :] = not does_fall, not does_fall
    record = Record((Channel("u", times, u, hold="zero"),), (Channel("y", times, y),))
    (found,) = estimate_onset_delays(load_model("fopdt"), (record,))
    assert found.events == 40
    assert found.delay is not None
    assert found.spread == pytest.approx(0.25, abs=0.01)  # half the delays' difference


def _step_test(rest: float, noise: float = 0.0, creep: float = 0.0) -> Record:
    """A first-order lag with a dead time of 2 s; the input steps after `rest` s, and at 25 s."""
    times = np.arange(400) * 0.1
    command = np.where(times >= rest, 1.0, 0.0) - np.where(times > 25.0, 0.7, 0.0)
    late = np.interp(times - 2.0, times, command, left=0.0)
    response = np.zeros_like(times)
    for k in range(1, times.size):
        response[k] = response[k - 1] + 0.1 * (late[k - 1] - response[k - 1]) / 3.0
    response += creep * np.exp(-times / 3.0)
    response += np.random.default_rng(5).normal(0.0, noise, times.size)
    return Record((Channel("u", times, command, hold="zero"),), (Channel("y", times, response),))


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_record_that_begins_with_its_step_is_told_apart(noise: float) -> None:
    alone = find_unprompted_output(_step_test(0.0, noise))
    assert alone is not None
    assert alone[0] == "y"
    assert alone[1] == pytest.approx(2.0, abs=0.4)
    assert find_unprompted_output(_step_test(5.0, noise)) is None


def test_noise_in_a_record_in_which_nothing_moves_is_no_move() -> None:
    times = np.arange(120) * 0.1
    still = Channel("u", times, np.zeros(120), hold="zero")
    slow = np.where(times < 4.0, 0.0, 0.2) + np.random.default_rng(1).normal(0.0, 0.01, 120)
    record = Record((still,), (Channel("y", times, slow),))
    assert find_unprompted_output(record) is not None
    assert find_unprompted_output(record, {"y": 4.0}) is None
    step = _step_test(0.0, 0.02)
    assert find_unprompted_output(step, {"y": 1.0}) == find_unprompted_output(step)


def test_where_both_grow_from_nothing_the_output_does_not_move_alone() -> None:
    times = np.arange(4000) * 0.01
    grown = (times / 40.0) ** 2 * np.sin(5.0 * times)
    before = Channel("u", times, grown)
    earlier = Channel("y", times, np.interp(times + 0.5, times, grown) * 3.0)
    assert find_unprompted_output(Record((before,), (earlier,))) is None


def test_what_is_not_at_rest_in_the_beginning_does_not_move_alone() -> None:
    assert find_unprompted_output(_step_test(0.0, creep=1.0)) is None
    assert find_unprompted_output(_step_test(5.0, creep=1.0)) is None


def test_missing_samples_hide_no_rest_and_no_rest_is_found_without_samples() -> None:
    record = _step_test(0.0)
    [output] = record.outputs
    values = output.values.copy()
    values[3:6] = np.nan
    assert (
        find_unprompted_output(Record(record.inputs, (Channel("y", output.times, values),)))
        is not None
    )
    short = Channel("y", output.times[:5], output.values[:5])
    assert find_unprompted_output(Record(record.inputs, (short,))) is None


def test_one_outlier_is_no_output_that_moves_before_its_input() -> None:
    times = 0.1 * np.arange(200)
    u, y = np.where(times > 8, 1.0, 0.0), np.where(times > 9, 1.0, 0.0)
    y[30] = 0.8
    record = Record((Channel("u", times, u),), (Channel("y", times, y),))
    assert find_unprompted_output(record) is None
    early = Record((Channel("u", times, u),), (Channel("y", times, np.where(times > 5, 1.0, 0)),))
    assert find_unprompted_output(early) is not None
