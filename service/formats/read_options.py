"""What the user says about a file: one value for Python, command line, REST and child process."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Final, Literal, TypeAlias, cast, get_args

import numpy as np

from service.formats.advice import build_period_error
from service.formats.limits import DEFAULT_LIMITS, UploadLimits
from sysid.core.errors import Advice, UnreadableFile

Clock: TypeAlias = Literal["log", "publish", "stamp"]
"""Times of the messages of an MCAP file: when each was logged, was sent, or was measured."""
CLOCKS: Final[tuple[Clock, ...]] = get_args(Clock)


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """What the user says about a file, and the limits of reading it.

    Attributes
    ----------
    sample_time : float or None
        Sampling period in s, for a file without a time column.
    segments : tuple of str
        Columns of labels. Consecutive rows with equal labels form a segment, and the time may
        restart with each segment.
    columns : tuple of str
        Names of the columns, in their order, for a file without a header: ``t``, ``u [V]``. A
        column with an empty name is left out.
    missing : tuple of str
        Words and numbers that mark bad data. If there are any, no other number does; ``none``
        alone says that no number does.
    exclude : tuple of str
        Ranges that are left out: ``t=100:200`` (s), ``flow=90:``, ``state=Bad``.
    clock : {"log", "publish", "stamp"}
        Times of an MCAP file: when a message was logged or sent, or the stamp in its header.
    limits : UploadLimits

    Raises
    ------
    UnreadableFile
        If the sampling period is no positive number, or there is no such clock.
    """

    sample_time: float | None = None
    segments: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    clock: Clock = "log"
    limits: UploadLimits = DEFAULT_LIMITS

    def __post_init__(self) -> None:
        if self.clock not in CLOCKS:
            what = f" is {self.clock!r}; need {', '.join(CLOCKS[:-1])} or {CLOCKS[-1]}"
            raise UnreadableFile("", Advice("", "clock", what))
        if self.sample_time is None:
            return
        is_number = isinstance(self.sample_time, int | float | np.number)
        if not is_number or not 0 < self.sample_time < float("inf"):
            raise build_period_error(self.sample_time)
        object.__setattr__(self, "sample_time", float(self.sample_time))

    def list_given(self) -> dict[str, Any]:
        """List the options that are not the default, as JSON; the limits are none."""
        given = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "limits"}
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in given.items()
            if value != getattr(DEFAULT_OPTIONS, name)
        }

    def to_document(self) -> dict[str, Any]:
        """Return all options as JSON, for the child process."""
        return self.list_given() | {"limits": asdict(self.limits)}

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> "ReadOptions":
        """Return the inverse of `to_document`."""
        given: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in document.items()
        }
        return cls(**{**given, "limits": UploadLimits(**document["limits"])})


DEFAULT_OPTIONS: Final = ReadOptions()


def build_options(
    *,
    sample_time: float | None = None,
    segments: Sequence[str] | str | None = None,
    columns: Sequence[str] | str | None = None,
    missing: Sequence[str | float] | str | None = None,
    exclude: Sequence[str] | str | None = None,
    clock: str | None = None,
    limits: UploadLimits = DEFAULT_LIMITS,
) -> ReadOptions:
    """Build options from what a user typed: lists, or texts with commas.

    Raises
    ------
    UnreadableFile
        If the sampling period is no positive number.
    """
    return ReadOptions(
        sample_time=sample_time,
        segments=tuple(name for name in _split(segments) if name),
        columns=_split(columns),
        missing=tuple(word for word in _split(missing) if word),
        exclude=tuple(condition for condition in _split(exclude) if condition),
        clock=cast(Clock, clock or "log"),
        limits=limits,
    )


def _split(names: Sequence[str | float] | str | None) -> tuple[str, ...]:
    parts = names.split(",") if isinstance(names, str) else names or ()
    return tuple(str(part).strip() for part in parts)
