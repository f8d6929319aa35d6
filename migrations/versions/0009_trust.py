"""Trust in the result of each ended job, by which lists are sorted."""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

INDEX = "ix_jobs_sorted"
BEFORE = ["project_id", "deleted_at", "fit_estimation", "best_rms", "name", "state", "id"]
SORTED = ["project_id", "deleted_at", "fit_estimation", "best_rms", "name", "state", "trust", "id"]
jobs = sa.table(
    "jobs", *map(sa.column, ("id", "finished_at", "best_rms", "fit_estimation", "trust"))
)
runs = sa.table(
    "runs",
    *map(sa.column, ("job_id", "number", "best_rms", "fit_estimation", "cell")),
    sa.column("result", sa.JSON),
)


def upgrade() -> None:
    op.add_column("jobs", sa.Column("trust", sa.String()))
    op.execute(_write_best_runs())
    op.drop_index(INDEX, "jobs")
    op.create_index(INDEX, "jobs", SORTED)


def _write_best_runs() -> sa.Update:
    """Write RMS, fit and trust of the best run into each ended job, as the program does at its end.

    Revision 0008 left jobs without a fit that were cancelled, or whose dispatcher stopped. A batch
    has neither fit nor trust. A result without a stored verdict has no trust. SQLAlchemy writes the
    path in JSON, because `->` needs SQLite 3.38.
    """
    is_batch = sa.cast(runs.c.cell, sa.Text).like('%"/datasets%')
    trust = runs.c.result[("verdict", "trust")].as_string()
    return (
        sa.update(jobs)
        .where(jobs.c.finished_at.is_not(None))
        .values(
            best_rms=sa.func.coalesce(_select_of_best_run(runs.c.best_rms), jobs.c.best_rms),
            fit_estimation=_select_of_best_run(sa.case((~is_batch, runs.c.fit_estimation))),
            trust=_select_of_best_run(sa.case((~is_batch, trust))),
        )
    )


def _select_of_best_run(value: sa.ColumnElement[Any]) -> sa.ScalarSelect[Any]:
    query = sa.select(value).where(runs.c.job_id == jobs.c.id, runs.c.best_rms.is_not(None))
    ordered = query.order_by(runs.c.best_rms, runs.c.number)
    return ordered.limit(1).correlate(jobs).scalar_subquery()


def downgrade() -> None:
    op.drop_index(INDEX, "jobs")
    op.create_index(INDEX, "jobs", BEFORE)
    op.drop_column("jobs", "trust")
