"""Runs tell their error against the records without noise; jobs their floor and what was reused."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

JSON = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")


def upgrade() -> None:
    """Add the columns."""
    op.add_column("runs", sa.Column("rms_noise_free", sa.Double(), nullable=True))
    op.add_column("jobs", sa.Column("n_reused", sa.Integer(), nullable=False, server_default="0"))
    op.add_column("jobs", sa.Column("floors", JSON, nullable=True))


def downgrade() -> None:
    """Drop them."""
    op.drop_column("jobs", "floors")
    op.drop_column("jobs", "n_reused")
    op.drop_column("runs", "rms_noise_free")
