"""Outcome of jobs for their lists: fit, verdict and warnings of the run that stands for each."""

from collections.abc import Mapping, Sequence

from sqlalchemy.orm import Session

from service.core.bodies.job_fields import DATASETS_PATH
from service.jobs.job_schemas import OutcomeOut
from service.repositories.outcome_rows import read_outcome_rows
from service.storage.tables import Job

_PARTS = ("verdict", "warnings")


def read_outcomes(session: Session, jobs: Sequence[Job]) -> Mapping[str, OutcomeOut]:
    """Read the outcome of each job that has a result, by its identifier.

    It is that of the only run, or of the best one by RMS. The runs of a batch see different
    recordings, so none of them stands for all, and a batch has no outcome.
    """
    alike = [job for job in jobs if not is_batch(job.spec)]
    return {
        row.job: OutcomeOut(
            run=row.run,
            cell=row.cell,
            labels=row.labels,
            fit_estimation=row.fit_estimation,
            fit_validation=row.fit_validation,
            trust=row.parts["verdict"]["trust"],
            verdict=row.parts["verdict"]["text"],
            warnings=len(row.parts["warnings"]),
        )
        for row in read_outcome_rows(session, alike, _PARTS)
    }


def is_batch(spec: Mapping[str, object]) -> bool:
    """Test whether the runs of a job see different recordings."""
    sweep = spec["sweep"]
    assert isinstance(sweep, Mapping)
    return any(str(axis["path"]).startswith(DATASETS_PATH) for axis in sweep["axes"])
