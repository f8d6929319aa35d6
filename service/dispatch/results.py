"""Conversion of an identification to the rows to store: pure functions."""

import math
from collections.abc import Iterator, Mapping

from service.core.documents import to_finite
from service.core.states import JobState
from service.queue.run_writes import RunOutcome
from service.repositories.history import HistoryPoint, MigrantPoint
from service.runs.result import to_result_document
from sysid.search.state import Improvement, Migrant
from workers.protocol import RunConclusion


def to_run_outcome(run: str, concluded: RunConclusion, seconds: float) -> RunOutcome:
    """Build the row of a run that succeeded, without its signals."""
    identification, rms_noise_free = concluded.identification, to_finite(concluded.rms_noise_free)
    return RunOutcome(
        run_id=run,
        state=JobState.SUCCEEDED,
        result={**to_result_document(identification, seconds), "rms_noise_free": rms_noise_free},
        valid=identification.valid,
        best_rms=to_finite(identification.rms),
        rms_noise_free=rms_noise_free,
        fit_estimation=to_finite(identification.fit_percent),
        fit_validation=to_finite(identification.fit_percent_validation),
        evaluations=identification.evaluations,
        generations=identification.generations,
        seconds=seconds,
    )


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
