"""Long simulations: a child does them, with the same bits, within its memory and time."""

import subprocess
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.core.errors import InvalidRequest, ServiceBusy, Unavailable
from service.core.process.concurrency import FairPlaces, ReaderPlaces
from service.core.process.temporary_files import FULL_DISK_MESSAGE
from service.datasets import data_child, large_simulation
from service.datasets.data_child import SECONDS
from service.datasets.large_simulation import count_steps, name_times, simulate_outputs
from sysid.core.child_processes import OUT_OF_PROCESSOR_TIME
from sysid.data.records import Channel, History
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.simulation import simulate as simulation
from tests.support.library.small_models import ARX, differential

TIMES = np.arange(200) * 0.1
FOPDT = {"K": 2.0, "T": 1.5, "L": 0.7, "y0": 0.1, "x(0)": 0.2}
DELAYED = differential({"x": "-b*x + u(t-L)"}, "x", initial={"x": 0})
READERS = ReaderPlaces(FairPlaces(1, 1, seconds=0.05), 2 * 1024**3)


def make_input(times: Any = TIMES, **options: Any) -> Channel:
    return Channel("u", times, np.sign(np.sin(2 * times)), "V", "zero", **options)


def run(model: Model, values: dict[str, float], *inputs: Channel) -> list[bytes]:
    made = simulate_outputs(model, inputs, values, TIMES, READERS, "p")
    return [one.times.tobytes() + one.values.tobytes() for one in made.channels]


@pytest.mark.parametrize(
    ("model", "values", "made"),
    [
        (load_model("fopdt"), FOPDT, make_input()),
        (
            DELAYED,
            {"b": 2.0, "L": 0.3, "c": 0.0},
            make_input(history=History(np.array([-1.0, -0.5]), np.array([3.0, 4.0]))),
        ),
        (DELAYED, {"b": 2.0, "L": 0.3, "c": 0.0}, make_input(np.array([-1.0, 0.05, 19.9]))),
        (parse_model(ARX), None, make_input()),
        (load_model("fopdt"), {**FOPDT, "T": -1e-3}, make_input()),  # which diverges
    ],
)
def test_a_child_simulates_the_same_bits(
    monkeypatch: pytest.MonkeyPatch, model: Model, values: dict[str, float] | None, made: Channel
) -> None:
    values = values or {parameter.name: 0.3 for parameter in model.parameters}
    here = run(model, values, made)
    monkeypatch.setattr(large_simulation, "LARGE_STEPS", 1)
    monkeypatch.setattr(simulation, "simulate", None)  # not in this process
    assert run(model, values, made) == here


def test_steps_are_those_of_the_simulation() -> None:
    model = load_model("fopdt")
    assert count_steps(model, TIMES) == pytest.approx(199 * model.solver.substeps)
    finer = replace(model, solver=replace(model.solver, step=0.01, substeps=3))
    assert count_steps(finer, TIMES) == pytest.approx(1990 * 3)


@pytest.fixture
def always_in_child(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    monkeypatch.setattr(large_simulation, "LARGE_STEPS", 1)
    return monkeypatch


def read_fault(readers: ReaderPlaces = READERS, **values: float) -> tuple[str, str]:
    with pytest.raises(InvalidRequest) as caught:
        simulate_outputs(
            load_model("fopdt"), [make_input()], {**FOPDT, **values}, TIMES, readers, "p"
        )
    (fault,) = caught.value.errors
    return fault.pointer, fault.detail


@pytest.mark.usefixtures("always_in_child")
def test_faults_of_a_child_are_those_of_the_request() -> None:
    _, detail = read_fault(extra=1.0)
    assert "extra" in detail


@pytest.mark.usefixtures("always_in_child")
def test_a_child_without_enough_memory_says_what_it_had() -> None:
    little = ReaderPlaces(READERS.places, 150 * 1024**2)
    pointer, detail = read_fault(little)
    assert pointer == "/samples"
    assert "needs more than 150 MiB of memory (LAGID_READER_MEMORY_MB)" in detail


@pytest.mark.usefixtures("always_in_child")
def test_a_child_waits_for_a_place_of_the_readers() -> None:
    with READERS.places.hold("another"), pytest.raises(ServiceBusy):
        run(load_model("fopdt"), FOPDT, make_input())
    assert run(load_model("fopdt"), FOPDT, make_input())  # the place is free again


def answer(code: int, stdout: bytes = b"", stderr: bytes = b"") -> Any:
    return lambda *_args, **_options: subprocess.CompletedProcess([], code, stdout, stderr)


def test_a_child_that_takes_too_long_is_ended(always_in_child: pytest.MonkeyPatch) -> None:
    always_in_child.setattr(data_child, "run_child", answer(OUT_OF_PROCESSOR_TIME))
    assert f"more than {SECONDS:g} s of processor time" in read_fault()[1]

    def wait(*_args: Any, **_options: Any) -> None:
        raise subprocess.TimeoutExpired("", 1)

    always_in_child.setattr(data_child, "run_child", wait)
    assert "needs more than 240 s" in read_fault()[1]


def test_a_child_that_the_system_ends_had_too_little_memory(
    always_in_child: pytest.MonkeyPatch,
) -> None:
    always_in_child.setattr(data_child, "run_child", answer(-9))
    assert "2048 MiB of memory" in read_fault()[1]


def test_other_ends_of_a_child_are_told_as_what_they_are(
    always_in_child: pytest.MonkeyPatch,
) -> None:
    always_in_child.setattr(data_child, "run_child", answer(0, b'{"is_disk_full": true}'))
    with pytest.raises(Unavailable, match=FULL_DISK_MESSAGE):
        run(load_model("fopdt"), FOPDT, make_input())
    always_in_child.setattr(data_child, "run_child", answer(1, stderr=b"no such module"))
    with pytest.raises(RuntimeError, match="no such module"):
        run(load_model("fopdt"), FOPDT, make_input())


def test_the_channel_of_the_times_has_a_name_of_its_own() -> None:
    named = [replace(make_input(), name=name) for name in ("t", "tt")]
    assert name_times(named) == "ttt"
    assert name_times([]) == "t"
