"""Plants with noise inside them: a load, a drifting sensor, a loop, and an unstable plant."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm, Loss, Stop
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.export.export import export_model
from sysid.identification.identify import identify
from sysid.minima.minima import scan_by_projection
from sysid.minima.search_evidence import is_explained
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from sysid.residuals.residual_tests import run_residual_tests
from sysid.results.identification import Identification
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate

PERIOD, GAIN, CONSTANT, LAG, SENSOR = 0.25, 2.0, 12.3, 4.25, 0.02
TRUTH = {"K": GAIN, "T": CONSTANT, "L": LAG}
QUICK = GeneticAlgorithm(population=32, stop=Stop(evaluations=20_000))


def make_record(load: float, correlation: float, walk: float = 0.0, seed: int = 5) -> Record:
    """First order with a dead time of whole samples; a load at its input; its sensor may drift."""
    random, n = np.random.default_rng(seed), 600
    u = np.repeat(random.integers(0, 2, n // 40), 40) * 1.0
    u[:40] = 0.0
    keep, decay = np.exp(-PERIOD / CONSTANT), np.exp(-PERIOD / correlation)
    x, d, y = 0.0, load * random.normal(), np.empty(n)
    for k in range(n):
        y[k] = x + SENSOR * random.normal()
        held = u[max(k - round(LAG / PERIOD), 0)]
        x = keep * x + GAIN * (1 - keep) * (held + d)
        d = decay * d + load * np.sqrt(1 - decay**2) * random.normal()
    y += np.cumsum(walk * random.normal(size=n))
    return build_record(u, y)


def build_record(u: FloatArray, y: FloatArray) -> Record:
    times = PERIOD * np.arange(u.size)
    return Record(
        (Channel("u", times, u, "%", hold="zero"),), (Channel("y", times, y + 20.0, "°C"),)
    )


def test_a_load_is_told_and_the_plant_is_found() -> None:
    found = identify("fopdt", make_record(0.1, 20.0), QUICK, loss=Loss(noise_model="load"))
    for name, true in TRUTH.items():
        low, high = found[name].interval95 or (np.nan, np.nan)
        assert low <= true <= high, name
    assert found.noise_model == "load"
    assert found.noise_colour == "white"
    assert found.plant_noise is not None
    sensor, load = found.plant_noise.sources
    assert (sensor.place, sensor.kind, sensor.unit) == ("y", "sensor", "°C")
    assert sensor.deviation == pytest.approx(SENSOR, rel=0.15)
    assert (load.place, load.kind, load.unit) == ("u", "load", "%")
    assert load.deviation == pytest.approx(0.1, rel=0.7)
    assert load.correlation_time == found["tau[u]"].value
    assert found.plant_noise.rms_free is not None
    assert found.plant_noise.rms_free > 2.0 * found.rms


def test_a_load_is_chosen_by_its_likelihood_and_white_noise_is_not() -> None:
    record = make_record(0.1, 20.0)
    asked = identify("fopdt", record, QUICK, loss=Loss(noise_model="load"))
    found = identify("fopdt", record)
    assert found.noise_model == "load"
    for name in TRUTH:
        assert found[name].value == pytest.approx(asked[name].value, rel=1e-3), name
    (told,) = [one for one in found.findings if one.explanation == "noise in the plant"]
    assert told.severity == "note"
    assert "(loss: {noise_model: white}) gives K = " in told.text
    assert found.order_comparison is not None
    assert found.order_comparison.noise_model == "load"
    warm = identify("fopdt", record, QUICK, warm={one.name: one.value for one in found.parameters})
    assert warm["L"].value == pytest.approx(found["L"].value, rel=1e-3)
    assert identify("fopdt", make_record(0.0, 20.0), QUICK).noise_model == "white"


def test_a_drift_of_the_sensor_is_nearly_a_load() -> None:
    found = identify("fopdt", make_record(0.0, 20.0, walk=0.01, seed=8), QUICK)
    assert found.noise_model == "drift"
    (told,) = [one for one in found.findings if one.explanation == "source of noise"]
    assert told.brief == "the data do not tell a drift of y from a slow load at u"
    assert "(loss: {noise_model: load})" in told.text
    assert all(abs(move.stderrs) < 1.0 for move in told.moves) == (told.severity == "note")
    for name, true in TRUTH.items():
        low, high = found[name].interval95 or (np.nan, np.nan)
        assert low <= true <= high, name


def test_the_size_of_noise_is_bounded_as_any_parameter() -> None:
    loss, narrow = Loss(noise_model="load"), {"load[u]": (0.01, 1.0)}
    found = identify("fopdt", make_record(0.1, 20.0), QUICK, loss=loss, parameters=narrow)
    assert found["load[u]"].status == "at bound"


def test_first_order_noise_of_a_sensor_is_no_load() -> None:
    random, keep = np.random.default_rng(4), np.exp(-PERIOD / 3.0)
    clean = make_record(0.0, 20.0)
    noise = np.zeros(600)
    for k in range(1, 600):
        noise[k] = keep * noise[k - 1] + 0.02 * random.normal()
    u, y = clean.inputs[0].values, clean.outputs[0].values - 20.0
    assert identify("fopdt", build_record(u, y + noise), QUICK).noise_model == "ar1"


def test_white_innovations_show_no_minimum_to_be_the_best() -> None:
    """A square wave fits nearly as well half a period later, upside down, beside a larger load."""
    steps = np.resize([0.0, 1.0, -1.0, 1.0, -1.0, 1.0], 6)
    random, n = np.random.default_rng(3), 600
    u, keep, decay = np.repeat(steps, n // 6), np.exp(-PERIOD / CONSTANT), np.exp(-PERIOD / 20.0)
    x, d, y = 0.0, 0.0, np.empty(n)
    for k in range(n):
        y[k] = x + SENSOR * random.normal()
        x = keep * x + GAIN * (1 - keep) * (u[max(k - round(LAG / PERIOD), 0)] + d)
        d = decay * d + 0.1 * np.sqrt(1 - decay**2) * random.normal()
    record, loss = build_record(u, y), Loss(noise_model="load")
    problem = Problem.build(load_model("fopdt"), [record], loss=loss, initial="rest")
    values = {"K": -1.5, "T": 12.0, "L": 29.0, "y0": 20.0, "load[u]": 20.0, "tau[u]": 50.0}
    (false,) = refine_candidates(problem, [np.array([values[one] for one in problem.free_names])])
    assert false is not None
    tests = run_residual_tests(problem, problem.predict(false.theta[None])[0], "estimation")
    assert is_explained(problem, false.rms, tests)
    lag = problem.free_names.index("L")
    assert false.theta[lag] > 20.0
    scanned = scan_by_projection(problem, false, 1, 6000)
    assert scanned.best.theta[lag] == pytest.approx(LAG, abs=0.3)
    assert scanned.starts < 12  # two ends are enough
    found = identify("fopdt", record, loss=loss)
    assert found["L"].value == pytest.approx(LAG, abs=0.3)
    assert found.search.because == "starts"


def test_validation_is_predicted_by_the_filter_that_was_chosen() -> None:
    found = identify("fopdt", make_record(0.1, 20.0), QUICK, validation_fraction=0.3)
    asked = identify(
        "fopdt",
        make_record(0.1, 20.0),
        QUICK,
        loss=Loss(noise_model="load"),
        validation_fraction=0.3,
    )
    assert found.noise_model == "load"
    assert found.rms_validation == pytest.approx(asked.rms_validation, rel=1e-3)
    assert found.rms_validation < 0.05


def test_gaps_and_a_start_leave_the_likelihood_exact() -> None:
    record = make_record(0.1, 20.0)
    y = record.outputs[0].values.copy()
    y[200:260] = np.nan
    y[np.random.default_rng(0).random(y.size) < 0.3] = np.nan
    gaps = replace(record, outputs=(replace(record.outputs[0], values=y),))
    found = identify("fopdt", gaps, QUICK, loss=Loss(noise_model="load"))
    for name, true in TRUTH.items():
        low, high = found[name].interval95 or (np.nan, np.nan)
        assert low <= true <= high, name
    assert np.isfinite(found.simulated[0][0]).all()


def test_the_document_names_a_sensor_that_drifts() -> None:
    model = load_model("fopdt")
    drifting = parse_model({**model.document, "noise": {"load": {"y": "estimate"}}})
    found = identify(drifting, make_record(0.0, 1.0, walk=0.01), QUICK)
    for name, true in TRUTH.items():
        low, high = found[name].interval95 or (np.nan, np.nan)
        assert low <= true <= high, name
    assert found.noise_model == "load"


def test_an_unstable_plant_under_control_needs_no_free_run() -> None:
    random, n, keep = np.random.default_rng(2), 600, np.exp(PERIOD / 8.0)
    u, y, x, d = np.zeros(n), np.zeros(n), 0.0, 0.0
    wish = np.repeat(random.choice([-1.0, 1.0], n // 60), 60)
    for k in range(n):
        y[k] = x + SENSOR * random.normal()
        u[k] = 2.0 * (wish[k] - y[k])
        x = keep * x + (keep - 1) * (u[max(k - 4, 0)] + d)
        d = 0.98 * d + 0.01 * random.normal()
    document = {
        "name": "unstable",
        "form": "differential",
        "inputs": {"u": "1"},
        "states": {"x": "1"},
        "parameters": {
            "K": {"lower": 0.05, "upper": 20, "scale": "log"},
            "T": {"lower": 0.5, "upper": 100, "scale": "log"},
            "L": {"lower": 0, "upper": 5},
        },
        "equations": {"x": "(x + K*u(t - L))/T"},
        "outputs": {"y": "x"},
        "initial": {"x": 0},
    }
    times = PERIOD * np.arange(n)
    record = Record((Channel("u", times, u, hold="zero"),), (Channel("y", times, y),))
    filtered = parse_model({**document, "noise": {"load": {"u": "estimate"}}})
    found = identify(filtered, record)
    assert found.noise_model == "load"
    for name, true in {"K": 1.0, "T": 8.0, "L": 1.0}.items():
        low, high = found[name].interval95 or (np.nan, np.nan)
        assert low <= true <= high, name
    free = identify(parse_model(document), record)
    (told,) = [one for one in free.findings if one.explanation == "noise in the plant"]
    assert told.advice == "Use loss: {noise_model: load}."
    assert free.noise_model == "white"
    moves = {move.parameter: move for move in told.moves}
    for name, move in moves.items():
        assert move.value == pytest.approx(found[name].value, abs=found[name].stderr)
    assert any("Use loss=Loss(noise_model='load')" in text for text in free.warnings)


def test_a_result_is_saved_exported_simulated_and_drawn(tmp_path: Path) -> None:
    record = make_record(0.1, 20.0)
    found = identify("fopdt", record, QUICK, loss=Loss(noise_model="load"))
    found.save(tmp_path / "found.json")
    assert Identification.load(tmp_path / "found.json") == found
    exported = json.loads(export_model(load_model("fopdt"), found, "json"))
    assert "load[u]" not in str(exported)
    simulated = simulate("fopdt", record.inputs, found)["y"].values
    free = simulated - record.outputs[0].values
    assert found.plant_noise is not None
    assert np.sqrt(np.mean(free**2)) == pytest.approx(found.plant_noise.rms_free, rel=0.05)
    (band,) = found.compute_bands()
    np.testing.assert_allclose(band.simulated, found.simulated[0][0])
    (ahead,) = found.compute_bands(record.inputs)
    np.testing.assert_allclose(ahead.simulated, simulated)
    (load,) = found.compute_disturbances()
    assert (load.place, load.kind) == ("u", "load")
    assert np.all(load.band[:, 0] < load.values)
    assert "95 % band" in {trace.name for trace in found.plot("disturbances").data}
    assert "load at u" in str(found.plot().layout)
    with pytest.raises(InvalidSettings, match="disturbances of 1 records"):
        found.compute_disturbances(experiment=1)
    white = identify("fopdt", make_record(0.0, 20.0), QUICK, loss=Loss(noise_model="white"))
    with pytest.raises(InvalidSettings, match="no noise acts inside the plant"):
        white.plot("disturbances")


def test_bands_and_disturbances_of_several_outputs_are_those_of_the_fit() -> None:
    first, second = make_record(0.1, 20.0, seed=7), make_record(0.1, 20.0, seed=8)
    records = [
        replace(one, outputs=(*one.outputs, Channel("z", one.outputs[0].times, size * values)))
        for one, size in ((first, 100.0), (second, 300.0))
        for values in [one.outputs[0].values - 20.0 + np.sin(one.outputs[0].times) / 9]
    ]
    model = parse_model(
        {
            "name": "twice",
            "form": "differential",
            "inputs": {"u": "1"},
            "states": {"x": "1"},
            "parameters": {
                "K": {"lower": 0.2, "upper": 20},
                "T": {"lower": 1, "upper": 60},
                "L": {"lower": 0, "upper": 10},
                "c": {"lower": 20, "upper": 900},
            },
            "equations": {"x": "(K*u(t - L) - x)/T"},
            "outputs": {"y": "x + 20", "z": "c*x"},
            "initial": {"x": 0},
        }
    )
    found = identify(model, records, QUICK, loss=Loss(noise_model="load"))
    for number, simulated in enumerate(found.simulated):
        bands = found.compute_bands(experiment=number)
        for band, values in zip(bands, simulated, strict=True):
            np.testing.assert_allclose(band.simulated, values, rtol=1e-9)
        (load,) = found.compute_disturbances(number)
        assert np.isfinite(load.band).all()


OSCILLATOR = {"c": 0.2, "L": 0.5, "b": 5.0, "a": 1.0}


def make_oscillator(plant: float, sensor: float, seed: int = 1) -> Record:
    """Eq. 16 with φ as printed: added to each sample of the recursion (m)."""
    random, h, n = np.random.default_rng(seed), 0.02, 300
    times = h * np.arange(n)
    q, x = 10 * np.cos(5 * times), np.zeros(n + 27)  # the past is 0
    for k in range(29, n + 27):
        damper = 0.2 * (x[k - 26] - x[k - 27]) / h
        spring = 5.0 * x[k - 2] + x[k - 2] ** 3
        force = q[k - 29] - damper - spring
        x[k] = 2 * x[k - 1] - x[k - 2] + h**2 * force + plant * random.normal()
    y = x[27:] + sensor * random.normal(size=n)
    return Record((Channel("q", times, q, "N"),), (Channel("y", times, y, "m"),))


def test_noise_in_the_papers_recursion_is_told_from_that_of_its_sensor(tmp_path: Path) -> None:
    record = make_oscillator(1e-4, 0.01)
    found = identify("duffing-eq16", record, loss=Loss(noise_model="plant"))
    for name, true in OSCILLATOR.items():
        assert abs(found[name].value - true) < 3.0 * found[name].stderr, name
    assert found.plant_noise is not None
    sensor, plant = found.plant_noise.sources
    assert sensor.deviation == pytest.approx(0.01, rel=0.15)
    assert plant.deviation == pytest.approx(1e-4, rel=0.5)
    assert (plant.place, plant.kind, plant.unit) == ("x", "plant", "m")
    found.save(tmp_path / "found.json")
    assert Identification.load(tmp_path / "found.json") == found
    assert "noise[x]" not in export_model(load_model("duffing-eq16"), found, "json")
    assert "observer" not in export_model(load_model("duffing-eq16"), found, "c")
    errors = [one.rms for one in found.plant_noise.prediction_errors]
    assert np.all(np.diff(errors) > 0)
    (state,) = found.compute_disturbances()
    true = make_oscillator(1e-4, 0.0).outputs[0].values  # the noises of other draws are the same
    inside = (state.band[:, 0] <= true) & (true <= state.band[:, 1])
    assert np.mean(inside) > 0.8
    (band,) = found.compute_bands()
    np.testing.assert_allclose(band.simulated, found.simulated[0][0])


def test_without_a_sensor_the_filter_is_the_prediction_one_step_ahead() -> None:
    record = make_oscillator(1e-4, 0.0)
    filtered = identify("duffing-eq16", record, loss=Loss(noise_model="plant"))
    ahead = identify("duffing-eq16", record, prediction="one-step")
    for name in OSCILLATOR:
        one, other = filtered[name], ahead[name]
        assert one.status == other.status == "identified"
        assert one.stderr == pytest.approx(other.stderr, rel=0.05)
        assert abs(one.value - other.value) < 0.02 * other.stderr, name
    assert filtered.plant_noise is not None
    assert filtered.plant_noise.sources[1].deviation == pytest.approx(1e-4, rel=0.1)
    assert identify("duffing-eq16", record).noise_model == "plant"


def test_a_recursion_without_noise_inside_takes_no_filter() -> None:
    found = identify("duffing-eq16", make_oscillator(0.0, 0.01))
    assert found.noise_model == "white"
    assert found.verdict.trust == "trustworthy"
