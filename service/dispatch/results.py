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
    found, without = concluded.identification, to_finite(concluded.rms_noise_free)
    return RunOutcome(
        run_id=run,
        state=JobState.SUCCEEDED,
        result={**to_result_document(found, seconds), "rms_noise_free": without},
        valid=found.valid,
        best_rms=to_finite(found.rms),
        rms_noise_free=without,
        fit_estimation=to_finite(found.fit_percent),
        fit_validation=to_finite(found.fit_percent_validation),
        evaluations=found.evaluations,
        generations=found.generations,
        seconds=seconds,
    )


def to_history_points(
    run: str, history: tuple[tuple[Improvement, ...], ...], written: Mapping[int, int]
) -> Iterator[HistoryPoint]:
    """Iterate over improvements beyond the first `written` of each island."""
    for island, improvements in enumerate(history):
        first = written.get(island, 0)
        for number, one in enumerate(improvements[first:], start=first):
            if math.isfinite(one.rms):
                yield HistoryPoint(
                    run,
                    island,
                    number,
                    one.generation,
                    one.evaluations,
                    one.rms,
                    one.phase,
                    one.parameters,
                )


def to_migrant_points(
    run: str, migrants: tuple[Migrant, ...], written: int
) -> Iterator[MigrantPoint]:
    """Iterate over migrants beyond the first `written`."""
    for number, one in enumerate(migrants[written:], start=written):
        if math.isfinite(one.fitness):
            yield MigrantPoint(run, number, *one)
