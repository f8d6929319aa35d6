"""Errors that the numerical core raises on purpose.

* SysidError
    - InvalidBounds        a parameter's search interval is empty or not finite
    - InvalidModel         a model document has faults (each with its pointer)
    - UnknownModel         no built-in model has that name
    - InvalidRecord        a recording cannot be used: channels, times or values
    - UnreadableFile       a file of a recording cannot be used (with row and column, or byte)
    - RecordTooShort       a record is shorter than the model's memory
    - InvalidSettings      a setting of the search or of the problem is invalid
    - DivergedEverywhere   every candidate of a search diverged
    - NothingIdentifiable  no free parameter has an effect on the output
    - UnknownParameter     a result has no parameter of that name
    - UnreadableResult     a file of a result or of an identified model cannot be used
    - UnwritableFile       a file cannot be written
    - MissingLibrary       a call needs a library that is not installed

A message says what was wrong, what was read, and what would be right. Numerical kernels never
raise. They return ``nan`` or ``inf``, and the caller decides.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, NamedTuple

_MAX_NAMES = 30
"""Most valid names that a message lists; there may be thousands of datasets."""


class SysidError(Exception):
    """Base class of the errors that the numerical core raises on purpose.

    Examples
    --------
    >>> try:
    ...     load_model("fopd")
    ... except SysidError as error:
    ...     print(error)
    there is no model 'fopd'; did you mean 'fopdt'?
    >>> try:
    ...     load_model("mine.yaml")
    ... except UnknownModel as error:
    ...     print(error)
    there is no model 'mine.yaml'; a file is a path: Path('mine.yaml')
    """

    def __reduce__(self) -> tuple[Any, ...]:
        # By default an error is unpickled by calling its class with its message. A pool of
        # processes never ends if that fails.
        return _rebuild_error, (type(self), self.args, self.__dict__)


def _rebuild_error(kind: type[SysidError], args: tuple[Any, ...], state: dict[str, Any]) -> Any:
    error = kind.__new__(kind, *args)
    error.__dict__.update(state)
    return error


class InvalidBounds(SysidError, ValueError):
    """A parameter's search interval is empty or not finite."""

    def __init__(self, name: str, lower: float, upper: float, detail: str = "") -> None:
        need = detail or "need finite lower < upper"
        super().__init__(f"parameter {name!r} has bounds [{lower:g}, {upper:g}]; {need}")
        self.name, self.lower, self.upper = name, lower, upper


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of a document.

    Attributes
    ----------
    pointer : str
        JSON pointer of the field, such as ``/equations/v``.
    detail : str
        What was wrong, what was read, and what would be right.
    column : int or None
        Column (from 1) inside the text of the field, for equations.
    """

    pointer: str
    detail: str
    column: int | None = None

    def __str__(self) -> str:
        location = self.pointer if self.column is None else f"{self.pointer}, column {self.column}"
        return f"{location}: {self.detail}" if location else self.detail


class InvalidModel(SysidError, ValueError):
    """A model document has faults.

    Examples
    --------
    >>> try:
    ...     load_model({"name": "x", "form": "differential"})
    ... except InvalidModel as error:
    ...     print(error.faults[0].pointer)
    /states
    """

    def __init__(self, faults: Iterable[Fault]) -> None:
        self.faults = tuple(faults)
        super().__init__("; ".join(str(fault) for fault in self.faults))


class UnknownModel(SysidError, LookupError):
    """No built-in model has that name.

    Examples
    --------
    >>> try:
    ...     load_model("fopd")
    ... except UnknownModel as error:
    ...     print(error)
    there is no model 'fopd'; did you mean 'fopdt'?
    >>> try:
    ...     load_model("mine.yaml")
    ... except UnknownModel as error:
    ...     print(error)
    there is no model 'mine.yaml'; a file is a path: Path('mine.yaml')
    """

    def __init__(self, name: str, valid: Iterable[str]) -> None:
        is_file = name.endswith((".yaml", ".yml", ".json"))
        hint = f"; a file is a path: Path({name!r})" if is_file else suggest_name(name, valid)
        super().__init__(f"there is no model {name!r}{hint}")
        self.name = name


class InvalidRecord(SysidError, ValueError):
    """A recording cannot be used: its channels, times or values.

    Examples
    --------
    >>> try:
    ...     Channel("u", [0.0, 1.0], [2.0])
    ... except InvalidRecord as error:
    ...     print(str(error).partition(";")[0])
    channel 'u' has times of shape (2,) and values of shape (1,)
    """


class Advice(NamedTuple):
    """What to do: the text, the option of the reader that helps, the text after it."""

    before: str
    option: str = ""
    after: str = ""

    def __str__(self) -> str:
        return "".join(self)


class UnreadableFile(SysidError, ValueError):
    """A file of a recording cannot be used.

    Attributes
    ----------
    detail : str
        What was wrong, where, and what would be right; one line, without the name of the file.
    name : str
        Name of the file; empty if its content was given.
    row : int or None
        Row of a table, from 1; the header of a plain CSV file is row 1.
    column : str or None
        Name of the column of a table.
    byte : int or None
        Position in an MCAP file, from 0.
    advice : Advice or None
        End of the detail: what to do by an option, which each border names in its own way.

    Examples
    --------
    >>> error = UnreadableFile("found '5 V'; write numbers alone", row=3, column="u")
    >>> print(error)
    row 3, column 'u': found '5 V'; write numbers alone
    """

    def __init__(
        self,
        what: str,
        advice: Advice | None = None,
        *,
        row: int | None = None,
        column: str | None = None,
        byte: int | None = None,
    ) -> None:
        self.what, self.advice, self.name = what, advice, ""
        self.row, self.column, self.byte = row, column, byte
        self.detail = f"{self._format_position()}{what}{advice or ''}"
        super().__init__(self.detail)

    def __str__(self) -> str:
        return f"{self.name}: {self.detail}" if self.name else self.detail

    @property
    def pointer(self) -> str:
        """JSON pointer of the fault, such as ``/rows/2/u`` or ``/bytes/90``."""
        if self.byte is not None:
            return f"/bytes/{self.byte}"
        parts = [] if self.row is None else ["rows", str(self.row)]
        parts += [] if self.column is None else [self.column]
        return join_pointer(*parts)

    def _format_position(self) -> str:
        if self.byte is not None:
            return f"at byte {self.byte}: "
        parts = [] if self.row is None else [f"row {self.row}"]
        parts += [] if self.column is None else [f"column {self.column!r}"]
        return f"{', '.join(parts)}: " if parts else ""


class RecordTooShort(SysidError, ValueError):
    """A record is shorter than the model's memory.

    Examples
    --------
    >>> error = RecordTooShort(2.0, 5.0, "the model")
    >>> error.needed
    5.0
    """

    def __init__(
        self, duration: float, needed: float, what: str, why: str = "", cure: str = ""
    ) -> None:
        reason = f" ({why})" if why else ""
        super().__init__(
            f"the record lasts {duration:g} s, but {what} needs more than {needed:g} s{reason}; "
            f"give {cure or 'a longer record'}"
        )
        self.duration, self.needed = duration, needed


class InvalidSettings(SysidError, ValueError):
    """A setting of the search or of the problem is invalid.

    Examples
    --------
    >>> try:
    ...     GeneticAlgorithm(population=1)
    ... except InvalidSettings as error:
    ...     print(error)
    /algorithm/population: found 1; need 4 or more
    """

    def __init__(self, pointer: str, detail: str) -> None:
        super().__init__(f"{pointer}: {detail}")
        self.pointer, self.detail = pointer, detail


class DivergedEverywhere(SysidError, ArithmeticError):
    """No candidate of a search gave a finite simulation.

    Examples
    --------
    >>> issubclass(DivergedEverywhere, ArithmeticError)
    True
    """

    def __init__(self, evaluations: int) -> None:
        super().__init__(
            f"the model diverged for every one of {evaluations} candidates inside the bounds. "
            "Narrow the bounds, use a smaller step, or check the equations and units."
        )
        self.evaluations = evaluations


class NothingIdentifiable(SysidError, ValueError):
    """No free parameter has an effect on the output.

    Examples
    --------
    >>> issubclass(NothingIdentifiable, ValueError)
    True
    """

    def __init__(self, names: Iterable[str]) -> None:
        super().__init__(
            f"none of {', '.join(names)} has an effect on the output in these data. Check the "
            "inputs: an input that is always zero excites nothing."
        )


class UnknownParameter(SysidError, KeyError):
    """A result has no parameter of that name.

    Examples
    --------
    >>> print(UnknownParameter("k", ("K", "T")))
    there is no parameter 'k'; known are K, T
    """

    def __init__(self, name: object, valid: Iterable[str]) -> None:
        hint = f"; the names are {', '.join(valid)}"
        if isinstance(name, str):
            hint = suggest_name(name, valid)
        self.message = f"there is no parameter {name!r}{hint}"
        super().__init__(self.message)

    def __str__(self) -> str:
        return self.message


class UnreadableResult(SysidError, ValueError):
    """A file of a result or of an identified model cannot be used.

    Examples
    --------
    >>> try:
    ...     load_identified("gone.json")
    ... except UnreadableResult as error:
    ...     print(error)
    gone.json: it cannot be read: No such file or directory
    """

    def __init__(self, path: object, detail: str) -> None:
        super().__init__(f"{path}: {detail}")


class UnwritableFile(SysidError):
    """A file cannot be written; what was there before is whole.

    Examples
    --------
    >>> print(UnwritableFile("found.json", "the disk is full"))
    found.json: it cannot be written: the disk is full
    """

    def __init__(self, path: object, detail: str) -> None:
        super().__init__(f"{path}: it cannot be written: {detail}")


class MissingLibrary(SysidError, ImportError):
    """A call needs a library that is not installed.

    Examples
    --------
    >>> issubclass(MissingLibrary, ImportError)
    True
    """

    def __init__(self, call: str, library: str) -> None:
        super().__init__(
            f"{call} needs {library}, which is not installed. Install it with "
            "pip install 'lagid[notebook]'"
        )


def suggest_name(name: str, valid: Iterable[str]) -> str:
    """Suggest valid names for an unknown one: the nearest, else the first ones."""
    names = sorted(valid)
    close = get_close_matches(name, names, n=1)
    if close:
        return f"; did you mean {close[0]!r}?"
    left = len(names) - _MAX_NAMES
    rest = f", and {left} more" if left > 0 else ""
    return f"; known are {', '.join(names[:_MAX_NAMES])}{rest}" if names else ""


def join_pointer(*parts: str | int) -> str:
    """Join fields and list indices to a JSON pointer (RFC 6901)."""
    return "".join("/" + str(part).replace("~", "~0").replace("/", "~1") for part in parts)


def split_pointer(pointer: str) -> list[str]:
    """Split a JSON pointer into the parts that `join_pointer` joined, as text."""
    return [part.replace("~1", "/").replace("~0", "~") for part in pointer.split("/")[1:]]
