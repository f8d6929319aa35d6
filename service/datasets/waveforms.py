"""Signals that a request describes: waves, steps, random binary signals, expressions, records."""

from dataclasses import replace
from math import pi

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import FieldError, InvalidRequest
from service.datasets.recordings import load_recording
from service.datasets.schemas import (
    BinaryInput,
    DatasetInput,
    ExpressionInput,
    InputIn,
    RunInputIn,
    SeriesInput,
    StepInput,
    WaveInput,
)
from service.repositories.datasets import DatasetRepository
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
"""Values of one random binary signal at most."""

_BEFORE_START = (
    1e-9  # of a sampling period: how long before the start a step shows where it comes from
)


class InputSignals:
    """Values of inputs at given times; remembers the datasets they came from.

    Parameters
    ----------
    times : FloatArray, shape (N,)
        In s.
    """

    def __init__(self, session: Session, store: ObjectStore, times: FloatArray) -> None:
        self.parents: list[str] = []
        self._session, self._store, self._times = session, store, times

    def evaluate_input(self, pointer: str, signal: InputIn) -> FloatArray:
        """Values of one input, which stands at `pointer` in the request.

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
        """One input with what it does between its samples; before a step it has its offset.

        Raises
        ------
        InvalidRequest, InvalidRecord
            As `of`; if a step lies before the start, or given times decrease.
        """
        match signal:
            case SeriesInput():
                times, values = (np.array(one) for one in (signal.times, signal.values))
                return Channel(name, times, values, unit, signal.hold)
            case DatasetInput():
                return self._convert_recorded(pointer, name, unit, signal)
            case StepInput():
                return self._build_step(pointer, name, unit, signal)
            case _:
                return self.sample_input(pointer, name, unit, signal)

    def sample_input(self, pointer: str, name: str, unit: str, signal: InputIn) -> Channel:
        """One input at the given times, with what it does between them.

        Raises
        ------
        InvalidRequest, InvalidRecord
            As `of`; if a recorded channel is in a unit that is not the input's.
        """
        if isinstance(signal, DatasetInput):
            found = self._convert_recorded(pointer, name, unit, signal)
            values = interpolate_channel(found, self._times)
            return replace(found, times=self._times, values=values, history=None)
        return Channel(
            name, self._times, self.evaluate_input(pointer, signal), unit, choose_hold(signal)
        )

    def _convert_recorded(
        self, pointer: str, name: str, unit: str, signal: DatasetInput
    ) -> Channel:
        """A recorded channel as an input: in its unit, where both have one."""
        found = self._load_recorded(pointer, signal)
        told = describe_difference(found.unit, unit)
        times = find_conversion_factor(found.unit, unit) if told else 1.0
        if times is None:
            raise InvalidRequest.from_fault(
                f"{pointer}/channel",
                f"channel {found.name!r} of {signal.dataset} is in {found.unit}, but "
                f"{name!r} is in {unit}: {told}",
            )
        return replace(change_values(found, lambda _, values: values * times), name=name, unit=unit)

    def _build_step(self, pointer: str, name: str, unit: str, signal: StepInput) -> Channel:
        start, stop = float(self._times[0]), float(self._times[-1])
        if not start <= signal.time < stop:
            raise InvalidRequest.from_fault(
                f"{pointer}/time",
                f"{signal.time:g} s is outside the simulation, from {start:g} to {stop:g} s",
            )
        # States start where the first input does: at the start, not a sample before it.
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
        return channel


def choose_hold(signal: RunInputIn) -> Hold:
    """What a signal that is laid on samples does between them: one that jumps is held."""
    return "zero" if isinstance(signal, StepInput | BinaryInput) else "first"


def interpolate_channel(channel: Channel, times: FloatArray) -> FloatArray:
    """Values of a channel at other times, in its history too; of a held one, those after jumps."""
    channel = replace(channel, history=trim_missing_history(channel.history)).history_and_samples
    if channel.hold != "zero":
        return np.interp(times, channel.times, channel.values)
    last = np.searchsorted(channel.times, times, side="right") - 1
    found: FloatArray = channel.values[np.clip(last, 0, channel.times.size - 1)]
    return found


def _get_angular_frequency(wave: WaveInput) -> float:
    """Angular frequency in rad/s."""
    if wave.frequency is not None:
        return 2 * pi * wave.frequency
    return wave.omega or 0.0


def _draw_binary(pointer: str, signal: BinaryInput, times: FloatArray) -> FloatArray:
    duration = float(times[-1])
    if not duration / signal.period < MAX_DRAWS:
        raise InvalidRequest.from_fault(
            f"{pointer}/period",
            f"found {signal.period:g} s, so that {duration:g} s need more than {MAX_DRAWS} "
            f"draws; need more than {duration / MAX_DRAWS:g} s",
        )
    places = (times / signal.period).astype(np.int64)
    source = np.random.Generator(np.random.Philox(signal.seed))
    draws = source.integers(0, 2, int(places[-1]) + 1)
    return np.where(draws[places] == 1, 1.0, -1.0)


def _evaluate_expression(pointer: str, expression: str, times: FloatArray) -> FloatArray:
    """An expression of t, k and h, as in a difference equation, at regular times (N,)."""
    tree, faults, _ = check_expression(expression, Scope("difference"))
    if tree is None:
        raise InvalidRequest(
            FieldError(f"{pointer}/expression", one.detail, one.column) for one in faults
        )
    return evaluate_signal(tree, times)
