"""Points of a run's history and lines of its migration log, packed: a part of many is one row.

A run writes each point once; where it goes on from a checkpoint it finds the same points again, bit
for bit, and may write some of them a second time, in another part. So a part is known by its
content, and who reads the parts of a run takes each number once.
"""

import struct
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from hashlib import blake2b
from itertools import groupby
from operator import attrgetter
from typing import Any, NamedTuple

PHASES = ("start", "genetic", "sequence", "migration", "refinement")
"""What a point may come from. Rows hold the place in this list: add at its end only."""

_HEAD = "<IIIQdB"  # island, number, generation, evaluations, rms, phase
_MIGRANT = struct.Struct("<IIIId")  # number, epoch, source, destination, fitness
_NUMBER_OF = {phase: number for number, phase in enumerate(PHASES)}
_get_run_id = attrgetter("run_id")


class HistoryPoint(NamedTuple):
    """A better champion of an island; `number` counts them on the island from 0."""

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
    """Rows of `run_history`: one for the points of each run that follow each other."""
    for run, mine in groupby(points, _get_run_id):
        part = list(mine)
        count = len(part[0].parameters)
        pack = _make_point_struct(count).pack
        data = b"".join(
            [
                pack(
                    one.island,
                    one.number,
                    one.generation,
                    one.evaluations,
                    one.rms,
                    _NUMBER_OF[one.phase],
                    *one.parameters,
                )
                for one in part
            ]
        )
        yield {
            "run_id": run,
            "digest": _hash_part(data),
            "n_parameters": count,
            "generation": max([int(one.generation) for one in part]),
            "evaluations": max([int(one.evaluations) for one in part]),
            "rms": min([float(one.rms) for one in part]),
            "points": data,
        }


def pack_migrants(points: Iterable[MigrantPoint]) -> Iterator[dict[str, Any]]:
    """Rows of `migrations_log`: one for the migrants of each run that follow each other."""
    for run, mine in groupby(points, _get_run_id):
        data = b"".join([_MIGRANT.pack(*one[1:]) for one in mine])
        yield {"run_id": run, "digest": _hash_part(data), "migrants": data}


def unpack_history(run: str, parts: Iterable[tuple[bytes, int]]) -> list[HistoryPoint]:
    """The points of one run, island by island.

    Parameters
    ----------
    parts : iterable of (points, n_parameters)
        Of its rows, in any order.
    """
    found: dict[tuple[int, int], HistoryPoint] = {}
    for data, count in parts:
        for values in _make_point_struct(count).iter_unpack(data):
            island, number, generation, evaluations, rms, phase = values[:6]
            found[island, number] = HistoryPoint(
                run, island, number, generation, evaluations, rms, PHASES[phase], list(values[6:])
            )
    return [found[place] for place in sorted(found)]


def unpack_migrants(run: str, parts: Iterable[bytes]) -> list[MigrantPoint]:
    """The migrants of one run, in their order."""
    found = {
        values[0]: MigrantPoint(run, *values)
        for data in parts
        for values in _MIGRANT.iter_unpack(data)
    }
    return [found[number] for number in sorted(found)]


@lru_cache(maxsize=64)
def _make_point_struct(n_parameters: int) -> struct.Struct:
    return struct.Struct(f"{_HEAD}{n_parameters}d")


def _hash_part(data: bytes) -> int:
    return int.from_bytes(blake2b(data, digest_size=8).digest(), "big", signed=True)
