"""Results of the runs of a pack: rows that a database takes as they are.

A worker packs them, and the dispatcher hands them to the database. Nothing is done for each run in
the dispatcher. PostgreSQL gets blocks of its binary COPY format, SQLite gets tuples. Workers import
this module, so it knows no SQLAlchemy.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

Dialect = Literal["sqlite", "postgresql"]
ColumnKind = Literal[
    "text", "json", "jsonb", "boolean", "double precision", "integer", "bigint", "bytea"
]
Row = tuple[Any, ...]


class RowLayout(NamedTuple):
    """Columns of packed rows of one table, in order, with their types on PostgreSQL."""

    table: str
    columns: Mapping[str, ColumnKind]

    def build_row(self, values: Mapping[str, Any]) -> Row:
        """Build a row from the values of all columns by name."""
        return tuple(map(values.__getitem__, self.columns))


SIGNALS_COLUMNS: Mapping[str, ColumnKind] = {
    "signals_sha256": "text",
    "signals_start": "bigint",
    "signals_size": "bigint",
}
"""Where the fitted signals of a run are: the object, and the place in it."""


RESULT_ROWS = RowLayout(
    "runs",
    {
        "id": "text",
        "spec_hash": "text",
        "valid": "boolean",
        "best_rms": "double precision",
        "rms_noise_free": "double precision",
        "fit_estimation": "double precision",
        "fit_validation": "double precision",
        "evaluations": "bigint",
        "generations": "integer",
        "seconds": "double precision",
        "estimates": "jsonb",
        "result": "json",
        **SIGNALS_COLUMNS,
    },
)
"""What a run that succeeded has; `service.queue.reuse` copies the same columns."""
HISTORY_ROWS = RowLayout(
    "run_history",
    {
        "run_id": "text",
        "digest": "bigint",
        "n_parameters": "integer",
        "generation": "integer",
        "evaluations": "bigint",
        "rms": "double precision",
        "points": "bytea",
    },
)
MIGRANT_ROWS = RowLayout(
    "migrations_log", {"run_id": "text", "digest": "bigint", "migrants": "bytea"}
)
LAYOUTS = (RESULT_ROWS, HISTORY_ROWS, MIGRANT_ROWS)

PackedRows = list[Row] | bytes
"""Rows of one table: tuples for SQLite, a block of a binary COPY for PostgreSQL."""


@dataclass(frozen=True, slots=True, eq=False)
class PackedResults:
    """Successful runs of one pack, ready to be written.

    Attributes
    ----------
    runs : tuple of str
        Identifiers of the runs.
    evaluations, generations, best_rms : int, int, float or None
        Of all runs: the sum, the largest number and the smallest RMS.
    estimates : dict
        Estimates of each run by name, where later runs start from them.
    rows : tuple
        Packed rows of each of `LAYOUTS`.
    signals : bytes
        Fitted signals of the runs, one object; empty if none are kept.
    signals_sha256 : str or None
        Name of that object.
    """

    runs: tuple[str, ...]
    evaluations: int
    generations: int
    best_rms: float | None
    estimates: dict[str, dict[str, float]]
    rows: tuple[PackedRows, ...]
    signals: bytes = b""
    signals_sha256: str | None = None


def extract_estimates(result: Mapping[str, Any]) -> dict[str, Any]:
    """Extract the column `estimates` from a result document: values and standard errors."""
    return {
        parameter["name"]: {"value": parameter["value"], "stderr": parameter["stderr"]}
        for parameter in result["parameters"]
    }


def pack_rows(rows: Sequence[Row], layout: RowLayout, dialect: Dialect) -> PackedRows:
    """Pack rows of plain values: JSON as text, numbers as `int` and `float`."""
    if dialect == "sqlite":
        return list(rows)
    encoders = [_ENCODERS[kind] for kind in layout.columns.values()]
    head = struct.pack("!h", len(encoders))
    blocks: list[bytes] = []
    for row in rows:
        blocks.append(head)
        for value, encode in zip(row, encoders, strict=True):
            blocks.append(_NULL if value is None else encode(value))
    return b"".join(blocks)


COPY_HEAD = b"PGCOPY\n\xff\r\n\0" + bytes(8)
COPY_END = struct.pack("!h", -1)
"""What comes before and after the blocks of a binary COPY."""

_NULL = struct.pack("!i", -1)
_pack_double, _pack_integer = struct.Struct("!id").pack, struct.Struct("!ii").pack
_pack_bigint, _pack_size = struct.Struct("!iq").pack, struct.Struct("!i").pack


def _encode_text(value: str) -> bytes:
    data = value.encode()
    return _pack_size(len(data)) + data


def _encode_jsonb(value: str) -> bytes:
    data = value.encode()
    return _pack_size(len(data) + 1) + b"\1" + data  # the version of the format


def _encode_bytes(value: bytes) -> bytes:
    return _pack_size(len(value)) + value


_ENCODERS: Mapping[ColumnKind, Callable[[Any], bytes]] = {
    "text": _encode_text,
    "json": _encode_text,
    "jsonb": _encode_jsonb,
    "boolean": lambda value: b"\0\0\0\1" + (b"\1" if value else b"\0"),
    "double precision": lambda value: _pack_double(8, value),
    "integer": lambda value: _pack_integer(4, value),
    "bigint": lambda value: _pack_bigint(8, value),
    "bytea": _encode_bytes,
}
