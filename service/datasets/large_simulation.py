"""Simulations of a model: short ones here, long ones in a child process with limits.

A step takes some 160 bytes and up to a microsecond. So the longest simulation takes 3 GB and half a
minute, most of it with the interpreter's lock held: no other request would be answered meanwhile.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from service.core.errors import FieldError, InvalidRequest
from service.core.process import temporary_files
from service.core.process.concurrency import ReaderPlaces
from service.datasets.data_child import ask_child
from service.formats.mcap.mcap_files import read_mcap, write_recording
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording
from sysid.kernels.compilation.compile_task import encode_model
from sysid.models.model import Model

LARGE_STEPS = 2_000_000
"""Integration steps of a longer simulation, which a child does: some 320 MB."""
_TIMES = "t"


def simulate_outputs(
    model: Model,
    inputs: Sequence[Channel],
    values: Mapping[str, float],
    times: FloatArray,
    readers: ReaderPlaces,
    project: str,
) -> Recording:
    """Simulate the outputs of a model at some times, as `sysid.simulate` does.

    Parameters
    ----------
    times : FloatArray, shape (N,)
        Regular times in s.
    readers : ReaderPlaces
        Places and memory of child processes.
    project : str
        The project that asks.

    Returns
    -------
    Recording
        Not finite where the simulation diverged; see `check_finite_outputs`.

    Raises
    ------
    InvalidRequest
        If the simulation cannot be done, or needs more memory or time than a child has.
    ServiceBusy
        If no place became free in time.
    Unavailable
        If the disk of temporary files is full.
    """
    if count_steps(model, times) <= LARGE_STEPS:
        # This import loads the compiler, which most requests never need.
        from sysid.simulation.simulate import simulate

        return simulate(model, inputs, values, times=times)
    with (
        readers.places.hold(project),
        TemporaryDirectory(prefix=temporary_files.make_temporary_prefix()) as folder,
    ):
        return _simulate_in_child(model, inputs, values, times, readers.memory_bytes, Path(folder))


def count_steps(model: Model, times: FloatArray) -> float:
    """Count the integration steps between regular times."""
    span = float(times[-1] - times[0])
    step = model.solver.step or span / (times.size - 1)
    return span / step * model.solver.substeps


def check_finite_outputs(outputs: Sequence[Channel], times: FloatArray) -> None:
    """Refuse a simulation that diverges.

    Raises
    ------
    InvalidRequest
        With the output and the time.
    """
    for channel in outputs:
        invalid = np.flatnonzero(~np.isfinite(channel.values))
        if invalid.size:
            raise InvalidRequest.from_fault(
                "/parameters",
                f"with these values output {channel.name!r} diverges at "
                f"t = {times[invalid[0]]:g} s; choose other values, or a shorter sampling period",
            )


def _simulate_in_child(
    model: Model,
    inputs: Sequence[Channel],
    values: Mapping[str, float],
    times: FloatArray,
    memory_bytes: int,
    folder: Path,
) -> Recording:
    source, target = folder / "inputs.mcap", folder / "outputs.mcap"
    # The times are a channel too: a model may have no input, and inputs have times of their own.
    write_recording(Recording((*inputs, Channel(name_times(inputs), times, times))), source)
    task = {
        "model": encode_model(model),
        "values": dict(values),
        "source": str(source),
        "target": str(target),
    }

    def refuse(limit: str) -> FieldError:
        steps = f"a simulation of {count_steps(model, times):.3g} steps"
        return FieldError("/samples", f"{steps} needs more than {limit}; ask for fewer samples")

    ask_child("service.datasets.simulation_child", task, memory_bytes, refuse)
    return read_mcap(target)


def name_times(inputs: Sequence[Channel]) -> str:
    """Name the channel of the times as no input is named."""
    name = _TIMES
    while any(channel.name == name for channel in inputs):
        name += _TIMES
    return name
