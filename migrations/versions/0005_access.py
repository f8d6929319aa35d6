"""Limits of projects, use of keys, sessions of browsers, and the audit log."""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

LARGE = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
TIME = sa.DateTime(timezone=True)
LIMITS = (
    ("max_open_jobs", sa.Integer()),
    ("max_open_runs", sa.Integer()),
    ("max_stored_bytes", LARGE),
    ("max_daily_evaluations", LARGE),
)


def upgrade() -> None:
    for name, kind in LIMITS:
        op.add_column("projects", sa.Column(name, kind, nullable=True))
    op.create_index("ix_projects_name", "projects", ["name"], unique=True)
    op.add_column("api_keys", sa.Column("last_used_at", TIME, nullable=True))
    op.create_table(
        "web_sessions",
        _column("digest"),
        _column("key_id"),
        _column("created_at", TIME),
        _column("expires_at", TIME),
        sa.PrimaryKeyConstraint("digest", name="pk_web_sessions"),
        sa.ForeignKeyConstraint(["key_id"], ["api_keys.id"], name="fk_web_sessions_key_id"),
    )
    op.create_index("ix_web_sessions_key_id", "web_sessions", ["key_id"])
    op.create_table(
        "audit_log",
        _column("id", LARGE),
        _column("project_id"),
        _column("at", TIME),
        _column("actor"),
        _column("action"),
        _column("object_id", nullable=True),
        _column("request_id", nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_audit_log"),
        sa.ForeignKeyConstraint(["project_id"], ["projects.id"], name="fk_audit_log_project_id"),
        sqlite_autoincrement=True,
    )
    op.create_index("ix_audit_log_project_id_id", "audit_log", ["project_id", "id"])
    has_ended = sa.text("finished_at IS NOT NULL")
    op.create_index(
        "ix_jobs_finished",
        "jobs",
        ["project_id", "finished_at", "evaluations"],
        sqlite_where=has_ended,
        postgresql_where=has_ended,
    )


def downgrade() -> None:
    op.drop_index("ix_jobs_finished", "jobs")
    op.drop_table("audit_log")
    op.drop_table("web_sessions")
    op.drop_column("api_keys", "last_used_at")
    op.drop_index("ix_projects_name", "projects")
    for name, _ in LIMITS:
        op.drop_column("projects", name)


def _column(name: str, kind: Any = sa.String, *, nullable: bool = False) -> sa.Column[Any]:
    return sa.Column(name, kind, nullable=nullable)
