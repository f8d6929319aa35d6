"""Claims and looks at the queue read indexes only: a row may hold a specification of megabytes."""

from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

QUEUE, OWNED = "ix_jobs_queue", "ix_jobs_owned"
FORMER = {
    "ix_jobs_state_priority_id": ["state", "priority", "id"],
    "ix_jobs_lease_owner_state": ["lease_owner", "state"],
}


def upgrade() -> None:
    """Make the wider indexes and drop those that they contain."""
    op.create_index(QUEUE, "jobs", ["state", "priority", "id", "project_id", "n_runs"])
    op.create_index(OWNED, "jobs", ["lease_owner", "state", "cancel_requested", "id"])
    for name in FORMER:
        op.drop_index(name, "jobs")


def downgrade() -> None:
    """Make the former ones again."""
    for name, columns in FORMER.items():
        op.create_index(name, "jobs", columns)
    for name in (QUEUE, OWNED):
        op.drop_index(name, "jobs")
