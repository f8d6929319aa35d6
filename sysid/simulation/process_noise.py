"""A record with noise inside the plant: simulated again from known parameters.

Noise of the plant enters where the model's document says (`noise: {plant: …}`), as φ(k) of Eq. 16
or φ(t) of Eq. 13. It is one more input of each such equation, held over a step.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.types import FloatArray
from sysid.data.noise import Noise, add_output_noise, draw_noise
from sysid.data.records import Channel, Record
from sysid.kernels.signals.past_reads import is_difference
from sysid.language.tree import Binary, PastValue
from sysid.models.model import Model, ModelSignal
from sysid.simulation.simulate import check_values, simulate

_FIRST_STREAM = 500  # of the noise of states: outputs have those before


def add_noise(model: Model, record: Record, noise: Noise, experiment: int = 0) -> Record:
    """Add noise to the outputs of a record, or inside the plant; the inputs stay unchanged.

    Raises
    ------
    InvalidSettings
        If noise inside the plant has no place in the model, or the true parameters are not all
        given.
    """
    if noise.place == "sensor":
        return add_output_noise(record, noise, experiment)
    check_process_noise(model, noise)
    if noise.sigma == 0:
        return record
    states = model.noise.plant
    times = record.outputs[0].times
    if any(not np.array_equal(channel.times, times) for channel in record.outputs):
        raise InvalidSettings("/noise/place", "plant needs outputs that have the same times")
    step = float(np.min(np.diff(times))) / model.solver.substeps
    moments = times[0] + step * np.arange(round((times[-1] - times[0]) / step) + 1)
    scale = 1.0 if is_difference(model) else step**-0.5
    sources = tuple(
        Channel(
            _name_source(state),
            moments,
            scale * draw_noise(noise, moments.size, 1000 * experiment + _FIRST_STREAM + number),
            hold="zero",
        )
        for number, state in enumerate(states)
    )
    driven = Record((*record.inputs, *sources), record.outputs)
    with _move_faults():
        outputs = simulate(_drive(model), driven, noise.parameters, times=times).channels
    values = {channel.name: channel.values for channel in outputs}
    return replace(
        record,
        outputs=tuple(
            replace(channel, values=_keep_gaps(channel, values[channel.name]))
            for channel in record.outputs
        ),
    )


def check_process_noise(model: Model, noise: Noise) -> None:
    """Check that noise inside the plant has a place in a model, and all parameters their values.

    Raises
    ------
    InvalidSettings
        With the pointer into the noise.
    """
    if noise.place == "sensor":
        return
    if not model.noise.plant:
        raise InvalidSettings(
            "/noise/place",
            f"the document of {model.name!r} does not say where noise enters. Write noise: "
            "{plant: {x: estimate}} there, with the names of its states",
        )
    if model.rule is not None:
        raise InvalidSettings("/noise/place", "plant has no meaning: the terms are not known yet")
    with _move_faults():
        check_values(model, noise.parameters)


@contextmanager
def _move_faults() -> Iterator[None]:
    """Move faults of the values of a simulation to those of the noise."""
    try:
        yield
    except InvalidSettings as error:
        raise InvalidSettings(f"/noise{error.pointer}", error.detail) from None


def _name_source(state: str) -> str:
    return f"φ[{state}]"


def _drive(model: Model) -> Model:
    """Drive the states that have noise by inputs."""
    noisy = model.noise.plant
    names: Mapping[str, str] = {state: _name_source(state) for state in noisy}
    equations = tuple(
        Binary("+", tree, PastValue(names[state.name], "input")) if state.name in names else tree
        for state, tree in zip(model.states, model.equations, strict=True)
    )
    inputs = (*model.inputs, *(ModelSignal(name) for name in names.values()))
    return replace(model, inputs=inputs, equations=equations)


def _keep_gaps(channel: Channel, values: FloatArray) -> FloatArray:
    return np.where(np.isfinite(channel.values), values, np.nan)
