"""What workers do before their first task."""

import numpy as np
import pytest
from numpy.typing import DTypeLike

from sysid.core.settings import GeneticAlgorithm
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.identification.warmup import compile_search
from sysid.islands.evolve import _run_epochs
from sysid.models.catalogue.load import load_model
from sysid.search.least_squares import _run_steps
from sysid.simulation.evaluator import evaluate_population, predict_population
from sysid.simulation.scaling import to_unit
from tests.support.library.search_problems import noisy, record

COMPILED = (_run_epochs, _run_steps, evaluate_population, predict_population, to_unit)


def test_after_warming_up_another_model_compiles_nothing() -> None:
    compile_search()
    before = len(_run_epochs.signatures)  # type: ignore[attr-defined]
    identify(load_model("duffing-eq16"), record(noisy()), GeneticAlgorithm(generations=2))
    assert len(_run_epochs.signatures) == before == 1  # type: ignore[attr-defined]


@pytest.mark.parametrize("input_kind", [np.float32, np.int64, ">f8"])
@pytest.mark.parametrize("output_kind", [np.float32, np.float64])
def test_numbers_of_other_types_compile_nothing(
    input_kind: DTypeLike, output_kind: DTypeLike
) -> None:
    compile_search()
    found = record(noisy())
    force, measured = found.inputs[0], found.outputs[0]
    mixed = Record(
        (Channel(force.name, force.times, (8.0 * force.values).astype(input_kind), force.unit),),
        (Channel(measured.name, measured.times, measured.values.astype(output_kind), "m"),),
    )
    counts = [len(function.signatures) for function in COMPILED]  # type: ignore[attr-defined]
    identify(load_model("duffing-eq16"), mixed, GeneticAlgorithm(generations=2))
    assert [len(function.signatures) for function in COMPILED] == counts  # type: ignore[attr-defined]
