"""Records as they come: several, with gaps, irregular, drifting; each is identified as it is."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.data.derivations import derive_recording
from sysid.data.records import Channel, Record, Recording
from sysid.identification.identify import identify
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.results.identification import Identification
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit
from sysid.simulation.simulate import simulate

TRUTH = {"K": 2.0, "T": 0.6, "L": 0.37}
QUICK = GeneticAlgorithm(generations=40)


def lag_model(initial: Any = 0.0, **bounds: Mapping[str, Any]) -> Model:
    """K e^(-Ls)/(Ts + 1)."""
    parameters = {
        "K": {"lower": -5, "upper": 5},
        "T": {"lower": 0.05, "upper": 5},
        "L": {"lower": 0, "upper": 2},
    }
    return parse_model(
        {
            "name": "lag",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "m"},
            "parameters": parameters | bounds,
            "equations": {"x": "(K*u(t - L) - x)/T"},
            "outputs": {"y": "x"},
            "initial": {"x": initial},
        }
    )


def make_source(seed: int = 1, samples: int = 400, period: float = 0.05) -> Channel:
    """Levels of half a second, with ramps of one sample between them."""
    drawn = np.random.default_rng(seed).uniform(-1, 1, samples)
    times: FloatArray = period * np.arange(samples, dtype=np.float64)
    return Channel("u", times, drawn[(times / 0.5 + 1e-9).astype(int)], "V")


def answer(given: Channel, start: float = 0.0, times: FloatArray | None = None) -> Channel:
    """The true output from a start, without noise."""
    model, at = lag_model({"lower": -9, "upper": 9}), given.times if times is None else times
    return simulate(model, [given], {**TRUTH, "x(0)": start}, times=at).channels[0]


def make_record(seed: int = 1, start: float = 0.0) -> Record:
    return Record((make_source(seed),), (answer(make_source(seed), start),))


def read_values(found: Identification) -> dict[str, float]:
    return {one.name: one.value for one in found.parameters}


def test_every_experiment_has_an_initial_state_of_its_own() -> None:
    records = [make_record(1, 1.5), make_record(2, -0.8)]
    found = read_values(identify(lag_model({"lower": -9, "upper": 9}), records, QUICK))
    assert found == pytest.approx({**TRUTH, "x(0)": 1.5, "x(0)[2]": -0.8}, abs=1e-4)


def test_a_measured_start_is_that_of_each_experiment() -> None:
    records = [make_record(1, 1.5), make_record(2, -0.8)]
    found = identify(lag_model("measured"), records, QUICK)
    assert read_values(found) == pytest.approx(TRUTH, abs=1e-4)
    starts = [outputs[0][0] for outputs in found.simulated]
    assert starts == [1.5, -0.8]


def test_a_parameter_or_a_weight_without_any_effect_is_refused() -> None:
    dead = lag_model(q={"lower": 0, "upper": 1})
    with pytest.raises(InvalidSettings, match=r"/parameters/q: no equation and no output"):
        identify(dead, make_record(), QUICK)
    with pytest.raises(InvalidSettings, match=r"/weights/y: 'y' is the model's only output"):
        identify(lag_model(), make_record(), QUICK, weights={"y": 2.0})
    tied = identify(dead, make_record(), QUICK, parameters={"q": {"tied": "K/9"}})
    assert read_values(tied)["K"] == pytest.approx(TRUTH["K"], abs=1e-4)


def test_a_fixed_start_is_not_estimated() -> None:
    assert set(read_values(identify(lag_model(), make_record(), QUICK))) == set(TRUTH)


def test_samples_that_are_missing_do_not_count() -> None:
    whole = make_record()
    y = whole.outputs[0].values.copy()
    y[np.random.default_rng(5).random(y.size) < 0.4] = np.nan
    gaps = replace(whole, outputs=(replace(whole.outputs[0], values=y),))
    found = identify(lag_model(), gaps, QUICK)
    assert read_values(found) == pytest.approx(TRUTH, abs=1e-4)
    assert found.agreement.estimation[0].samples == np.count_nonzero(np.isfinite(y))


def test_an_output_at_irregular_times_is_compared_at_its_own_times() -> None:
    given = make_source()
    times = np.sort(np.random.default_rng(6).uniform(0.0, given.times[-1], 150))
    model = lag_model()
    model = parse_model({**model.document, "solver": {"step": 0.01}})
    values_ = simulate(model, [given], TRUTH, times=times).channels[0]
    found = identify(model, Record((given,), (values_,)), QUICK)
    assert read_values(found) == pytest.approx(TRUTH, abs=1e-3)
    shifted = replace(values_, times=values_.times + 0.1)
    late = identify(model, Record((given,), (shifted,)), QUICK)
    assert read_values(late)["L"] == pytest.approx(TRUTH["L"] + 0.1, abs=0.02)


def test_a_logarithmic_scale_divides_an_interval_by_ratios() -> None:
    linear = Problem.build(lag_model(), [make_record()])
    model = lag_model(T={"lower": 0.01, "upper": 100, "scale": "log"})
    log = Problem.build(model, [make_record()])
    middle = np.full((1, 3), 0.5)
    assert from_unit(linear.evaluator, middle)[0, 1] == pytest.approx((0.05 + 5) / 2)
    assert from_unit(log.evaluator, middle)[0, 1] == pytest.approx(1.0)
    assert read_values(identify(model, make_record(), QUICK)) == pytest.approx(TRUTH, abs=1e-4)


def test_the_output_with_more_weight_is_fitted_better() -> None:
    """Two outputs that contradict each other."""
    model = lag_model()
    both = parse_model({**model.document, "outputs": {"y": "x", "z": "x"}})
    y = answer(make_source())
    data = Record((make_source(),), (y, Channel("z", y.times, 1.5 * y.values)))
    for weights, gain in (({"y": 30.0, "z": 1.0}, 2.0), ({"y": 1.0, "z": 30.0}, 3.0)):
        found = identify(both, data, QUICK, weights=weights)
        assert read_values(found)["K"] == pytest.approx(gain, rel=0.01)


DRIFT = 0.3 + 0.02 * make_source().times


@pytest.mark.parametrize(
    ("steps", "exact"),
    [
        ([{"trim": {"start": 3.0, "stop": 17.0}}], 1e-4),
        ([{"trim": {"rows": [60, 340]}}], 1e-4),
        ([{"split": {"fraction": 0.4, "part": "estimation"}}], 1e-4),
        ([{"split": {"fraction": 0.6, "part": "validation"}}], 1e-4),
        ([{"resample": {"sample_time": 0.025}}], 0.02),
        ([{"offset": {"u": 0.0}}], 1e-4),
    ],
)
def test_a_derived_recording_gives_the_same_system(
    steps: Sequence[Mapping[str, Any]], exact: float
) -> None:
    given = make_source()
    whole = Recording((given, answer(given)))
    part = derive_recording(whole, steps).to_record({"u": "u"}, {"y": "y"})
    # What the input was before the part goes with it: every sample is scored.
    model = lag_model({"lower": -9, "upper": 9})
    found = identify(model, part, QUICK)
    assert {name: read_values(found)[name] for name in TRUTH} == pytest.approx(TRUTH, abs=exact)


def test_a_drift_that_is_taken_away_does_no_harm() -> None:
    given = make_source()
    y = answer(given)
    drifting = Recording((given, replace(y, values=y.values + DRIFT)))
    flat = derive_recording(drifting, [{"detrend": {"kind": "linear"}}]).to_record(
        {"u": "u"}, {"y": "y"}
    )
    raw = drifting.to_record({"u": "u"}, {"y": "y"})
    model = lag_model({"lower": -9, "upper": 9})
    with_drift, without = (identify(model, one, QUICK) for one in (raw, flat))
    assert without.rms < 0.2 * with_drift.rms
    assert read_values(without)["K"] == pytest.approx(TRUTH["K"], rel=0.1)


def test_one_step_prediction_uses_the_measured_past_and_a_free_run_does_not() -> None:
    """With noise inside the loop one step ahead is right, and the free run is far off."""
    model = parse_model(
        {
            "name": "arx",
            "form": "difference",
            "inputs": {"u": "V"},
            "states": {"y": "m"},
            "parameters": {"a": {"lower": -1, "upper": 1}, "b": {"lower": -5, "upper": 5}},
            "equations": {"y": "a*y(k-1) + b*u(k-1)"},
            "outputs": {"y": "y"},
            "initial": {"y": "measured"},
        }
    )
    given, rng = make_source(), np.random.default_rng(4)
    y = np.zeros(given.times.size)
    for k in range(1, y.size):
        y[k] = 0.95 * y[k - 1] + 0.2 * given.values[k - 1] + 0.1 * rng.standard_normal()
    data = Record((given,), (Channel("y", given.times, y),))
    ahead = identify(model, data, QUICK, prediction="one-step")
    free = identify(model, data, QUICK)
    assert ahead.rms == pytest.approx(0.1, rel=0.1)
    assert free.rms > 1.5 * ahead.rms
    past = np.column_stack([y[:-1], given.values[:-1]])
    least = np.linalg.lstsq(past, y[1:], rcond=None)[0]
    assert list(read_values(ahead).values()) == pytest.approx(list(least), abs=1e-6)


def test_the_hold_of_an_input_is_worth_half_a_sample_of_lag() -> None:
    """A held input that is read as ramps seems to come earlier, so that the lag seems longer."""
    held = replace(make_source(), hold="zero")
    data = Record((held,), (answer(held),))
    right = read_values(identify(lag_model(), data, QUICK))["L"]
    lines = replace(make_source(), hold="first")
    ramps = read_values(identify(lag_model(), replace(data, inputs=(lines,)), QUICK))["L"]
    assert right == pytest.approx(TRUTH["L"], abs=1e-4)
    assert ramps == pytest.approx(right + 0.025, abs=1e-3)
