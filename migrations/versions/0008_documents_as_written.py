"""Models and specifications keep the order of their keys on PostgreSQL, as they do on SQLite.

A search draws parameters in the order in which the model names them; JSONB sorts keys. What was
stored before stays in the order that it has.
"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

COLUMNS = (("models", "document"), ("jobs", "spec"))


def upgrade() -> None:
    """JSON instead of JSONB; SQLite has JSON text already."""
    _alter(sa.JSON(), "json")


def downgrade() -> None:
    """JSONB again."""
    _alter(postgresql.JSONB(), "jsonb")


def _alter(kind: sa.types.TypeEngine[object], name: str) -> None:
    if op.get_bind().dialect.name != "postgresql":
        return
    for table, column in COLUMNS:
        op.alter_column(table, column, type_=kind, postgresql_using=f"{column}::{name}")
