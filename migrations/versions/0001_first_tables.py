"""The first tables, and the default project.

Types are spelt out here and not taken from `service.storage`: what a migration did must not
change when the program does.
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

LARGE = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
JSON = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
MOMENT = sa.DateTime(timezone=True)
STATE = sa.String(16)
TABLES = (
    "projects", "api_keys", "datasets", "lineage_edges", "models", "jobs", "runs", "run_history",
    "migrations_log", "checkpoints", "events", "idempotency_keys", "dispatchers",
)  # fmt: skip


def upgrade() -> None:
    _owners()
    _data()
    _jobs()
    _runs()
    _evidence()
    _service()
    _default_project()


def downgrade() -> None:
    for name in reversed(TABLES):
        op.drop_table(name)


def _need(name: str, kind: Any = sa.String) -> sa.Column[Any]:
    return sa.Column(name, kind, nullable=False)


def _may(name: str, kind: Any = sa.String) -> sa.Column[Any]:
    return sa.Column(name, kind, nullable=True)


def _id() -> sa.Column[Any]:
    return _need("id")


def _create(name: str, *columns: Any, key: tuple[str, ...] = ("id",), **options: Any) -> None:
    op.create_table(name, *columns, sa.PrimaryKeyConstraint(*key, name=f"pk_{name}"), **options)


def _refer(table: str, column: str, target: str) -> sa.ForeignKeyConstraint:
    return sa.ForeignKeyConstraint([column], [f"{target}.id"], name=f"fk_{table}_{column}")


def _index(table: str, *columns: str) -> None:
    op.create_index(f"ix_{table}_{'_'.join(columns)}", table, list(columns))


def _owners() -> None:
    _create("projects", _id(), _need("name"), _need("created_at", MOMENT))
    _create(
        "api_keys", _id(), _need("project_id"), _need("name"), _need("digest"),
        _need("scopes", JSON), _need("created_at", MOMENT), _may("expires_at", MOMENT),
        _may("revoked_at", MOMENT), _refer("api_keys", "project_id", "projects"),
        sa.UniqueConstraint("digest", name="uq_api_keys_digest"),
    )  # fmt: skip
    _index("api_keys", "project_id")


def _data() -> None:
    _create(
        "datasets", _id(), _need("project_id"), _need("name"), _need("kind"), _need("sha256"),
        _need("source_key"), _need("size_bytes", LARGE), _need("n_channels", sa.Integer),
        _need("n_samples", LARGE), _need("duration", sa.Double), _may("sample_time", sa.Double),
        _need("channels", JSON), _need("details", JSON), _need("created_at", MOMENT),
        _may("deleted_at", MOMENT), _refer("datasets", "project_id", "projects"),
    )  # fmt: skip
    _index("datasets", "project_id", "id")
    _index("datasets", "sha256")
    alive = sa.text("deleted_at IS NULL")
    op.create_index(
        "uq_datasets_project_id_source_key", "datasets", ["project_id", "source_key"],
        unique=True, sqlite_where=alive, postgresql_where=alive,
    )  # fmt: skip
    _create(
        "lineage_edges", _need("child"), _need("parent"), _need("relation"), _need("project_id"),
        _need("created_at", MOMENT), _refer("lineage_edges", "project_id", "projects"),
        key=("child", "parent", "relation"),
    )  # fmt: skip
    _index("lineage_edges", "parent")
    _create(
        "models", _id(), _need("project_id"), _need("name"), _need("version", sa.Integer),
        _need("document", JSON), _need("document_hash"), _need("created_at", MOMENT),
        _may("deleted_at", MOMENT), _refer("models", "project_id", "projects"),
        sa.UniqueConstraint(
            "project_id", "name", "version", name="uq_models_project_id_name_version"
        ),
    )  # fmt: skip


def _jobs() -> None:
    _create(
        "jobs", _id(), _need("project_id"), _need("name"), _need("state", STATE),
        _need("spec", JSON), _need("priority", sa.Integer), _need("max_attempts", sa.Integer),
        _need("attempt", sa.Integer), _need("lost_leases", sa.Integer), _may("lease_owner"),
        _may("lease_until", MOMENT), _need("cancel_requested", sa.Boolean),
        _need("n_runs", sa.Integer), _need("n_done", sa.Integer), _need("n_failed", sa.Integer),
        _may("best_rms", sa.Double), _need("evaluations", LARGE),
        _need("generation", sa.Integer), _may("seconds_left", sa.Double), _may("error"),
        _need("created_at", MOMENT), _may("started_at", MOMENT), _may("finished_at", MOMENT),
        _may("deleted_at", MOMENT), _refer("jobs", "project_id", "projects"),
    )  # fmt: skip
    _index("jobs", "project_id", "id")
    _index("jobs", "state", "priority", "id")
    _index("jobs", "lease_owner", "state")


def _runs() -> None:
    _create(
        "runs", _id(), _need("project_id"), _need("job_id"), _need("number", sa.Integer),
        _need("cell", JSON), _need("labels", JSON), _may("spec_hash"), _may("method"),
        _may("seed", LARGE), _may("sigma", sa.Double), _need("state", STATE),
        _need("attempt", sa.Integer), _may("valid", sa.Boolean), _may("best_rms", sa.Double),
        _may("fit_estimation", sa.Double), _may("fit_validation", sa.Double),
        _need("evaluations", LARGE), _need("generations", sa.Integer),
        _may("seconds", sa.Double), _may("estimates", JSON), _may("result", JSON),
        _may("signals_sha256"), _may("error"), _need("created_at", MOMENT),
        _may("started_at", MOMENT), _may("finished_at", MOMENT),
        _refer("runs", "project_id", "projects"), _refer("runs", "job_id", "jobs"),
        sa.UniqueConstraint("job_id", "number", name="uq_runs_job_id_number"),
    )  # fmt: skip
    _index("runs", "job_id", "state", "number")
    _index("runs", "project_id", "id")
    _index("runs", "signals_sha256")


def _evidence() -> None:
    _create(
        "run_history", _need("run_id"), _need("island", sa.Integer), _need("number", sa.Integer),
        _need("generation", sa.Integer), _need("evaluations", LARGE), _need("rms", sa.Double),
        _need("phase"), _need("parameters", JSON), _refer("run_history", "run_id", "runs"),
        key=("run_id", "island", "number"),
    )  # fmt: skip
    _create(
        "migrations_log", _need("run_id"), _need("number", sa.Integer),
        _need("epoch", sa.Integer), _need("source", sa.Integer),
        _need("destination", sa.Integer), _need("fitness", sa.Double),
        _refer("migrations_log", "run_id", "runs"), key=("run_id", "number"),
    )  # fmt: skip
    _create(
        "checkpoints", _need("run_id"), _need("job_id"), _need("attempt", sa.Integer),
        _need("evaluations", LARGE), _need("state", sa.LargeBinary),
        _need("created_at", MOMENT), _refer("checkpoints", "run_id", "runs"),
        _refer("checkpoints", "job_id", "jobs"), key=("run_id",),
    )  # fmt: skip
    _index("checkpoints", "job_id")


def _service() -> None:
    _create(
        "events", _need("id", LARGE), _need("job_id"), _need("kind"), _need("data", JSON),
        _need("created_at", MOMENT), _refer("events", "job_id", "jobs"),
        sqlite_autoincrement=True,
    )  # fmt: skip
    _index("events", "job_id", "id")
    _create(
        "idempotency_keys", _need("project_id"), _need("key"), _need("request_hash"),
        _need("job_id"), _need("created_at", MOMENT),
        _refer("idempotency_keys", "project_id", "projects"),
        _refer("idempotency_keys", "job_id", "jobs"), key=("project_id", "key"),
    )  # fmt: skip
    _create(
        "dispatchers", _need("owner"), _need("details", JSON), _need("started_at", MOMENT),
        _need("seen_at", MOMENT), key=("owner",),
    )  # fmt: skip


def _default_project() -> None:
    projects = sa.table(
        "projects", sa.column("id"), sa.column("name"), sa.column("created_at", MOMENT)
    )
    row = {"id": "proj_default", "name": "default", "created_at": datetime.now(UTC)}
    op.bulk_insert(projects, [row])
