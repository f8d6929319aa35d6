"""Errors of reading uploaded files.

* ServiceError (service.core.errors)
    - InvalidRequest
        - InvalidUpload      a file that cannot be used, with row and column, or byte
"""

from typing import NamedTuple

from service.core.errors import FieldError, InvalidRequest
from sysid.core.errors import join_pointer


class Advice(NamedTuple):
    """What to do: the text, the option of the reader that helps, the text after it."""

    before: str
    option: str = ""
    after: str = ""

    def __str__(self) -> str:
        return "".join(self)


GIVE_PERIOD = Advice("give the sampling period with ", "sample_time", ".")


class InvalidUpload(InvalidRequest, ValueError):
    """An uploaded file cannot be used.

    Attributes
    ----------
    detail : str
        What was wrong, where, and what would be right; one line.
    row : int or None
        Row of a CSV file, from 1; the header is row 1.
    column : str or None
        Name of the column of a CSV file.
    byte : int or None
        Position in an MCAP file, from 0.
    advice : Advice or None
        End of the detail: what to do by an option, which each border names in its own way.
    """

    kind, title = "invalid-upload", "The file cannot be used"

    def __init__(
        self,
        what: str,
        advice: Advice | None = None,
        *,
        row: int | None = None,
        column: str | None = None,
        byte: int | None = None,
    ) -> None:
        detail = _format_place(row, column, byte) + what + str(advice or "")
        option = None if advice is None else advice.option or None
        super().__init__((FieldError(_build_pointer(row, column, byte), detail, option=option),))
        self.detail = detail
        self.args = (detail,)
        self.what, self.advice = what, advice
        self.row, self.column, self.byte = row, column, byte


def build_period_error(period: object) -> InvalidUpload:
    """Return the error of a sampling period that is none."""
    text = f" is {period!r}; need a positive number of seconds"
    return InvalidUpload("", Advice("", "sample_time", text))


def _format_place(row: int | None, column: str | None, byte: int | None) -> str:
    if byte is not None:
        return f"at byte {byte}: "
    parts = [] if row is None else [f"row {row}"]
    parts += [] if column is None else [f"column {column!r}"]
    return f"{', '.join(parts)}: " if parts else ""


def _build_pointer(row: int | None, column: str | None, byte: int | None) -> str:
    if byte is not None:
        return f"/bytes/{byte}"
    parts = [] if row is None else ["rows", str(row)]
    parts += [] if column is None else [column]
    return join_pointer(*parts)
