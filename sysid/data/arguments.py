"""Arguments of a derivation step, taken one by one; each fault is told with its JSON pointer."""

from collections.abc import Mapping
from math import isfinite
from typing import Any, NoReturn, TypeVar

from sysid.core.errors import InvalidSettings, join_pointer, suggest_name

Word = TypeVar("Word", bound=str)


class StepArguments:
    """The mapping that belongs to one step.

    Raises
    ------
    InvalidSettings
        From every method, if the argument is missing or of the wrong kind.
    """

    def __init__(self, pointer: str, given: object) -> None:
        self.pointer = pointer
        if not isinstance(given, Mapping):
            self.fail("", f"found {given!r}; need an object with the step's settings")
        self._given: Mapping[str, Any] = given

    def fail(self, name: str, detail: str) -> NoReturn:
        """Raise the error of one argument (of the step itself if the name is empty)."""
        place = self.pointer + (join_pointer(name) if name else "")
        raise InvalidSettings(place, detail)

    def reject_others(self, *names: str) -> None:
        """Refuse every argument but these."""
        for name in self._given:
            if name not in names:
                self.fail(str(name), f"there is no such setting{suggest_name(str(name), names)}")

    def has_argument(self, name: str) -> bool:
        """Whether the argument is given and not null."""
        return self._given.get(name) is not None

    def get_value(self, name: str) -> object:
        """Return the argument as it is, None if it is not given."""
        return self._given.get(name)

    def get_items(self) -> list[tuple[str, Any]]:
        """All arguments; at least one."""
        if not self._given:
            self.fail("", "is empty; need at least one entry")
        return [(str(name), value) for name, value in self._given.items()]

    def read_number(self, name: str, default: float | None = None) -> float:
        """Return a finite number."""
        value = self._given.get(name, default)
        if value is None:
            self.fail(name, "is missing; need a number")
        if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
            self.fail(name, f"found {value!r}; need a finite number")
        return float(value)

    def read_flag(self, name: str, *, default: bool) -> bool:
        """Return true or false."""
        value = self._given[name] if self.has_argument(name) else default
        if not isinstance(value, bool):
            self.fail(name, f"found {value!r}; need true or false")
        return value

    def read_positive(self, name: str) -> float:
        """Return a number above 0."""
        value = self.read_number(name)
        if value <= 0:
            self.fail(name, f"found {value!r}; need a positive number")
        return value

    def read_whole_number(
        self, name: str, default: int | None = None, most: int = 2**63 - 1
    ) -> int:
        """Return a whole number from 0 to `most`."""
        value = self._given.get(name, default)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
            self.fail(name, f"found {value!r}; need a whole number from 0 to {most}")
        return value

    def read_text(self, name: str, default: str | None = None) -> str:
        """Return a text."""
        value = self._given.get(name, default)
        if not isinstance(value, str):
            self.fail(name, f"found {value!r}; need a text")
        return value

    def read_texts(self, name: str) -> list[str]:
        """Return a list of texts, at least one."""
        value = self._given.get(name)
        if not isinstance(value, list | tuple) or not value:
            self.fail(name, f"found {value!r}; need a list of names")
        for one in value:
            if not isinstance(one, str):
                self.fail(name, f"found {one!r} in the list; need names")
        return list(value)

    def read_choice(
        self, name: str, choices: tuple[Word, ...], default: Word | None = None
    ) -> Word:
        """Return one of some words."""
        value = self.read_text(name, default)
        for one in choices:
            if value == one:
                return one
        self.fail(name, f"found {value!r}; need one of {', '.join(choices)}")

    def read_range(self, name: str) -> tuple[int, int]:
        """Return two whole numbers, the second the larger."""
        value = self._given.get(name)
        whole = isinstance(value, list | tuple) and all(type(one) is int for one in value)
        if not whole or len(value) != 2 or not 0 <= value[0] < value[1]:  # type: ignore[arg-type,index]
            self.fail(name, f"found {value!r}; need [first, last + 1], whole numbers from 0")
        return value[0], value[1]  # type: ignore[index]
