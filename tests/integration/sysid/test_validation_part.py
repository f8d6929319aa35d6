"""The last part of each record, kept for validation: judged with all that went before it."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm
from sysid.data.noise import Noise, add_output_noise
from sysid.data.records import Channel, Record
from sysid.data.splitting import split_record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from sysid.results.identification import Identification
from sysid.simulation.problem import Problem, compute_metrics
from sysid.simulation.simulate import simulate
from tests.support.library.search_problems import DUFFING, force
from workers.protocol import ProblemSpec
from workers.tasks import build_pack_problems, prepare_run_records

BRIEF = GeneticAlgorithm(population=16, generations=2)
TRUE = {name: {"fixed": value} for name, value in DUFFING.items() if name != "c"}
NEAR = {**TRUE, "c": {"lower": 0.19, "upper": 0.21}}
FRACTION = 0.3

DECAY = {
    "name": "decay",
    "form": "differential",
    "states": {"x": "1", "z": "1"},
    "parameters": {"a": {"lower": 0.1, "upper": 1.0}},
    "equations": {"x": "-a*x", "z": "-2*a*z"},
    "outputs": {"y": "x", "w": "z"},
    "initial": {"x": {"lower": 0.5, "upper": 5.0}, "z": 2},
    "solver": {"method": "rk4", "step": "sample"},
}


def free_run(model: str, values: Mapping[str, float], n: int = 600) -> Record:
    blank = Record((force(n),), (Channel("y", 0.02 * np.arange(n), np.zeros(n), "m"),))
    problem = Problem.build(load_model(model), [blank])
    theta = np.array([[values[p.name] for p in problem.free_parameters]])
    return replace(blank, outputs=(replace(blank.outputs[0], values=problem.predict(theta)[0]),))


def make_decay(sd: float = 0.0) -> Record:
    times = 0.05 * np.arange(100)
    noise = sd * np.random.default_rng(3).standard_normal((2, 100))
    y, w = 3.0 * np.exp(-0.5 * times) + noise[0], 2.0 * np.exp(-times) + noise[1]
    return Record((), (Channel("y", times, y), Channel("w", times, w)))


def standard_deviation(found: Identification, record: Record) -> list[float]:
    estimation = split_record(record, FRACTION)[0]
    return [float(np.std(channel.values)) for channel in estimation.outputs]


@pytest.mark.parametrize("model", ["duffing-eq16", "duffing-delay"])
def test_the_true_model_fits_both_parts_alike(model: str) -> None:
    record = add_output_noise(free_run(model, DUFFING), Noise(0.01, 1), 0)
    found = identify(load_model(model), record, BRIEF, parameters=NEAR, validation_fraction=0.3)
    assert found.fit_percent.estimation > 97
    assert found.fit_percent.validation == pytest.approx(found.fit_percent.estimation, abs=1.0)
    assert found.rms_validation == pytest.approx(found.rms, rel=0.2)
    assert [part[0].size for part in (*found.simulated, *found.simulated_validation)] == [420, 180]
    assert [one.samples for one in found.agreement.validation] == [180]


def test_an_estimated_initial_state_goes_on_into_the_part_kept() -> None:
    found = identify(
        parse_model(DECAY), [make_decay(), make_decay()], BRIEF, validation_fraction=FRACTION
    )
    for experiment in found.simulated_validation:
        for simulated, channel in zip(experiment, make_decay().outputs, strict=True):
            np.testing.assert_allclose(simulated, channel.values[70:], atol=1e-6)


def test_the_rms_of_both_parts_are_in_the_same_measure() -> None:
    record = make_decay(sd=0.02)
    found = identify(parse_model(DECAY), record, BRIEF, validation_fraction=FRACTION)
    split = split_record(record, FRACTION)
    for part, simulated, value in zip(
        split,
        (found.simulated, found.simulated_validation),
        (found.rms, found.rms_validation),
        strict=True,
    ):
        weighted = [
            (channel.values - model) / deviation
            for channel, model, deviation in zip(
                part.outputs, simulated[0], standard_deviation(found, record), strict=True
            )
        ]
        assert value == pytest.approx(np.sqrt(np.mean(np.square(weighted))), rel=1e-9)


def test_other_records_are_judged_with_the_weights_of_the_estimate() -> None:
    record = make_decay(sd=0.02)
    small = Record((), tuple(replace(c, values=0.1 * c.values) for c in record.outputs))
    found = identify(parse_model(DECAY), record, BRIEF, validation=small)
    weighted = [
        (kept.values - simulated) / np.std(channel.values)
        for channel, kept, simulated in zip(
            record.outputs, small.outputs, found.simulated_validation[0], strict=True
        )
    ]
    expected = np.sqrt(np.mean(np.square(weighted)))
    assert found.rms_validation == pytest.approx(expected, rel=1e-9)


def test_a_worker_builds_the_part_kept_on_the_whole_record_without_noise() -> None:
    record = free_run("duffing-eq16", DUFFING)
    spec = ProblemSpec(
        model=dict(load_model("duffing-eq16").document),
        records="r",
        validation=None,
        validation_fraction=FRACTION,
        noise=Noise(0.05, 1),
    )
    posed, judged = build_pack_problems(spec, {"r": (record,)})
    estimation, kept, *_ = prepare_run_records(spec, {"r": (record,)})
    assert judged is not None
    assert kept is not None
    assert posed.records[0].outputs[0].values.tobytes() == estimation[0].outputs[0].values.tobytes()
    assert judged.records == (record,)
    assert judged.n_scored == kept[0].outputs[0].values.size == 180
    theta = np.array([[DUFFING[p.name] for p in judged.free_parameters]])
    assert compute_metrics(judged, judged.predict(theta)[0]).rms < 1e-12


def test_records_and_a_fraction_together_are_refused() -> None:
    record = free_run("duffing-eq16", DUFFING)
    model = load_model("duffing-eq16")
    with pytest.raises(InvalidSettings, match="either records or a fraction"):
        identify(model, record, BRIEF, validation=record, validation_fraction=0.3)


def test_times_to_score_from_are_one_for_each_record() -> None:
    record = free_run("duffing-eq16", DUFFING)
    with pytest.raises(InvalidSettings, match="2 times for 1 records"):
        Problem.build(load_model("duffing-eq16"), [record], scored_from=[1.0, 2.0])


def test_the_start_of_another_record_is_estimated_on_its_first_part_only() -> None:
    """What comes later does not move the start: it is there to be predicted."""
    other = make_decay()
    late = tuple(
        replace(one, values=np.where(np.arange(100) < 30, one.values, one.values + 0.5))
        for one in other.outputs
    )
    found = identify(
        parse_model(DECAY), make_decay(sd=0.001), BRIEF, validation=replace(other, outputs=late)
    )
    simulated = found.simulated_validation[0][0]
    np.testing.assert_allclose(simulated, other.outputs[0].values, atol=5e-3)


def identify_heater(last: float, sign: float = 1.0) -> tuple[Identification, float]:
    """A first-order plant, 0.02 of noise; input and output are scaled in the last 30 %."""
    rng, times = np.random.default_rng(2), 0.1 * np.arange(300)
    u = np.repeat(rng.uniform(-1, 1, 30), 10)
    u[180:] *= last
    model = load_model("fopdt")
    command = Channel("u", times, u, "1", "zero")
    [y] = simulate(
        model, [command], {"K": 2, "T": 0.5, "L": 0.33, "y0": 0, "x(0)": 0}, times=times
    ).channels
    y.values[210:] *= sign
    record = Record((command,), (replace(y, values=y.values + 0.02 * rng.normal(size=300)),))
    bounds = {"L": {"upper": 2}}
    found = identify(model, record, parameters=bounds, validation_fraction=FRACTION)
    return found, float(np.std(record.outputs[0].values[210:]))


def test_a_part_that_hardly_moves_has_an_rms_and_no_fit() -> None:
    found, spread = identify_heater(0.0)
    assert found.fit_percent.estimation > 95
    assert found.fit_percent.validation is not None
    assert np.isnan(found.fit_percent.validation)
    assert np.isnan(found.agreement.validation[0].fit_percent)
    assert found.rms_validation == pytest.approx(0.02, rel=0.3)
    [note] = [one for one in found.warnings if "hardly move" in one]
    assert f"their standard deviation is {spread:.3g}, " in note


def test_a_model_that_predicts_worse_than_the_mean_is_refuted() -> None:
    found, spread = identify_heater(1.0, -1.0)
    assert found.fit_percent.estimation > 95
    assert found.rms_validation is not None
    assert found.rms_validation > spread
    assert {one.status for one in found.parameters} == {"refuted"}
    assert "the model predicts the validation data worse than their mean" in found.warnings[0]
    assert f"RMS {found.rms_validation:.3g} against {spread:.3g}, " in found.warnings[0]
    assert found.verdict.text.startswith("not trustworthy: the validation data contradict")


def test_a_part_that_moves_less_than_the_rest_keeps_its_fit() -> None:
    found, _ = identify_heater(0.25)
    assert {one.status for one in found.parameters} == {"identified"}
    assert found.fit_percent.validation is not None
    assert found.fit_percent.validation > 80
    assert not any("hardly move" in one for one in found.warnings)
