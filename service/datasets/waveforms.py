"""Signals described in a request: waves, steps, random binary signals, expressions, records."""

from dataclasses import replace
from math import pi

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import FieldError, InvalidRequest
from service.datasets.dataset_schemas import (
    BinaryInput,
    DatasetInput,
    ExpressionInput,
    InputIn,
    RunInputIn,
    SeriesInput,
    StepInput,
    WaveInput,
)
from service.datasets.stored_recordings import load_recording
from service.repositories.dataset_rows import DatasetRepository
from service.storage.objects import ObjectStore
from sysid.core.errors import InvalidRecord
from sysid.core.types import FloatArray
from sysid.core.units import describe_difference, find_conversion_factor
from sysid.data.history import change_values
from sysid.data.records import Channel, Hold, trim_missing_history
from sysid.language.checker import check_expression
from sysid.language.evaluation import evaluate_signal
from sysid.language.scope import Scope

MAX_DRAWS = 10_000_000
"""Maximum number of values of one random binary signal."""

_BEFORE_START = 1e-9
"""Time before the start at which a step has its offset, in sampling periods."""


class InputSignals:
    """Samples inputs at given times; records the datasets that they come from.

    Parameters
    ----------
    times : FloatArray, shape (N,)
        Times in s.
    """

    def __init__(self, session: Session, store: ObjectStore, times: FloatArray) -> None:
        self.parents: list[str] = []
        self._session, self._store, self._times = session, store, times

    def evaluate_input(self, pointer: str, signal: InputIn) -> FloatArray:
        """Evaluate one input, which is at `pointer` in the request.

        Raises
        ------
        InvalidRequest
            If an expression cannot be used, a dataset has no such channel, or a binary signal
            would be drawn more than `MAX_DRAWS` times.
        """
        t = self._times
        match signal:
            case WaveInput():
                angle = _get_angular_frequency(signal) * t + signal.phase
                wave = np.cos(angle) if signal.kind == "cosine" else np.sin(angle)
                return np.asarray(signal.offset + signal.amplitude * wave)
            case StepInput():
                return np.asarray(signal.offset + signal.amplitude * (t >= signal.time))
            case BinaryInput():
                draws = _draw_binary(pointer, signal, t)
                return np.asarray(signal.offset + signal.amplitude * draws)
            case ExpressionInput():
                return _evaluate_expression(pointer, signal.expression, t)
            case DatasetInput():
                return interpolate_channel(self._load_recorded(pointer, signal), t)

    def build_channel(self, pointer: str, name: str, unit: str, signal: RunInputIn) -> Channel:
        """Build one input with its behaviour between samples; a step has its offset before.

        Raises
        ------
        InvalidRequest, InvalidRecord
            As `evaluate_input`. Also if a step is outside the simulation, or times decrease.
        """
        match signal:
            case SeriesInput():
                times, values = (np.array(series) for series in (signal.times, signal.values))
                return Channel(name, times, values, unit, signal.hold)
            case DatasetInput():
                return self._convert_recorded(pointer, name, unit, signal)
            case StepInput():
                return self._build_step(pointer, name, unit, signal)
            case _:
                return self.sample_input(pointer, name, unit, signal)

    def sample_input(self, pointer: str, name: str, unit: str, signal: InputIn) -> Channel:
        """Sample one input at the given times, with its behaviour between them.

        Raises
        ------
        InvalidRequest, InvalidRecord
            As `evaluate_input`. Also if the unit of a recorded channel cannot be converted.
        """
        if isinstance(signal, DatasetInput):
            channel = self._convert_recorded(pointer, name, unit, signal)
            values = interpolate_channel(channel, self._times)
            return replace(channel, times=self._times, values=values, history=None, repeats=None)
        return Channel(
            name, self._times, self.evaluate_input(pointer, signal), unit, choose_hold(signal)
        )

    def _convert_recorded(
        self, pointer: str, name: str, unit: str, signal: DatasetInput
    ) -> Channel:
        """Convert a recorded channel to the unit of the input, if both have one."""
        channel = self._load_recorded(pointer, signal)
        difference = describe_difference(channel.unit, unit)
        factor = find_conversion_factor(channel.unit, unit) if difference else 1.0
        if factor is None:
            raise InvalidRequest.from_fault(
                f"{pointer}/channel",
                f"channel {channel.name!r} of {signal.dataset} is in {channel.unit}, but "
                f"{name!r} is in {unit}: {difference}",
            )
        return replace(
            change_values(channel, lambda _, values: values * factor), name=name, unit=unit
        )

    def _build_step(self, pointer: str, name: str, unit: str, signal: StepInput) -> Channel:
        start, stop = float(self._times[0]), float(self._times[-1])
        if not start <= signal.time < stop:
            raise InvalidRequest.from_fault(
                f"{pointer}/time",
                f"{signal.time:g} s is outside the simulation, from {start:g} to {stop:g} s",
            )
        # States start with the first input: at the start, not a sample before it.
        before = start - _BEFORE_START * float(self._times[1] - self._times[0])
        later = signal.offset + signal.amplitude
        times = np.array([before, signal.time, stop])
        return Channel(name, times, np.array([signal.offset, later, later]), unit, "zero")

    def _load_recorded(self, pointer: str, signal: DatasetInput) -> Channel:
        row = DatasetRepository(self._session).get(signal.dataset)
        try:
            channel = load_recording(self._store, row.sha256).channel(signal.channel)
        except InvalidRecord as error:
            raise InvalidRequest.from_fault(f"{pointer}/channel", str(error)) from None
        if row.id not in self.parents:
            self.parents.append(row.id)
        return replace(channel, started_at=None)  # a simulation has times of its own


def choose_hold(signal: RunInputIn) -> Hold:
    """Choose the hold of a sampled signal: a signal that jumps is held."""
    return "zero" if isinstance(signal, StepInput | BinaryInput) else "first"


def interpolate_channel(channel: Channel, times: FloatArray) -> FloatArray:
    """Interpolate a channel and its history at other times.

    A held channel has the value after a jump at the time of the jump.
    """
    known = replace(channel, history=trim_missing_history(channel.history))
    channel = known.acting.history_and_samples
    if channel.effective_hold != "zero":
        return np.interp(times, channel.times, channel.values)
    last = np.searchsorted(channel.times, times, side="right") - 1
    values: FloatArray = channel.values[np.clip(last, 0, channel.times.size - 1)]
    return values


def _get_angular_frequency(wave: WaveInput) -> float:
    """Return the angular frequency in rad/s."""
    if wave.frequency is not None:
        return 2 * pi * wave.frequency
    return wave.omega or 0.0


def _draw_binary(pointer: str, signal: BinaryInput, times: FloatArray) -> FloatArray:
    duration = float(times[-1])
    if not duration / signal.period < MAX_DRAWS:
        raise InvalidRequest.from_fault(
            f"{pointer}/period",
            f"found {signal.period:g} s, but then {duration:g} s need more than {MAX_DRAWS} draws. "
            f"Use a period of more than {duration / MAX_DRAWS:g} s.",
        )
    draw_of_sample = (times / signal.period).astype(np.int64)
    source = np.random.Generator(np.random.Philox(signal.seed))
    draws = source.integers(0, 2, int(draw_of_sample[-1]) + 1)
    return np.where(draws[draw_of_sample] == 1, 1.0, -1.0)


def _evaluate_expression(pointer: str, expression: str, times: FloatArray) -> FloatArray:
    """Evaluate an expression of t, k and h, as in a difference equation, at regular times (N,)."""
    tree, faults, _ = check_expression(expression, Scope("difference"))
    if tree is None:
        raise InvalidRequest(
            FieldError(f"{pointer}/expression", fault.detail, fault.column) for fault in faults
        )
    return evaluate_signal(tree, times)
