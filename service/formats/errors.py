"""Errors of reading uploaded files.

* ServiceError (service.core.errors)
    - InvalidRequest
        - InvalidUpload      a file that cannot be used, with row and column, or byte
"""

from service.core.errors import FieldError, InvalidRequest
from sysid.core.errors import join_pointer


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
    """

    kind, title = "invalid-upload", "The file cannot be used"

    def __init__(
        self,
        what: str,
        *,
        row: int | None = None,
        column: str | None = None,
        byte: int | None = None,
    ) -> None:
        detail = _format_place(row, column, byte) + what
        super().__init__((FieldError(_build_pointer(row, column, byte), detail),))
        self.detail = detail
        self.args = (detail,)
        self.what, self.row, self.column, self.byte = what, row, column, byte


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
