"""Runs that were accepted as references, with their history."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Make the table."""
    op.create_table(
        "accepted_references",
        sa.Column("project_id", sa.String(), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("run_id", sa.String(), nullable=False),
        sa.Column("accepted_by", sa.String(), nullable=True),
        sa.Column("note", sa.String(), nullable=True),
        sa.Column("accepted_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["project_id"], ["projects.id"], name="fk_accepted_references_project_id"
        ),
        sa.ForeignKeyConstraint(["run_id"], ["runs.id"], name="fk_accepted_references_run_id"),
        sa.PrimaryKeyConstraint("project_id", "name", "number", name="pk_accepted_references"),
    )


def downgrade() -> None:
    """Drop it."""
    op.drop_table("accepted_references")
