"""Signals that a request describes: waves, steps, random binary signals, expressions, records."""

from dataclasses import replace
from math import pi

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import FieldError, InvalidRequest
from service.datasets.recordings import recording_of
from service.datasets.schemas import (
    BinaryInput,
    DatasetInput,
    ExpressionInput,
    InputIn,
    RunInputIn,
    SeriesInput,
    StepInput,
    Wave,
)
from service.repositories.datasets import DatasetRepository
from service.storage.objects import ObjectStore
from sysid.core.errors import InvalidRecord
from sysid.core.types import FloatArray
from sysid.core.units import difference, factor
from sysid.data.history import changed
from sysid.data.records import Channel, Hold, known_history
from sysid.language.checker import check
from sysid.language.evaluation import values_at
from sysid.language.scope import Scope

MOST_DRAWS = 10_000_000
"""Values of one random binary signal at most."""

_MOMENT = 1e-9  # of a sampling period: how long before the start a step shows where it comes from


class Signals:
    """Values of inputs at given times; remembers the datasets they came from.

    Parameters
    ----------
    times : FloatArray, shape (N,)
        In s.
    """

    def __init__(self, session: Session, store: ObjectStore, times: FloatArray) -> None:
        self.parents: list[str] = []
        self._session, self._store, self._times = session, store, times

    def of(self, pointer: str, signal: InputIn) -> FloatArray:
        """Values of one input, which stands at `pointer` in the request.

        Raises
        ------
        InvalidRequest
            If an expression cannot be used, a dataset has no such channel, or a binary signal
            would be drawn more than `MOST_DRAWS` times.
        """
        t = self._times
        match signal:
            case Wave():
                angle = _omega(signal) * t + signal.phase
                wave = np.cos(angle) if signal.kind == "cosine" else np.sin(angle)
                return np.asarray(signal.offset + signal.amplitude * wave)
            case StepInput():
                return np.asarray(signal.offset + signal.amplitude * (t >= signal.time))
            case BinaryInput():
                draws = _binary(pointer, signal, t)
                return np.asarray(signal.offset + signal.amplitude * draws)
            case ExpressionInput():
                return _evaluated(pointer, signal.expression, t)
            case DatasetInput():
                return sampled(self._recorded(pointer, signal), t)

    def channel(self, pointer: str, name: str, unit: str, signal: RunInputIn) -> Channel:
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
                return self._converted(pointer, name, unit, signal)
            case StepInput():
                return self._stepped(pointer, name, unit, signal)
            case _:
                return self.on_samples(pointer, name, unit, signal)

    def on_samples(self, pointer: str, name: str, unit: str, signal: InputIn) -> Channel:
        """One input at the given times, with what it does between them.

        Raises
        ------
        InvalidRequest, InvalidRecord
            As `of`; if a recorded channel is in a unit that is not the input's.
        """
        if isinstance(signal, DatasetInput):
            found = self._converted(pointer, name, unit, signal)
            values = sampled(found, self._times)
            return replace(found, times=self._times, values=values, history=None)
        return Channel(name, self._times, self.of(pointer, signal), unit, hold_of(signal))

    def _converted(self, pointer: str, name: str, unit: str, signal: DatasetInput) -> Channel:
        """A recorded channel as an input: in its unit, where both have one."""
        found = self._recorded(pointer, signal)
        told = difference(found.unit, unit)
        times = factor(found.unit, unit) if told else 1.0
        if times is None:
            raise InvalidRequest.at(
                f"{pointer}/channel",
                f"channel {found.name!r} of {signal.dataset} is in {found.unit}, but "
                f"{name!r} is in {unit}: {told}",
            )
        return replace(changed(found, lambda _, values: values * times), name=name, unit=unit)

    def _stepped(self, pointer: str, name: str, unit: str, signal: StepInput) -> Channel:
        start, stop = float(self._times[0]), float(self._times[-1])
        if not start <= signal.time < stop:
            raise InvalidRequest.at(
                f"{pointer}/time",
                f"{signal.time:g} s is outside the simulation, from {start:g} to {stop:g} s",
            )
        # States start where the first input does: at the start, not a sample before it.
        before = start - _MOMENT * float(self._times[1] - self._times[0])
        later = signal.offset + signal.amplitude
        times = np.array([before, signal.time, stop])
        return Channel(name, times, np.array([signal.offset, later, later]), unit, "zero")

    def _recorded(self, pointer: str, signal: DatasetInput) -> Channel:
        row = DatasetRepository(self._session).get(signal.dataset)
        try:
            channel = recording_of(self._store, row.sha256).channel(signal.channel)
        except InvalidRecord as error:
            raise InvalidRequest.at(f"{pointer}/channel", str(error)) from None
        if row.id not in self.parents:
            self.parents.append(row.id)
        return channel


def hold_of(signal: RunInputIn) -> Hold:
    """What a signal that is laid on samples does between them: one that jumps is held."""
    return "zero" if isinstance(signal, StepInput | BinaryInput) else "first"


def sampled(channel: Channel, times: FloatArray) -> FloatArray:
    """Values of a channel at other times, in its history too; of a held one, those after jumps."""
    channel = replace(channel, history=known_history(channel.history)).whole
    if channel.hold != "zero":
        return np.interp(times, channel.times, channel.values)
    last = np.searchsorted(channel.times, times, side="right") - 1
    found: FloatArray = channel.values[np.clip(last, 0, channel.times.size - 1)]
    return found


def _omega(wave: Wave) -> float:
    """Angular frequency in rad/s."""
    if wave.frequency is not None:
        return 2 * pi * wave.frequency
    return wave.omega or 0.0


def _binary(pointer: str, signal: BinaryInput, times: FloatArray) -> FloatArray:
    duration = float(times[-1])
    if not duration / signal.period < MOST_DRAWS:
        raise InvalidRequest.at(
            f"{pointer}/period",
            f"found {signal.period:g} s, so that {duration:g} s need more than {MOST_DRAWS} "
            f"draws; need more than {duration / MOST_DRAWS:g} s",
        )
    places = (times / signal.period).astype(np.int64)
    source = np.random.Generator(np.random.Philox(signal.seed))
    draws = source.integers(0, 2, int(places[-1]) + 1)
    return np.where(draws[places] == 1, 1.0, -1.0)


def _evaluated(pointer: str, expression: str, times: FloatArray) -> FloatArray:
    """An expression of t, k and h, as in a difference equation, at regular times (N,)."""
    tree, faults, _ = check(expression, Scope("difference"))
    if tree is None:
        raise InvalidRequest(
            FieldError(f"{pointer}/expression", one.detail, one.column) for one in faults
        )
    return values_at(tree, times)
