"""Map the signals of a model to channels of a recording, and set how inputs are held."""

from collections.abc import Mapping
from dataclasses import dataclass

from sysid.data.records import HoldSetting, Record, Recording
from sysid.inspection.inspect import extract_inspected
from sysid.models.model import Model


@dataclass(frozen=True, slots=True)
class SignalChannels:
    """The channels of a model's signals.

    Attributes
    ----------
    inputs, outputs : tuple of (signal, channel)
        In the order of the model.
    holds : tuple of (channel, hold)
        Channels whose hold differs from that of the recording.
    """

    inputs: tuple[tuple[str, str], ...]
    outputs: tuple[tuple[str, str], ...]
    holds: tuple[tuple[str, HoldSetting], ...] = ()

    @property
    def by_signal(self) -> dict[str, str]:
        """The channel of every signal, inputs first."""
        return dict((*self.inputs, *self.outputs))

    def cut_records(self, recording: Recording, name: str) -> tuple[Record, ...]:
        """Return the records of a recording, one for each segment and part between outages.

        Raises
        ------
        InvalidRecord
            If a channel is missing, or cannot be that signal.
        """
        held = recording.replace_holds(dict(self.holds))
        return extract_inspected(held, dict(self.inputs), dict(self.outputs), name)


def map_channels(
    model: Model, channels: Mapping[str, str], hold: Mapping[str, HoldSetting] | None = None
) -> SignalChannels:
    """Map every signal of a model to a channel, by default to the channel of its name.

    Parameters
    ----------
    channels, hold : mapping
        ``channels`` and ``hold`` of a job body, by the names of the signals.
    """
    return SignalChannels(
        inputs=tuple(
            (signal.name, channels.get(signal.name, signal.name)) for signal in model.inputs
        ),
        outputs=tuple(
            (signal.name, channels.get(signal.name, signal.name)) for signal in model.outputs
        ),
        holds=tuple((channels.get(name, name), kind) for name, kind in (hold or {}).items()),
    )
