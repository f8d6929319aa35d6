"""Create the first tables and the default project.

Types are spelled out here, not imported from `service.storage`: a migration must not change with
the program.
"""

from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "v1"
down_revision = None
branch_labels = None
depends_on = None

INTEGER = sa.Integer()
LARGE = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
REAL: sa.Double[Any] = sa.Double()
BINARY = sa.LargeBinary()
JSON = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
ORDERED_JSON = sa.JSON()  # preserves the order of keys, unlike JSONB
TIME = sa.DateTime(timezone=True)
STATE = sa.String(16)
TABLES = (
    "projects",
    "requested_work",
    "api_keys",
    "web_sessions",
    "audit_log",
    "datasets",
    "lineage_edges",
    "models",
    "jobs",
    "parcels",
    "runs",
    "job_summaries",
    "run_history",
    "migrations_log",
    "checkpoints",
    "events",
    "accepted_references",
    "search_terms",
    "idempotency_keys",
    "dispatchers",
)
LARGE_VALUES = (("runs", "result"), ("run_history", "points"), ("migrations_log", "migrants"))
INLINE_BYTES = 8160
"""The most that PostgreSQL allows: a history of up to this size is in the row."""


def upgrade() -> None:
    _create_owners()
    _create_data()
    _create_jobs()
    _create_runs()
    _create_evidence()
    _create_service()
    if op.get_bind().dialect.name == "postgresql":
        _avoid_slow_compression()
    _insert_default_project()


def downgrade() -> None:
    for name in reversed(TABLES):
        op.drop_table(name)


def _column(name: str, kind: Any = sa.String, *, nullable: bool = False) -> sa.Column[Any]:
    return sa.Column(name, kind, nullable=nullable)


def _create(name: str, *columns: Any, key: tuple[str, ...] = ("id",), **options: Any) -> None:
    op.create_table(name, *columns, sa.PrimaryKeyConstraint(*key, name=f"pk_{name}"), **options)


def _refer(table: str, column: str, target: str) -> sa.ForeignKeyConstraint:
    return sa.ForeignKeyConstraint([column], [f"{target}.id"], name=f"fk_{table}_{column}")


def _index(
    table: str,
    *columns: str,
    where: str | None = None,
    name: str | None = None,
    unique: bool = False,
) -> None:
    """Create an index over all rows, or over those that meet a condition."""
    condition = None if where is None else sa.text(where)
    op.create_index(
        name or f"ix_{table}_{'_'.join(columns)}",
        table,
        list(columns),
        unique=unique,
        sqlite_where=condition,
        postgresql_where=condition,
    )


def _create_owners() -> None:
    _create(
        "projects",
        _column("id"),
        _column("name"),
        _column("keep_days", REAL, nullable=True),
        _column("created_at", TIME),
        _column("max_open_jobs", INTEGER, nullable=True),
        _column("max_open_runs", INTEGER, nullable=True),
        _column("max_stored_bytes", LARGE, nullable=True),
        _column("max_daily_evaluations", LARGE, nullable=True),
    )
    _index("projects", "name", unique=True)
    _create(
        "requested_work",
        _column("project_id"),
        _column("hour", TIME),
        _column("evaluations", LARGE),
        _refer("requested_work", "project_id", "projects"),
        key=("project_id", "hour"),
    )
    _create(
        "api_keys",
        _column("id"),
        _column("project_id"),
        _column("name"),
        _column("digest"),
        _column("scopes", JSON),
        _column("created_at", TIME),
        _column("expires_at", TIME, nullable=True),
        _column("revoked_at", TIME, nullable=True),
        _column("last_used_at", TIME, nullable=True),
        _refer("api_keys", "project_id", "projects"),
        sa.UniqueConstraint("digest", name="uq_api_keys_digest"),
    )
    _index("api_keys", "project_id")
    _create(
        "web_sessions",
        _column("digest"),
        _column("key_id"),
        _column("created_at", TIME),
        _column("expires_at", TIME),
        _refer("web_sessions", "key_id", "api_keys"),
        key=("digest",),
    )
    _index("web_sessions", "key_id")
    _create(
        "audit_log",
        _column("id", LARGE),
        _column("project_id"),
        _column("at", TIME),
        _column("actor"),
        _column("action"),
        _column("object_id"),
        _column("request_id", nullable=True),
        _refer("audit_log", "project_id", "projects"),
        sqlite_autoincrement=True,
    )
    _index("audit_log", "project_id", "id")


def _create_data() -> None:
    _create(
        "datasets",
        _column("id"),
        _column("project_id"),
        _column("name"),
        _column("kind"),
        _column("sha256"),
        _column("source_key"),
        _column("size_bytes", LARGE),
        _column("n_channels", INTEGER),
        _column("n_samples", LARGE),
        _column("duration", REAL),
        _column("sample_time", REAL, nullable=True),
        _column("channels", JSON),
        _column("details", JSON),
        _column("note", nullable=True),
        _column("tags", JSON, nullable=True),
        _column("created_at", TIME),
        _column("deleted_at", TIME, nullable=True),
        _refer("datasets", "project_id", "projects"),
    )
    _index("datasets", "project_id", "id")
    _index("datasets", "sha256")
    is_present = "deleted_at IS NULL"
    _index(
        "datasets",
        "project_id",
        "source_key",
        where=is_present,
        name="uq_datasets_project_id_source_key",
        unique=True,
    )
    _index("datasets", "project_id", "id", "name", where=is_present, name="ix_datasets_named")
    _create(
        "lineage_edges",
        _column("child"),
        _column("parent"),
        _column("relation"),
        _column("project_id"),
        _column("created_at", TIME),
        _refer("lineage_edges", "project_id", "projects"),
        key=("child", "parent", "relation"),
    )
    _index("lineage_edges", "parent", "child")
    _create(
        "models",
        _column("id"),
        _column("project_id"),
        _column("name"),
        _column("version", INTEGER),
        _column("document", ORDERED_JSON),
        _column("document_hash"),
        _column("note", nullable=True),
        _column("tags", JSON, nullable=True),
        _column("created_at", TIME),
        _column("deleted_at", TIME, nullable=True),
        _refer("models", "project_id", "projects"),
        sa.UniqueConstraint(
            "project_id", "name", "version", name="uq_models_project_id_name_version"
        ),
    )


def _create_jobs() -> None:
    _create(
        "jobs",
        _column("id"),
        _column("project_id"),
        _column("name"),
        _column("state", STATE),
        _column("spec", ORDERED_JSON),
        _column("priority", INTEGER),
        _column("max_attempts", INTEGER),
        _column("attempt", INTEGER),
        _column("lost_leases", INTEGER),
        _column("cancel_requested", sa.Boolean),
        _column("n_runs", INTEGER),
        _column("n_done", INTEGER),
        _column("n_failed", INTEGER),
        _column("n_reused", INTEGER),
        _column("best_rms", REAL, nullable=True),
        _column("fit_estimation", REAL, nullable=True),
        _column("trust", nullable=True),
        _column("evaluations", LARGE),
        _column("evaluations_before", LARGE),
        _column("generation", INTEGER),
        _column("seconds_left", REAL, nullable=True),
        _column("error", nullable=True),
        _column("cramer_rao", JSON, nullable=True),
        _column("version"),
        _column("fingerprint", nullable=True),
        _column("spec_hash"),
        _column("note", nullable=True),
        _column("tags", JSON, nullable=True),
        _column("created_at", TIME),
        _column("started_at", TIME, nullable=True),
        _column("finished_at", TIME, nullable=True),
        _column("deleted_at", TIME, nullable=True),
        _column("purged_at", TIME, nullable=True),
        _refer("jobs", "project_id", "projects"),
    )
    _index_jobs()
    _create(
        "parcels",
        _column("job_id"),
        _column("first", INTEGER),
        _column("stop", INTEGER),
        _column("attempt", INTEGER),
        _column("lost_leases", INTEGER),
        _column("lease_owner", nullable=True),
        _column("lease_until", TIME, nullable=True),
        _column("n_ended", INTEGER),
        _column("evaluations", LARGE),
        _refer("parcels", "job_id", "jobs"),
        key=("job_id", "first"),
    )
    _index("parcels", "job_id", "first", where="lease_owner IS NULL", name="ix_parcels_waiting")
    owned = ("lease_owner", "job_id", "attempt")
    _index("parcels", *owned, where="lease_owner IS NOT NULL", name="ix_parcels_owned")


def _index_jobs() -> None:
    _index("jobs", "project_id", "id")
    is_present = "deleted_at IS NULL"
    _index("jobs", "project_id", "state", "id", where=is_present, name="ix_jobs_by_state")
    # Claims and polls of the queue read only these: a row may have megabytes.
    _index(
        "jobs",
        "state",
        "priority",
        "id",
        "project_id",
        "n_runs",
        "cancel_requested",
        "n_done",
        where="state IN ('queued', 'running')",
        name="ix_jobs_open",
    )
    _index(
        "jobs",
        "project_id",
        "finished_at",
        "evaluations",
        where="finished_at IS NOT NULL",
        name="ix_jobs_finished",
    )
    _index("jobs", "project_id", "id", "name", where=is_present, name="ix_jobs_named")
    _index(
        "jobs",
        "project_id",
        "deleted_at",
        "fit_estimation",
        "best_rms",
        "name",
        "state",
        "trust",
        "id",
        name="ix_jobs_sorted",
    )
    _index(
        "jobs",
        "project_id",
        "finished_at",
        "id",
        where="deleted_at IS NULL AND finished_at IS NOT NULL",
        name="ix_jobs_ended",
    )
    is_deleted = "deleted_at IS NOT NULL AND purged_at IS NULL"
    _index("jobs", "deleted_at", where=is_deleted, name="ix_jobs_deleted")


def _create_runs() -> None:
    _create(
        "runs",
        _column("id"),
        _column("project_id"),
        _column("job_id"),
        _column("number", INTEGER),
        _column("cell", JSON),
        _column("labels", JSON),
        _column("spec_hash", nullable=True),
        _column("method"),
        _column("seed", LARGE),
        _column("sigma", REAL),
        _column("state", STATE),
        _column("attempt", INTEGER),
        _column("kills", INTEGER),
        _column("valid", sa.Boolean, nullable=True),
        _column("best_rms", REAL, nullable=True),
        _column("rms_noise_free", REAL, nullable=True),
        _column("fit_estimation", REAL, nullable=True),
        _column("fit_validation", REAL, nullable=True),
        _column("evaluations", LARGE),
        _column("generations", INTEGER),
        _column("seconds", REAL, nullable=True),
        _column("estimates", JSON, nullable=True),
        _column("result", ORDERED_JSON, nullable=True),
        _column("signals_sha256", nullable=True),
        _column("signals_start", LARGE, nullable=True),
        _column("signals_size", LARGE, nullable=True),
        _column("error", nullable=True),
        _column("note", nullable=True),
        _column("tags", JSON, nullable=True),
        _column("created_at", TIME),
        _column("started_at", TIME, nullable=True),
        _column("finished_at", TIME, nullable=True),
        _column("deleted_at", TIME, nullable=True),
        _refer("runs", "project_id", "projects"),
        _refer("runs", "job_id", "jobs"),
        sa.UniqueConstraint("job_id", "number", name="uq_runs_job_id_number"),
    )
    _index("runs", "job_id", "state", "number")
    _index(
        "runs",
        "job_id",
        "best_rms",
        "number",
        where="best_rms IS NOT NULL",
        name="ix_runs_job_id_best_rms",
    )
    _index("runs", "project_id", "spec_hash", where="spec_hash IS NOT NULL")
    _index("runs", "signals_sha256", where="signals_sha256 IS NOT NULL")


def _create_evidence() -> None:
    _create(
        "job_summaries",
        _column("job_id"),
        _column("attempt", INTEGER),
        _column("document", ORDERED_JSON),
        _column("created_at", TIME),
        _refer("job_summaries", "job_id", "jobs"),
        key=("job_id",),
    )
    _create(
        "run_history",
        _column("run_id"),
        _column("digest", LARGE),
        _column("n_parameters", INTEGER),
        _column("generation", INTEGER),
        _column("evaluations", LARGE),
        _column("rms", REAL),
        _column("points", BINARY),
        _refer("run_history", "run_id", "runs"),
        key=("run_id", "digest"),
    )
    _create(
        "migrations_log",
        _column("run_id"),
        _column("digest", LARGE),
        _column("migrants", BINARY),
        _refer("migrations_log", "run_id", "runs"),
        key=("run_id", "digest"),
    )
    _create(
        "checkpoints",
        _column("run_id"),
        _column("job_id"),
        _column("attempt", INTEGER),
        _column("evaluations", LARGE),
        _column("state", BINARY),
        _column("created_at", TIME),
        _refer("checkpoints", "run_id", "runs"),
        _refer("checkpoints", "job_id", "jobs"),
        key=("run_id",),
    )
    _index("checkpoints", "job_id")


def _create_service() -> None:
    _create(
        "events",
        _column("id", LARGE),
        _column("job_id"),
        _column("kind"),
        _column("data", JSON),
        _column("created_at", TIME),
        _refer("events", "job_id", "jobs"),
        sqlite_autoincrement=True,
    )
    _index("events", "job_id", "id")
    _index("events", "job_id", "id", where="kind <> 'progress'", name="ix_events_told")
    _create(
        "accepted_references",
        _column("project_id"),
        _column("name"),
        _column("number", INTEGER),
        _column("run_id"),
        _column("accepted_by", nullable=True),
        _column("note", nullable=True),
        _column("tags", JSON, nullable=True),
        _column("accepted_at", TIME),
        _refer("accepted_references", "project_id", "projects"),
        _refer("accepted_references", "run_id", "runs"),
        key=("project_id", "name", "number"),
    )
    terms = ("project_id", "kind", "value", "item_id")
    _create(
        "search_terms",
        *map(_column, terms),
        _refer("search_terms", "project_id", "projects"),
        key=terms,
    )
    _index("search_terms", "item_id")
    _create(
        "idempotency_keys",
        _column("project_id"),
        _column("key"),
        _column("request_hash"),
        _column("job_id"),
        _column("created_at", TIME),
        _refer("idempotency_keys", "project_id", "projects"),
        _refer("idempotency_keys", "job_id", "jobs"),
        key=("project_id", "key"),
    )
    _index("idempotency_keys", "job_id")
    _create(
        "dispatchers",
        _column("owner"),
        _column("details", JSON),
        _column("started_at", TIME),
        _column("seen_at", TIME),
        _column("wanted_cores", INTEGER),
        key=("owner",),
    )


def _avoid_slow_compression() -> None:
    """Store results by LZ4 where the server has it, else as they are.

    PostgreSQL's own compression took a third of the CPU that a short run costs the database.
    """
    has_lz4 = sa.text(
        "SELECT count(*) FROM pg_settings "
        "WHERE name = 'default_toast_compression' AND 'lz4' = ANY (enumvals)"
    )
    fast = "COMPRESSION lz4" if op.get_bind().scalar(has_lz4) else "STORAGE EXTERNAL"
    for table, column in LARGE_VALUES:
        op.execute(f"ALTER TABLE {table} ALTER COLUMN {column} SET {fast}")
    op.execute(f"ALTER TABLE run_history SET (toast_tuple_target = {INLINE_BYTES})")


def _insert_default_project() -> None:
    projects = sa.table(
        "projects", sa.column("id"), sa.column("name"), sa.column("created_at", TIME)
    )
    row = {"id": "proj_default", "name": "default", "created_at": datetime.now(UTC)}
    op.bulk_insert(projects, [row])
