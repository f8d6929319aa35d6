"""Pack the points of a history and the lines of a migration log: many of them form one row.

A run writes each point once. When it continues from a checkpoint, it computes the same points
again, bit for bit, and may write some of them twice, in another part. So a part is identified by
its content, and a reader of the parts takes each number once.
"""

import struct
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from hashlib import blake2b
from itertools import groupby
from operator import attrgetter
from typing import Any, NamedTuple

PHASES = ("start", "genetic", "sequence", "migration", "refinement")
"""Origins of a point. Rows store the index in this list: append only."""

_HEAD = "<IIIQdB"  # island, number, generation, evaluations, rms, phase
_MIGRANT = struct.Struct("<IIIId")  # number, epoch, source, destination, fitness
_NUMBER_OF = {phase: number for number, phase in enumerate(PHASES)}
_get_run_id, _get_rms = attrgetter("run_id"), attrgetter("rms")
_get_generation, _get_evaluations = attrgetter("generation"), attrgetter("evaluations")


class HistoryPoint(NamedTuple):
    """An improved champion of an island; `number` counts them on the island from 0."""

    run_id: str
    island: int
    number: int
    generation: int
    evaluations: int
    rms: float
    phase: str
    parameters: Sequence[float]


class MigrantPoint(NamedTuple):
    """One migrant of a run; `number` counts them from 0."""

    run_id: str
    number: int
    epoch: int
    source: int
    destination: int
    fitness: float


def pack_history(points: Iterable[HistoryPoint]) -> Iterator[dict[str, Any]]:
    """Pack consecutive points of each run into one row of `run_history`."""
    for run, group in groupby(points, _get_run_id):
        part = list(group)
        count = len(part[0].parameters)
        pack = _make_point_struct(count).pack
        data = b"".join(
            [
                pack(
                    point.island,
                    point.number,
                    point.generation,
                    point.evaluations,
                    point.rms,
                    _NUMBER_OF[point.phase],
                    *point.parameters,
                )
                for point in part
            ]
        )
        yield {
            "run_id": run,
            "digest": _hash_part(data),
            "n_parameters": count,
            "generation": int(max(map(_get_generation, part))),
            "evaluations": int(max(map(_get_evaluations, part))),
            "rms": float(min(map(_get_rms, part))),
            "points": data,
        }


def pack_migrants(points: Iterable[MigrantPoint]) -> Iterator[dict[str, Any]]:
    """Pack consecutive migrants of each run into one row of `migrations_log`."""
    for run, group in groupby(points, _get_run_id):
        data = b"".join([_MIGRANT.pack(*migrant[1:]) for migrant in group])
        yield {"run_id": run, "digest": _hash_part(data), "migrants": data}


def unpack_history(run: str, parts: Iterable[tuple[bytes, int]]) -> list[HistoryPoint]:
    """Unpack the points of one run, island by island.

    Parameters
    ----------
    parts : iterable of (points, n_parameters)
        From the rows of the run, in any order.
    """
    points: dict[tuple[int, int], HistoryPoint] = {}
    for data, count in parts:
        for values in _make_point_struct(count).iter_unpack(data):
            island, number, generation, evaluations, rms, phase = values[:6]
            points[island, number] = HistoryPoint(
                run, island, number, generation, evaluations, rms, PHASES[phase], list(values[6:])
            )
    return [points[position] for position in sorted(points)]


def unpack_migrants(run: str, parts: Iterable[bytes]) -> list[MigrantPoint]:
    """Unpack the migrants of one run, in order."""
    migrants = {
        values[0]: MigrantPoint(run, *values)
        for data in parts
        for values in _MIGRANT.iter_unpack(data)
    }
    return [migrants[number] for number in sorted(migrants)]


@lru_cache(maxsize=64)
def _make_point_struct(n_parameters: int) -> struct.Struct:
    return struct.Struct(f"{_HEAD}{n_parameters}d")


def _hash_part(data: bytes) -> int:
    return int.from_bytes(blake2b(data, digest_size=8).digest(), "big", signed=True)
