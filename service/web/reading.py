"""From stored rows to what figures are made of."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from math import inf, nan
from typing import Any

from sqlalchemy.orm import Session

from service.experiments import parameters_of_job
from service.rms_units import Body, model_of, unit_of
from service.storage.runs import RunRepository
from service.storage.tables import Job, Run
from service.sweeps import body_of
from service.web.evidence import Improvement, RunEvidence, SoughtParameter
from sysid.models.parameters import Parameter, Scale, override

__all__ = ["Body", "evidence_of", "fitness_of", "model_of", "run_body", "sought_parameters",
           "unit_of"]  # fmt: skip


def run_body(job: Job, run: Run) -> dict[str, Any]:
    """The body of one run: the job's, with the values of the run's cell."""
    return body_of(job.spec, run.cell)


def fitness_of(body: Body) -> str:
    """What the search minimises, as figures of it call it: with soft-l1 it is not J."""
    robust = (body.get("loss") or {}).get("kind") == "soft-l1"
    return "soft-l1 loss, as RMS" if robust else "RMS"


def sought_parameters(session: Session, run: Run, body: Body) -> list[SoughtParameter]:
    """The free parameters in the order of the history's columns.

    The result names them once the run has ended; until then the model and the request do.
    """
    model = model_of(body)
    everything = parameters_of_job(session, model, body) if model else ()
    known = override(everything, body.get("parameters", {}))
    result = (run.result or {}).get("parameters")
    if result:
        scales = {one.name: one.scale for one in known}
        return [
            _estimated(one, scales) for one in result if one.get("status") not in ("fixed", "tied")
        ]
    if model is not None and model.rule is not None:
        return []  # which of the candidates are sought is told with the result
    return [_sought(one) for one in known if one.is_free]


def evidence_of(session: Session, job: Job, run: Run) -> RunEvidence:
    """All that is known of a run's search and result."""
    body = run_body(job, run)
    runs = RunRepository(session)
    history = _islands(runs.history(run.id))
    algorithm = body.get("algorithm", {})
    result = run.result or {}
    return RunEvidence(
        id=run.id, unit=unit_of(session, body), fitness=fitness_of(body),
        generations=run.generations or (job.generation if job.n_runs == 1 else 0),
        evaluations=run.evaluations, history=history,
        parameters=_covering(sought_parameters(session, run, body), history),
        epoch=int((algorithm.get("migration") or {}).get("every", 0)),
        migrations=sorted({one.epoch for one in runs.migrations(run.id)}),
        islands=[(_or(one.get("champion_rms"), inf), one.get("refined_rms"))
                 for one in result.get("islands", ())],
        correlation=_correlation(result.get("correlation")),
    )  # fmt: skip


def _correlation(stored: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    if not stored:
        return None
    rows = [[_or(value, nan) for value in row] for row in stored["matrix"]]
    return {"names": stored["names"], "matrix": rows}


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def _islands(rows: Sequence[Any]) -> list[list[Improvement]]:
    found: list[list[Improvement]] = []
    for island, points in groupby(rows, key=lambda row: row.island):
        while len(found) < island:  # an island that has not told anything yet
            found.append([])
        found.append([
            Improvement(p.generation, p.evaluations, p.rms, p.phase, tuple(p.parameters))
            for p in points
        ])  # fmt: skip
    return found


def _covering(
    known: list[SoughtParameter], history: Sequence[Sequence[Improvement]]
) -> list[SoughtParameter]:
    """As many parameters as the history has columns, whatever the model says today."""
    points = [point for island in history for point in island]
    if not points:
        return known
    width = len(points[0].parameters)
    unknown = range(min(len(known), width), width)
    return known[:width] + [_by_its_values(points, column) for column in unknown]


def _by_its_values(points: Sequence[Improvement], column: int) -> SoughtParameter:
    values = [point.parameters[column] for point in points]
    lower, upper = min(values), max(values)
    return SoughtParameter(f"parameter {column + 1}", "1", lower, upper if upper > lower
                           else lower + 1.0)  # fmt: skip


def _estimated(one: Mapping[str, Any], scales: Mapping[str, Scale]) -> SoughtParameter:
    return SoughtParameter(
        one["name"], one.get("unit", "1"), one["lower"], one["upper"],
        scales.get(one["name"], "linear"), value=one["value"], stderr=one.get("stderr"),
    )  # fmt: skip


def _sought(parameter: Parameter) -> SoughtParameter:
    return SoughtParameter(
        parameter.name, parameter.unit, parameter.lower, parameter.upper, parameter.scale
    )
