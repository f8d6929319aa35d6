"""Evaluations of a job that no longer count for the day, because it was resumed a day later."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

LARGE = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    column = sa.Column("evaluations_before", LARGE, nullable=False, server_default="0")
    op.add_column("jobs", column)


def downgrade() -> None:
    op.drop_column("jobs", "evaluations_before")
