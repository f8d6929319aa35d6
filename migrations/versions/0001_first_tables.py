"""Create the first tables and the default project.

Types are spelled out here, not imported from `service.storage`: a migration must not change with
the program.
"""

from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0001"
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
    "api_keys",
    "datasets",
    "lineage_edges",
    "models",
    "jobs",
    "runs",
    "run_history",
    "migrations_log",
    "checkpoints",
    "events",
    "accepted_references",
    "idempotency_keys",
    "dispatchers",
)


def upgrade() -> None:
    _create_owners()
    _create_data()
    _create_jobs()
    _create_runs()
    _create_evidence()
    _create_service()
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


def _index(table: str, *columns: str, name: str | None = None) -> None:
    op.create_index(name or f"ix_{table}_{'_'.join(columns)}", table, list(columns))


def _create_owners() -> None:
    _create("projects", _column("id"), _column("name"), _column("created_at", TIME))
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
        _refer("api_keys", "project_id", "projects"),
        sa.UniqueConstraint("digest", name="uq_api_keys_digest"),
    )
    _index("api_keys", "project_id")


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
        _column("created_at", TIME),
        _column("deleted_at", TIME, nullable=True),
        _refer("datasets", "project_id", "projects"),
    )
    _index("datasets", "project_id", "id")
    _index("datasets", "sha256")
    is_present = sa.text("deleted_at IS NULL")
    op.create_index(
        "uq_datasets_project_id_source_key",
        "datasets",
        ["project_id", "source_key"],
        unique=True,
        sqlite_where=is_present,
        postgresql_where=is_present,
    )
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
    _index("lineage_edges", "parent")
    _create(
        "models",
        _column("id"),
        _column("project_id"),
        _column("name"),
        _column("version", INTEGER),
        _column("document", ORDERED_JSON),
        _column("document_hash"),
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
        _column("lease_owner", nullable=True),
        _column("lease_until", TIME, nullable=True),
        _column("cancel_requested", sa.Boolean),
        _column("n_runs", INTEGER),
        _column("n_done", INTEGER),
        _column("n_failed", INTEGER),
        _column("n_reused", INTEGER),
        _column("best_rms", REAL, nullable=True),
        _column("evaluations", LARGE),
        _column("generation", INTEGER),
        _column("seconds_left", REAL, nullable=True),
        _column("error", nullable=True),
        _column("floors", JSON, nullable=True),
        _column("created_at", TIME),
        _column("started_at", TIME, nullable=True),
        _column("finished_at", TIME, nullable=True),
        _column("deleted_at", TIME, nullable=True),
        _refer("jobs", "project_id", "projects"),
    )
    _index("jobs", "project_id", "id")
    # Claims and polls of the queue read only these: a row may have megabytes.
    _index("jobs", "state", "priority", "id", "project_id", "n_runs", name="ix_jobs_queue")
    _index("jobs", "lease_owner", "state", "cancel_requested", "id", name="ix_jobs_owned")


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
        _column("method", nullable=True),
        _column("seed", LARGE, nullable=True),
        _column("sigma", REAL, nullable=True),
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
        _column("result", JSON, nullable=True),
        _column("signals_sha256", nullable=True),
        _column("signals_start", LARGE, nullable=True),
        _column("signals_size", LARGE, nullable=True),
        _column("error", nullable=True),
        _column("created_at", TIME),
        _column("started_at", TIME, nullable=True),
        _column("finished_at", TIME, nullable=True),
        _refer("runs", "project_id", "projects"),
        _refer("runs", "job_id", "jobs"),
        sa.UniqueConstraint("job_id", "number", name="uq_runs_job_id_number"),
    )
    _index("runs", "job_id", "state", "number")
    _index("runs", "project_id", "id")
    _index("runs", "project_id", "spec_hash")
    _index("runs", "signals_sha256")


def _create_evidence() -> None:
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
    _create(
        "accepted_references",
        _column("project_id"),
        _column("name"),
        _column("number", INTEGER),
        _column("run_id"),
        _column("accepted_by", nullable=True),
        _column("note", nullable=True),
        _column("accepted_at", TIME),
        _refer("accepted_references", "project_id", "projects"),
        _refer("accepted_references", "run_id", "runs"),
        key=("project_id", "name", "number"),
    )
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
    _create(
        "dispatchers",
        _column("owner"),
        _column("details", JSON),
        _column("started_at", TIME),
        _column("seen_at", TIME),
        key=("owner",),
    )


def _insert_default_project() -> None:
    projects = sa.table(
        "projects", sa.column("id"), sa.column("name"), sa.column("created_at", TIME)
    )
    row = {"id": "proj_default", "name": "default", "created_at": datetime.now(UTC)}
    op.bulk_insert(projects, [row])
