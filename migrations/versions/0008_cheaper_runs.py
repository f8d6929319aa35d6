"""Results as JSON that is stored as it comes, and fewer indexes for each run to enter.

Types are spelled out here: a migration must not change with the program. A table of a million runs
is written anew on PostgreSQL, which takes minutes.
"""

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

UNUSED = ("ix_runs_project_id_id", ["project_id", "id"])
PARTIAL = (
    ("ix_runs_project_id_spec_hash", ["project_id", "spec_hash"], "spec_hash IS NOT NULL"),
    ("ix_runs_signals_sha256", ["signals_sha256"], "signals_sha256 IS NOT NULL"),
)
INLINE_BYTES = 8160
"""The most that PostgreSQL allows: a history of up to this size is in the row."""


def upgrade() -> None:
    op.drop_index(UNUSED[0], "runs")
    for name, columns, condition in PARTIAL:
        op.drop_index(name, "runs")
        where = sa.text(condition)
        op.create_index(name, "runs", columns, sqlite_where=where, postgresql_where=where)
    if op.get_bind().dialect.name == "postgresql":
        _change_result(sa.JSON(), "json")
        op.execute(f"ALTER TABLE run_history SET (toast_tuple_target = {INLINE_BYTES})")


def downgrade() -> None:
    if op.get_bind().dialect.name == "postgresql":
        op.execute("ALTER TABLE run_history RESET (toast_tuple_target)")
        _change_result(postgresql.JSONB(), "jsonb")
    for name, columns, _ in PARTIAL:
        op.drop_index(name, "runs")
        op.create_index(name, "runs", columns)
    op.create_index(UNUSED[0], "runs", UNUSED[1])


def _change_result(kind: Any, name: str) -> None:
    """Change the type of `runs.result`; its compression, which a new type resets, stays."""
    query = (
        "SELECT attstorage::text, attcompression::text FROM pg_attribute "
        "WHERE attrelid = 'runs'::regclass AND attname = 'result'"
    )
    storage, compression = op.get_bind().execute(sa.text(query)).one()
    op.alter_column("runs", "result", type_=kind, postgresql_using=f"result::{name}")
    if compression == "l":
        op.execute("ALTER TABLE runs ALTER COLUMN result SET COMPRESSION lz4")
    elif storage == "e":
        op.execute("ALTER TABLE runs ALTER COLUMN result SET STORAGE EXTERNAL")
