"""Serialisation of a run's state for SQL: data of known fields, types and shapes, never code.

A checkpoint is a header, then compressed: one line of JSON and the bytes of the arrays in a fixed
order. What does not fit the fields of this program is refused, because compiled code trusts shapes.
"""

import json
import zlib
from collections.abc import Iterator
from importlib.metadata import version
from math import prod
from typing import Any

import numpy as np

from service.core.errors import ServiceError
from sysid.islands.run_state import RunState
from sysid.search.archive import make_archive
from sysid.search.island import Island, to_improvements
from sysid.search.state import (
    COLUMN_EVALUATIONS,
    COLUMN_GENERATION,
    COLUMN_PHASE,
    COLUMN_RMS,
    COLUMN_VALUES,
    PHASE_NAMES,
    SEARCH_RECORD,
    Migrant,
)

_HEADER = f"lagid {version('lagid')} run state 1\n".encode()
_MAX_BYTES = 2**30
"""Largest state in bytes, so that a damaged checkpoint cannot take all memory."""
_FLOATS, _WORDS = np.dtype(np.float64), np.dtype(np.uint32)
_ARRAYS: tuple[tuple[str, np.dtype[Any]], ...] = (
    ("chromosomes", _WORDS),
    ("fitness", _FLOATS),
    ("search", SEARCH_RECORD),
    ("point", _FLOATS),
    ("archive", _FLOATS),
    ("history", _FLOATS),
)
"""Arrays of an island in their order; rows of `history` are those that compiled code writes."""


class UnreadableCheckpoint(ServiceError):
    """A checkpoint is damaged, or another version wrote it."""


def pack_state(state: RunState) -> bytes:
    """Serialise the state, with a header for the version that can read it."""
    islands = [_list_arrays(island) for island in state.islands]
    migrations = np.array(state.migrations, _FLOATS).reshape(-1, len(Migrant._fields))
    description = {
        "seed": int(state.seed),
        "generation": int(state.generation),
        "epoch": int(state.epoch),
        "seconds": float(state.seconds),
        "has_ended": bool(state.has_ended),
        "is_warm": bool(state.is_warm),
        "migrations": len(migrations),
        "search": SEARCH_RECORD.names,
        "islands": [
            {
                "index": int(island.index),
                "seed": int(island.seed),
                "shapes": [array.shape for array in arrays],
            }
            for island, arrays in zip(state.islands, islands, strict=True)
        ],
    }
    blocks = [json.dumps(description).encode(), b"\n", migrations.tobytes()]
    blocks += [array.tobytes() for arrays in islands for array in arrays]
    return _HEADER + zlib.compress(b"".join(blocks), level=1)


def unpack_state(data: bytes) -> RunState:
    """Restore the state.

    Raises
    ------
    UnreadableCheckpoint
        If it is damaged, or another version wrote it.
    """
    if not data.startswith(_HEADER):
        raise UnreadableCheckpoint("another version of lagid wrote it")
    try:
        return _read_state(_decompress(data[len(_HEADER) :]))
    except (
        ValueError,
        KeyError,
        TypeError,
        IndexError,
        ArithmeticError,
        RecursionError,
        zlib.error,
    ) as error:
        raise UnreadableCheckpoint(f"it is damaged ({error})") from error


def _list_arrays(island: Island) -> list[Any]:
    rows = np.zeros((len(island.history), COLUMN_VALUES + island.point.size))
    for row, improvement in zip(rows, island.history, strict=True):
        row[COLUMN_GENERATION], row[COLUMN_EVALUATIONS] = improvement[:2]
        row[COLUMN_RMS] = improvement.rms
        row[COLUMN_PHASE] = PHASE_NAMES.index(improvement.phase)
        row[COLUMN_VALUES:] = improvement.parameters
    arrays = (*(getattr(island, name) for name, _ in _ARRAYS[:-1]), rows)
    return [np.asarray(array, kind) for array, (_, kind) in zip(arrays, _ARRAYS, strict=True)]


def _decompress(data: bytes) -> bytes:
    reader = zlib.decompressobj()
    content = reader.decompress(data, _MAX_BYTES)
    if not reader.eof:
        raise ValueError("its end is missing, or it is too long")
    return content


def _read_state(content: bytes) -> RunState:
    line, _, rest = content.partition(b"\n")
    description = json.loads(line)
    if tuple(description["search"]) != SEARCH_RECORD.names:
        raise ValueError("its search has other fields")
    reader = _ArrayReader(rest)
    width = len(Migrant._fields)
    migrations = reader.read_array(_FLOATS, (int(description["migrations"]), width))
    islands = tuple(_read_islands(description["islands"], reader))
    reader.check_end()
    return RunState(
        seed=int(description["seed"]),
        islands=islands,
        generation=int(description["generation"]),
        epoch=int(description["epoch"]),
        migrations=tuple(
            Migrant(int(epoch), int(source), int(destination), fitness)
            for epoch, source, destination, fitness in migrations.tolist()
        ),
        seconds=float(description["seconds"]),
        has_ended=bool(description["has_ended"]),
        is_warm=bool(description["is_warm"]),
    )


def _read_islands(descriptions: list[Any], reader: "_ArrayReader") -> Iterator[Island]:
    for number, one in enumerate(descriptions):
        if one["index"] != number:
            raise ValueError(f"island {one['index']} is in the place of island {number}")
        shapes = [tuple(map(int, shape)) for shape in one["shapes"]]
        _check_shapes(shapes)
        arrays = {
            name: reader.read_array(kind, shape)
            for (name, kind), shape in zip(_ARRAYS, shapes, strict=True)
        }
        history = tuple(to_improvements(arrays.pop("history")))
        yield Island(number, int(one["seed"]), **arrays, history=history)


def _check_shapes(shapes: list[tuple[int, ...]]) -> None:
    """Check that the arrays of an island have one population P and one number of parameters D."""
    size, n = shapes[0]
    rows = shapes[-1][0]
    expected = [(size, n), (size,), (), (n,), make_archive(n).shape, (rows, COLUMN_VALUES + n)]
    if shapes != expected:
        raise ValueError(f"its arrays have shapes {shapes}")


class _ArrayReader:
    """Reads arrays of known type and shape from bytes, one after the other."""

    def __init__(self, content: bytes) -> None:
        self._content, self._position = content, 0

    def read_array(self, kind: np.dtype[Any], shape: tuple[int, ...]) -> Any:
        """Read the next array as a copy that can be changed."""
        if min(shape, default=0) < 0:
            raise ValueError(f"an array has shape {shape}")
        flat = np.frombuffer(self._content, kind, prod(shape), self._position)
        self._position += flat.nbytes
        return flat.reshape(shape).copy()

    def check_end(self) -> None:
        """Check that nothing is left."""
        if self._position != len(self._content):
            raise ValueError("it is longer than its arrays")
