"""An exported observer predicts what the filter of the result predicts, sample by sample."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, Loss, PlantNoise, Stop
from sysid.data.records import Channel, Hold, Record
from sysid.export.export import export_model
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.results.identification import Identification
from tests.support.library.exported_programs import (
    add_observer_entry,
    compile_library,
    observe_c,
    observe_python,
)

PERIOD, SAMPLES = 0.25, 160
SMALL = GeneticAlgorithm(
    population=16, islands=1, generations=4, refine=False, stop=Stop(evaluations=500)
)
# Names that an observer needs itself, and two outputs that are corrected one after the other.
TWO: dict[str, Any] = {
    "name": "start",
    "form": "differential",
    "inputs": {"o": "W", "q": "1"},
    "states": {"x": "K", "factor": "K"},
    "parameters": {
        "n": {"lower": 0.5, "upper": 4},
        "o_now": {"lower": 0.1, "upper": 0.6, "unit": "s"},
        "self": {"lower": 0.2, "upper": 2},
    },
    "equations": {
        "x": "(2*o(t - o_now) - x - 0.3*factor(t - 2*o_now))/n + q",
        "factor": "(x - factor)/self - 0.01*factor**3",
    },
    "outputs": {"step": "factor + 0.2", "y": "x**2/9 + x"},
    "initial": {"x": {"lower": -1, "upper": 1}, "factor": 0.1},
    "noise": {"plant": {"x": "estimate"}, "load": {"o": "estimate"}},
}


def write_two(**changes: Any) -> Model:
    return parse_model({**TWO, **changes})


CASES: dict[str, tuple[Model, PlantNoise, Hold]] = {
    "load": (load_model("fopdt"), "load", "zero"),
    "load_on_lines": (load_model("sopdt"), "load", "first"),
    "drift": (load_model("ipdt"), "drift", "zero"),
    "two": (write_two(), "plant", "zero"),
    "two_on_lines": (write_two(), "plant", "first"),
    "euler": (
        write_two(solver={"method": "euler", "substeps": 3, "history": "zero"}),
        "plant",
        "zero",
    ),
    "semi_implicit": (
        write_two(solver={"method": "semi-implicit", "substeps": 2}),
        "plant",
        "zero",
    ),
    "linear_reads": (
        write_two(solver={"interpolation": "linear", "history": "zero"}),
        "plant",
        "zero",
    ),
    "measured": (
        write_two(initial={"x": "measured", "factor": "o0*n"}, outputs={"y": "x"}),
        "load",
        "zero",
    ),
}


def make_record(model: Model, hold: Hold) -> Record:
    random, times = np.random.default_rng(8), 2.0 + PERIOD * np.arange(SAMPLES)
    inputs = []
    for signal in model.inputs:
        u = np.repeat(random.choice([0.0, 1.0, 0.3], SAMPLES // 10), 10)
        inputs.append(Channel(signal.name, times, u, hold=hold))
    outputs = []
    for number, output in enumerate(model.outputs):
        y = 1.0 + np.convolve(inputs[0].values, np.ones(12) / 12)[:SAMPLES]
        y += np.cumsum(0.1 * random.normal(size=SAMPLES))
        y[40 + number : 52] = np.nan
        outputs.append(Channel(output.name, times, y))
    return Record(tuple(inputs), tuple(outputs))


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def results() -> dict[str, tuple[Model, Record, Identification]]:
    found = {}
    for name, (model, noise, hold) in CASES.items():
        record = make_record(model, hold)
        loss = Loss(noise_model=noise)
        result = identify(model, record, SMALL, loss=loss, compare_orders=False)
        found[name] = model, record, result
    return found


def test_an_observer_predicts_what_the_filter_does(
    results: dict[str, tuple[Model, Record, Identification]], tmp_path: Path
) -> None:
    sources = {}
    for name, (model, _, found) in results.items():
        text = export_model(model, found, "c")
        text = add_observer_entry(text, f"run_{name}", len(model.inputs), len(model.outputs))
        sources[name] = text.replace(
            f"{text.split('_identified(void)')[0].split()[-1]}_", f"{name}_own_"
        )
    library = compile_library(tmp_path, sources)
    for name, (model, record, found) in results.items():
        signals = [channel.values for channel in record.inputs]
        measured = [channel.values for channel in record.outputs]
        given = {"x_0": measured[0][0]} if name == "measured" else {}
        python = observe_python(export_model(model, found, "python"), signals, measured, **given)
        predicted = [python]
        if not given:
            predicted.append(observe_c(library, f"run_{name}", signals, measured))
        for outputs in predicted:
            for ours, true in zip(outputs, found.simulated[0], strict=True):
                np.testing.assert_allclose(ours, true, rtol=1e-9, atol=1e-9, err_msg=name)


def test_a_copy_of_an_observer_predicts_further_ahead(
    results: dict[str, tuple[Model, Record, Identification]],
) -> None:
    model, record, found = results["load"]
    y = record.outputs[0].values.copy()
    text = export_model(model, found, "python")
    (ended,) = observe_python(
        text, [record.inputs[0].values], [np.where(np.arange(SAMPLES) > 100, np.nan, y)]
    )
    (whole,) = observe_python(text, [record.inputs[0].values], [y])
    np.testing.assert_array_equal(ended[:102], whole[:102])
    assert np.max(np.abs(ended[102:] - whole[102:])) > 0.01


def test_the_free_run_stays_beside_it_and_other_models_have_no_observer(
    results: dict[str, tuple[Model, Record, Identification]],
) -> None:
    model, record, found = results["load"]
    for format in ("python", "c"):
        text = export_model(model, found, format)
        assert "observer" in text.lower()
        values = {n: v for n, v in found.parameter_values.items() if not n.endswith("[u]")}
        plain = export_model(model, values, format, sample_time=PERIOD)
        assert "observer" not in plain.lower()
    white = identify(model, record, SMALL, loss=Loss(noise_model="white"), compare_orders=False)
    assert "bserver" not in export_model(model, white, "c")
    assert "load[u]" not in export_model(model, found, "json")
