"""Runs are found by the hash of their specification."""

from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

NAME = "ix_runs_project_id_spec_hash"


def upgrade() -> None:
    """Make the index."""
    op.create_index(NAME, "runs", ["project_id", "spec_hash"])


def downgrade() -> None:
    """Drop it."""
    op.drop_index(NAME, "runs")
