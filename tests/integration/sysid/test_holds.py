"""How an input is held between its samples: said by the user, or chosen by its values."""

from collections.abc import Mapping

import numpy as np
import pytest

from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.settings import GeneticAlgorithm, Stop
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Hold, Recording
from sysid.identification.fit_problems import prepare_records
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.results.identification import Identification
from sysid.results.parts import InputHold
from sysid.simulation.simulate import simulate

PERIOD, LAG = 0.5, 3.2


def step_test(noise: float = 0.0) -> Recording:
    """A step test of K = 1.5, T = 8 s, L = 3.2 s whose input is held between samples."""
    times = PERIOD * np.arange(200)
    draw = np.random.default_rng(7)
    response = np.where(times > 10 + LAG, 1.5 * (1 - np.exp(-(times - 10 - LAG) / 8)), 0.0)
    return Recording(
        (
            Channel("u", times, np.where(times >= 10, 1.0, 0.0), "V"),
            Channel("y", times, response + noise * draw.standard_normal(200), "bar"),
        )
    )


def identify_with_hold(
    recording: Recording, hold: Mapping[str, Hold] | None = None
) -> Identification:
    record = recording.to_record({"u": "u"}, {"y": "y"})
    search = GeneticAlgorithm(generations=100)
    return identify(load_model("fopdt"), record, search, hold=hold, compare_orders=False)


def build_lag(found: Identification) -> float:
    return next(one.value for one in found.parameters if one.name == "L")


def test_a_held_input_gives_the_true_lag_of_a_step_test() -> None:
    assert build_lag(identify_with_hold(step_test().replace_holds({"u": "zero"}))) == pytest.approx(
        LAG, abs=0.02
    )


def test_a_step_is_held_without_being_told() -> None:
    found = identify_with_hold(step_test())
    (hold,) = found.input_hold
    assert build_lag(found) == pytest.approx(LAG, abs=0.02)
    assert (hold.input, hold.chosen, hold.other) == ("u", "zero", "first")
    assert hold.reason == "has two levels"


def test_the_estimate_of_the_other_reading_is_told() -> None:
    recording = step_test(noise=0.01)
    found, lines = (
        identify_with_hold(recording),
        identify_with_hold(recording.replace_holds({"u": "first"})),
    )
    (hold,) = found.input_hold
    assert hold.estimates_other is not None
    assert hold.estimates_other["L"] == pytest.approx(build_lag(lines), abs=1e-4)
    assert hold.rms_other == pytest.approx(lines.rms, rel=1e-3)
    told = [one for one in found.warnings if "(hold={'u': 'first'})" in one]
    assert len(told) == 1
    assert f"L = {build_lag(lines):.4g} s instead of {build_lag(found):.4g}" in told[0]
    assert found.evaluations > lines.evaluations
    same = identify_with_hold(recording, {"u": "first"})
    assert same.parameter_values == lines.parameter_values
    assert same.input_hold == lines.input_hold


@pytest.mark.parametrize("hold", ["zero", "first"])
def test_of_a_given_hold_nothing_is_told(hold: Hold) -> None:
    found = identify_with_hold(step_test().replace_holds({"u": hold}))
    assert not any("hold" in one for one in found.warnings)
    assert found.input_hold == (InputHold("u", hold, None),)


def test_a_budget_is_kept() -> None:
    record = step_test().to_record({"u": "u"}, {"y": "y"})
    search = GeneticAlgorithm(generations=100, stop=Stop(evaluations=400))
    found = identify(load_model("fopdt"), record, search)
    assert found.evaluations <= 400 + 50  # the search ends with a whole generation


def moving_test() -> Recording:
    """A held input that takes a new value at every sample, as a controller's."""
    u = np.random.default_rng(1).standard_normal(200)
    times, fine = PERIOD * np.arange(200), PERIOD / 50 * np.arange(200 * 50)
    held = u[np.clip(np.floor((fine - LAG) / PERIOD + 1e-9).astype(int), 0, 199)]
    x = np.empty(fine.size)
    x[0] = 0.0
    for k in range(1, fine.size):
        x[k] = x[k - 1] + PERIOD / 50 / 8 * (1.5 * held[k - 1] - x[k - 1])
    noise = 1e-3 * np.random.default_rng(2).standard_normal(200)
    return Recording((Channel("u", times, u, "V"), Channel("y", times, x[::50] + noise, "bar")))


def test_a_reading_that_fits_worse_than_the_other_is_told() -> None:
    found = identify_with_hold(moving_test())
    assert found.input_hold[0].chosen == "first"
    assert any("(hold={'u': 'zero'})" in one and "fits better" in one for one in found.warnings)
    assert found["L"].status == "dependent"
    assert "if u may be read held" in found["L"].reason
    assert "u may be read held" in found.verdict.text


def run_plant(seed: int, gain: float) -> Recording:
    """K = 1.5, T = 8 s, L = 3 s, in a loop of this gain; a held reference moves it."""
    random, lag = np.random.default_rng(seed), 6
    decay = np.exp(-PERIOD / 8)
    reference = np.repeat(random.uniform(-1, 1, 20), 20)
    x, y, u = np.zeros(401), np.zeros(400), np.zeros(400)
    for k in range(400):
        y[k] = x[k] + 0.02 * random.standard_normal()
        u[k] = reference[k] - gain * y[k]
        x[k + 1] = decay * x[k] + (1 - decay) * 1.5 * (u[k - lag] if k >= lag else 0.0)
    times = PERIOD * np.arange(400)
    return Recording((Channel("u", times, u, "V"), Channel("y", times, y, "bar")))


def test_the_command_of_a_loop_may_be_held_and_the_lag_depends_on_it() -> None:
    found = identify_with_hold(run_plant(1, 0.8))
    (hold,) = found.input_hold
    assert (hold.chosen, found["L"].status) == ("first", "dependent")
    assert any("as a command does" in one for one in found.warnings)
    assert found.verdict.trust == "limited"
    held = identify_with_hold(run_plant(1, 0.8), {"u": "zero"})
    assert held["L"].value == pytest.approx(3.0, abs=0.1)
    assert held["L"].status == "identified"
    assert held.verdict.text == "trustworthy"


def test_a_new_level_at_every_sample_is_no_line() -> None:
    moving = moving_test()
    u, y = (moving.channel(name) for name in "uy")
    noisy = y.values + 0.1 * np.random.default_rng(4).standard_normal(200)
    found = identify_with_hold(Recording((u, Channel("y", y.times, noisy, "bar"))))
    assert found["L"].status == "dependent"
    assert any("do not follow each other" in one for one in found.warnings)


def test_a_smooth_input_of_an_open_loop_is_read_as_lines_without_a_word() -> None:
    times = PERIOD * np.arange(400)
    u, slow = np.sin(0.15 * times), 1 / (1 + 0.15j * 8) * np.exp(-0.15j * LAG)
    y = 1.5 * np.imag(slow * np.exp(0.15j * times))
    y += 0.02 * np.random.default_rng(1).standard_normal(400)
    found = identify_with_hold(
        Recording((Channel("u", times, u, "V"), Channel("y", times, y, "bar")))
    )
    assert found.input_hold[0].chosen == "first"
    assert "dependent" not in [one.status for one in found.parameters]
    assert not any("hold=" in one for one in found.warnings)


def test_jumps_between_irregular_samples_are_uncertain() -> None:
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.2, 1.0, 200))
    jumps = np.sort(rng.uniform(5, 110, 12))
    levels = rng.uniform(-1, 1, 13)

    def drive(t: FloatArray) -> FloatArray:
        return np.asarray(levels[np.searchsorted(jumps, t)])

    fine = np.arange(0, float(times[-1]) + 0.01, 0.01)
    x = np.zeros(fine.size)
    u = drive(fine - LAG)
    x[0] = 1.5 * u[0]
    for k in range(1, fine.size):
        x[k] = x[k - 1] + 0.01 / 8 * (1.5 * u[k - 1] - x[k - 1])
    measured = np.interp(times, fine, x) + 1e-3 * rng.standard_normal(200)
    record = (Channel("u", times, drive(times), "V"), Channel("y", times, measured, "bar"))
    found = identify_with_hold(Recording(record))
    assert found.input_hold[0].chosen == "zero"
    (told,) = [one for one in found.warnings if "sampled irregularly" in one]
    period = float(told.split(", ")[-1].removesuffix(" s"))
    assert 0.4 < period < 0.9
    assert abs(build_lag(found) - LAG) < period


def test_the_validation_part_is_read_as_the_estimation_part() -> None:
    times = np.arange(200.0)
    u = np.where(times < 100, np.where(times >= 10, 1.0, 0.0), np.sin(times))
    record = Recording((Channel("u", times, u), Channel("y", times, u))).to_record(
        {"u": "u"}, {"y": "y"}
    )
    parts = prepare_records(load_model("fopdt"), [record], fraction=0.5)
    assert parts.validation is not None
    assert parts.validation_runs is not None
    holds = [
        part[0].inputs[0].effective_hold
        for part in (parts.estimation, parts.validation, parts.validation_runs)
    ]
    assert holds == ["zero"] * 3
    assert record.inputs[0].effective_hold == "first"


def test_the_hold_of_a_channel_that_is_not_there_is_refused() -> None:
    with pytest.raises(InvalidRecord, match="no channel 'v'"):
        step_test().replace_holds({"v": "zero"})


FINE = 50


def mean_test() -> tuple[FloatArray, FloatArray]:
    """Means of input and output, (N,) each, over the periods that begin at the samples.

    The input switches between two samples.
    """
    draw = np.random.default_rng(3)
    lengths = draw.integers(3, 12, 60) * FINE + 17
    levels = np.repeat(draw.uniform(-1.0, 1.0, 60), lengths)[: 200 * FINE]
    step, x = PERIOD / FINE, np.zeros(200 * FINE + 1)
    late = np.concatenate([np.full(round(LAG / step), levels[0]), levels])
    x[0] = 1.5 * levels[0]
    for k in range(200 * FINE):
        x[k + 1] = 1.5 * late[k] + (x[k] - 1.5 * late[k]) * np.exp(-step / 8)
    middle = 0.5 * (x[1:] + x[:-1])
    noise = 0.01 * draw.standard_normal(200)
    return levels.reshape(200, FINE).mean(axis=1), middle.reshape(200, FINE).mean(axis=1) + noise


@pytest.mark.parametrize(("shift", "hold"), [(0.0, "mean-after"), (PERIOD, "mean")])
def test_means_of_a_period_give_the_true_lag(shift: float, hold: Hold) -> None:
    times = shift + PERIOD * np.arange(200)
    u, y = (Channel(name, times, one) for name, one in zip("uy", mean_test(), strict=True))
    found = identify_with_hold(Recording((u, y)), {"u": hold, "y": hold})
    lag = next(one for one in found.parameters if one.name == "L")
    assert lag.stderr is not None
    assert lag.value == pytest.approx(LAG, abs=3 * lag.stderr + 0.01)
    assert found.input_hold == (InputHold("u", hold, None),)
    assert found.verdict.trust == "trustworthy"
    values = identify_with_hold(Recording((u, y)), {"u": hold})
    assert abs(build_lag(values) - LAG) == pytest.approx(0.5 * PERIOD, abs=0.1)


def test_an_identified_model_reads_means_as_it_was_identified() -> None:
    times = PERIOD * np.arange(200)
    u, y = (Channel(name, times, one) for name, one in zip("uy", mean_test(), strict=True))
    found = identify_with_hold(Recording((u, y)), {"u": "mean"})
    answer = simulate(load_model("fopdt"), u, found)["y"].values
    np.testing.assert_allclose(answer, found.simulated[0][0], atol=1e-9)


def test_means_at_irregular_times_are_refused() -> None:
    times = PERIOD * np.arange(200) ** 1.1
    recording = Recording((Channel("u", times, mean_test()[0]), Channel("y", times, times)))
    for name in "uy":
        with pytest.raises(InvalidSettings, match=rf"/hold/{name}: .*irregular.*Resample it"):
            identify_with_hold(recording, {name: "mean"})
