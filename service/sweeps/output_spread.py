"""Standard deviation of an output: the unit of a relative σ."""

from collections.abc import Iterator, Sequence

import numpy as np

from service.core.errors import FieldError, InvalidRequest
from service.datasets.stored_recordings import load_recording
from service.storage.objects import ObjectStore
from service.storage.tables import Dataset
from sysid.data.records import Recording
from sysid.models.model import Model

MAX_READ_VALUES = 10_000_000
"""Most values to read, over all channels, so that a request does not take minutes."""


def relative_faults(model: Model, rows: Sequence[Dataset]) -> Iterator[FieldError]:
    """Report faults of a relative σ: several outputs, or too many values to read."""
    names = [signal.name for signal in model.outputs]
    if len(names) > 1:
        yield FieldError(
            "/relative",
            f"the model has the outputs {', '.join(names)}, but σ is one number for all. "
            "Give σ in their unit, with relative: false",
        )
    count = sum(row.n_samples * row.n_channels for row in rows)
    if count > MAX_READ_VALUES:
        yield FieldError(
            "/relative",
            f"the datasets have {count} values; at most {MAX_READ_VALUES} are read to compute "
            "the output's standard deviation. Give σ in the output's unit, with relative: false",
        )


def compute_spread(
    store: ObjectStore, rows: Sequence[Dataset], channel: str, unstored: Recording | None = None
) -> float:
    """Compute the standard deviation of a channel about each dataset's mean, over all datasets.

    Parameters
    ----------
    unstored : Recording, optional
        The recording of the only row if it is not stored.

    Raises
    ------
    InvalidRequest
        At ``/relative``, if the channel does not vary.
    """
    squares, count, largest = 0.0, 0, 0.0
    for row in rows:
        recording = load_recording(store, row.sha256) if unstored is None else unstored
        values = recording.channel(channel).values
        finite = values[np.isfinite(values)]
        if finite.size:
            squares += float(np.sum(np.square(finite - np.mean(finite))))
            count += finite.size
            largest = max(largest, float(np.max(np.abs(finite))))
    deviation = float(np.sqrt(squares / count)) if count else 0.0
    if not deviation > 1e-12 * largest:
        raise InvalidRequest.from_fault(
            "/relative",
            f"the output {channel!r} does not vary (standard deviation {deviation:g}), so σ cannot "
            "be relative to it. Give σ in its unit, with relative: false",
        )
    return deviation
