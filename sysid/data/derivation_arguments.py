"""Arguments of a derivation step; each fault is reported with its JSON pointer."""

import sys
from collections.abc import Mapping
from typing import Any, NoReturn, TypeVar

from sysid.core.errors import InvalidSettings, join_pointer, suggest_name

Word = TypeVar("Word", bound=str)


class StepArguments:
    """Arguments of one derivation step.

    Raises
    ------
    InvalidSettings
        From every method, if the argument is missing or has the wrong type.
    """

    def __init__(self, pointer: str, arguments: object) -> None:
        self.pointer = pointer
        if not isinstance(arguments, Mapping):
            self.fail("", f"found {arguments!r}; need an object with the step's settings")
        self._arguments: Mapping[str, Any] = arguments

    def fail(self, name: str, detail: str) -> NoReturn:
        """Raise an error for one argument, or for the step if the name is empty."""
        location = self.pointer + (join_pointer(name) if name else "")
        raise InvalidSettings(location, detail)

    def reject_others(self, *names: str) -> None:
        """Raise if there is any argument except these."""
        for name in self._arguments:
            if name not in names:
                self.fail(str(name), f"there is no such setting{suggest_name(str(name), names)}")

    def has_argument(self, name: str) -> bool:
        """Whether the argument is present and not null."""
        return self._arguments.get(name) is not None

    def get_value(self, name: str) -> object:
        """Return the argument unchecked; None if it is missing."""
        return self._arguments.get(name)

    def get_items(self) -> list[tuple[str, Any]]:
        """Return all arguments; at least one."""
        if not self._arguments:
            self.fail("", "is empty; need at least one entry")
        return [(str(name), value) for name, value in self._arguments.items()]

    def read_number(self, name: str, default: float | None = None) -> float:
        """Read a finite number."""
        value = self._arguments.get(name, default)
        if value is None:
            self.fail(name, "is missing; need a number")
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not abs(value) <= sys.float_info.max:
            self.fail(name, f"found {value!r}; need a finite number")
        return float(value)

    def read_flag(self, name: str, *, default: bool) -> bool:
        """Read true or false."""
        value = self._arguments[name] if self.has_argument(name) else default
        if not isinstance(value, bool):
            self.fail(name, f"found {value!r}; need true or false")
        return value

    def read_positive(self, name: str) -> float:
        """Read a number above 0."""
        value = self.read_number(name)
        if value <= 0:
            self.fail(name, f"found {value!r}; need a positive number")
        return value

    def read_whole_number(
        self, name: str, default: int | None = None, most: int = 2**63 - 1
    ) -> int:
        """Read a whole number from 0 to `most`."""
        value = self._arguments.get(name, default)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
            self.fail(name, f"found {value!r}; need a whole number from 0 to {most}")
        return value

    def read_text(self, name: str, default: str | None = None) -> str:
        """Read a text."""
        value = self._arguments.get(name, default)
        if not isinstance(value, str):
            self.fail(name, f"found {value!r}; need a text")
        return value

    def read_texts(self, name: str) -> list[str]:
        """Read a list of texts, at least one."""
        value = self._arguments.get(name)
        if not isinstance(value, list | tuple) or not value:
            self.fail(name, f"found {value!r}; need a list of names")
        for entry in value:
            if not isinstance(entry, str):
                self.fail(name, f"found {entry!r} in the list; need names")
        return list(value)

    def read_choice(
        self, name: str, choices: tuple[Word, ...], default: Word | None = None
    ) -> Word:
        """Read one of some words."""
        value = self.read_text(name, default)
        for choice in choices:
            if value == choice:
                return choice
        self.fail(name, f"found {value!r}; need one of {', '.join(choices)}")

    def read_range(self, name: str) -> tuple[int, int]:
        """Read two whole numbers, the second larger than the first."""
        value = self._arguments.get(name)
        is_whole = isinstance(value, list | tuple) and all(type(entry) is int for entry in value)
        if not is_whole or len(value) != 2 or not 0 <= value[0] < value[1]:  # type: ignore[arg-type,index]
            self.fail(name, f"found {value!r}; need [first, last + 1], whole numbers from 0")
        return value[0], value[1]  # type: ignore[index]
