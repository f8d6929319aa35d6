"""Faults at the place where the user wrote: at an option or in a file, not at a pointer."""

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from service.calls import NotFinite, ProblemError
from service.cli.common import fail
from service.errors import FieldError

INVALID = 422
INSIDE = re.compile(r"(?<=; there is )/\S+|^/[^ :]+(?=: )")
"""Pointers in a message: where a field of a name is, and what in a value of an axis is wrong."""

SETTING = re.compile(r"(?<!\bthe model )\b(\w+): \{([^{}:]+): ([^{}:,]+)\}")
"""A field of a job in a note, as a job file has it: ``loss: {noise_model: ar1}``.

What the model is to be given is a field of its document, which no option sets.
"""


@dataclass(frozen=True, slots=True)
class Places:
    """Where the fields of a body were written.

    Attributes
    ----------
    options : mapping
        Pointer of a field → the option that gives it. One that ends in ``{}`` has there the name
        of what is below the field: ``/truth/parameters/K`` is ``--true K``. One that ends in ``…``
        is followed by the rest of the pointer: a place in a file.
    rest : str
        What all other fields are given by, in the same way; ``--set {}`` has the whole path.
    """

    options: Mapping[str, str] = field(default_factory=dict)
    rest: str = "--set {}"

    def of(self, pointer: str) -> str:
        """The place of a pointer."""
        for above in _upwards(pointer):
            if above in self.options:
                return _written(self.options[above], pointer.removeprefix(above))
        return _written(self.rest, pointer, is_whole=True)

    def told(self, faults: Iterable[FieldError]) -> str:
        """Faults as one line."""
        return "; ".join(self._one(fault) for fault in faults)

    def in_note(self, note: str) -> str:
        """A note of a result, with the options in it that set the fields which it advises."""
        return SETTING.sub(self._typed, note)

    def _typed(self, found: re.Match[str]) -> str:
        part, name, value = found.groups()
        place = self.of(f"/{part}/{name.replace('~', '~0').replace('/', '~1')}")
        return f"{place}{'=' if place.startswith('--set ') else ' '}{value}"

    def _one(self, fault: FieldError) -> str:
        place = self.of(fault.pointer) if fault.pointer else ""
        column = "" if fault.column is None else f", column {fault.column}"
        detail = fault.detail
        if not self.rest.endswith("…"):
            detail = INSIDE.sub(lambda found: self.of(found[0]), detail)
        return f"{place}{column}: {detail}" if place else detail


def in_file(name: object) -> Places:
    """Places of a body that is a file."""
    return Places(rest=f"{name} …")


@contextmanager
def told_at(places: Places) -> Iterator[None]:
    """End the command with the faults that a server finds in a body, at the user's places."""
    try:
        yield
    except NotFinite as error:
        fail(f"{places.of(error.pointer)}: {error.reason}", 2)
    except ProblemError as error:
        entries = error.document.get("errors") or ()
        if error.status != INVALID or not entries:
            raise
        fail(places.told(
            FieldError(str(one.get("pointer") or ""), str(one.get("detail")), one.get("column"))
            for one in entries
        ))  # fmt: skip


def _upwards(pointer: str) -> Iterator[str]:
    """A pointer and all that hold it, the longest first."""
    while pointer:
        yield pointer
        pointer = pointer.rpartition("/")[0]


def _written(option: str, below: str, *, is_whole: bool = False) -> str:
    parts = [one.replace("~1", "/").replace("~0", "~") for one in below.split("/")[1:]]
    if option.endswith("…"):
        return option.replace(" …", f": {below}" if below else "")
    name = ".".join(parts) if is_whole else "".join(parts[:1])
    return option.replace("{}", name).rstrip()
