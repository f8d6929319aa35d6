"""Conversion of the history of a run to the points to store: pure functions."""

import math
from collections.abc import Iterator, Mapping

from service.repositories.history_rows import HistoryPoint, MigrantPoint
from sysid.search.state import Improvement, Migrant


def to_history_points(
    run: str, history: tuple[tuple[Improvement, ...], ...], written: Mapping[int, int]
) -> Iterator[HistoryPoint]:
    """Iterate over improvements beyond the first `written` of each island."""
    for island, improvements in enumerate(history):
        first = written.get(island, 0)
        for number, improvement in enumerate(improvements[first:], start=first):
            if math.isfinite(improvement.rms):
                yield HistoryPoint(
                    run,
                    island,
                    number,
                    improvement.generation,
                    improvement.evaluations,
                    improvement.rms,
                    improvement.phase,
                    improvement.parameters,
                )


def to_migrant_points(
    run: str, migrants: tuple[Migrant, ...], written: int
) -> Iterator[MigrantPoint]:
    """Iterate over migrants beyond the first `written`."""
    for number, migrant in enumerate(migrants[written:], start=written):
        if math.isfinite(migrant.fitness):
            yield MigrantPoint(run, number, *migrant)
