"""Parcels: dispatchers lease ranges of a job's runs, and tell how many cores they want.

Each open job becomes one parcel, under its lease if it has one. On the way back a job with several
parcels waits, and its runs after the first one that was never created are deleted, with what
belongs to them: the earlier version creates runs in their order only. It computes them again.
"""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

OPEN = "state IN ('queued', 'running')"
OPEN_COLUMNS = ["state", "priority", "id", "project_id", "n_runs"]
INDEXES = (
    ("ix_jobs_open", "jobs", [*OPEN_COLUMNS, "cancel_requested", "n_done"], OPEN),
    ("ix_parcels_waiting", "parcels", ["job_id", "first"], "lease_owner IS NULL"),
    (
        "ix_parcels_owned",
        "parcels",
        ["lease_owner", "job_id", "attempt"],
        "lease_owner IS NOT NULL",
    ),
)
EARLIER_INDEXES = (
    ("ix_jobs_open", "jobs", [*OPEN_COLUMNS, "n_done"], OPEN),
    (
        "ix_jobs_owned",
        "jobs",
        ["lease_owner", "state", "cancel_requested", "id"],
        "lease_owner IS NOT NULL",
    ),
)
LARGE_VALUES = (("runs", "result"), ("run_history", "points"), ("migrations_log", "migrants"))
TIME = sa.DateTime(timezone=True)
LARGE = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

# The runs of unfinished jobs beyond the first number that is missing.
BEYOND_A_GAP = """
    SELECT id FROM (
        SELECT runs.id, number,
            row_number() OVER (PARTITION BY job_id ORDER BY number) - 1 AS place
        FROM runs JOIN jobs ON jobs.id = runs.job_id WHERE jobs.state <> 'succeeded'
    ) AS numbered WHERE number <> place
"""


def upgrade() -> None:
    op.create_table(
        "parcels",
        sa.Column("job_id", sa.String(), nullable=False),
        sa.Column("first", sa.Integer(), nullable=False),
        sa.Column("stop", sa.Integer(), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("lost_leases", sa.Integer(), nullable=False),
        sa.Column("lease_owner", sa.String(), nullable=True),
        sa.Column("lease_until", TIME, nullable=True),
        sa.Column("n_ended", sa.Integer(), nullable=False),
        sa.Column("evaluations", LARGE, nullable=False),
        sa.PrimaryKeyConstraint("job_id", "first", name="pk_parcels"),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name="fk_parcels_job_id"),
    )
    op.execute(
        "INSERT INTO parcels SELECT id, 0, n_runs, attempt, lost_leases, lease_owner, lease_until, "
        f"n_done - n_done_at_claim, evaluations FROM jobs WHERE {OPEN}"
    )
    for name, table, _, _ in EARLIER_INDEXES:
        op.drop_index(name, table)
    for name in ("lease_owner", "lease_until", "n_done_at_claim"):
        op.drop_column("jobs", name)
    _create_indexes(INDEXES)
    op.add_column(
        "dispatchers",
        sa.Column("wanted_cores", sa.Integer(), nullable=False, server_default="0"),
    )

    if op.get_bind().dialect.name == "postgresql":
        _avoid_slow_compression()


def _avoid_slow_compression() -> None:
    """Store new results by LZ4 where the server has it, else as they are.

    PostgreSQL's own compression took a third of the CPU that a short run costs the database.
    """
    has_lz4 = sa.text(
        "SELECT count(*) FROM pg_settings "
        "WHERE name = 'default_toast_compression' AND 'lz4' = ANY (enumvals)"
    )
    fast = "COMPRESSION lz4" if op.get_bind().scalar(has_lz4) else "STORAGE EXTERNAL"
    for table, column in LARGE_VALUES:
        op.execute(f"ALTER TABLE {table} ALTER COLUMN {column} SET {fast}")


def downgrade() -> None:
    if op.get_bind().dialect.name == "postgresql":
        for table, column in LARGE_VALUES:
            op.execute(f"ALTER TABLE {table} ALTER COLUMN {column} SET STORAGE EXTENDED")
    op.drop_column("dispatchers", "wanted_cores")
    for name, table, _, _ in INDEXES:
        op.drop_index(name, table)
    op.add_column("jobs", sa.Column("lease_owner", sa.String(), nullable=True))
    op.add_column("jobs", sa.Column("lease_until", TIME, nullable=True))
    op.add_column(
        "jobs", sa.Column("n_done_at_claim", sa.Integer(), nullable=False, server_default="0")
    )
    whole = "parcels.job_id = jobs.id AND parcels.first = 0 AND parcels.stop = jobs.n_runs"
    for column, value in (
        ("lease_owner", "lease_owner"),
        ("lease_until", "lease_until"),
        ("n_done_at_claim", "jobs.n_done - n_ended"),
    ):
        op.execute(
            f"UPDATE jobs SET {column} = (SELECT {value} FROM parcels WHERE {whole}) "
            f"WHERE EXISTS (SELECT 1 FROM parcels WHERE {whole})"
        )
    op.drop_table("parcels")
    op.execute(
        "UPDATE runs SET state = 'queued' WHERE state = 'running' AND job_id IN "
        "(SELECT id FROM jobs WHERE state = 'running' AND lease_owner IS NULL)"
    )
    op.execute("UPDATE jobs SET state = 'queued' WHERE state = 'running' AND lease_owner IS NULL")
    _delete_beyond_gaps()
    _create_indexes(EARLIER_INDEXES)


def _delete_beyond_gaps() -> None:
    connection = op.get_bind()
    op.execute(f"CREATE TEMPORARY TABLE beyond AS {BEYOND_A_GAP}")
    jobs = "SELECT DISTINCT job_id FROM runs WHERE id IN (SELECT id FROM beyond)"
    touched = list(connection.execute(sa.text(jobs)).scalars())
    for table in ("checkpoints", "run_history", "migrations_log", "accepted_references"):
        op.execute(f"DELETE FROM {table} WHERE run_id IN (SELECT id FROM beyond)")
    op.execute(f"DELETE FROM job_summaries WHERE job_id IN ({jobs})")
    op.execute("DELETE FROM runs WHERE id IN (SELECT id FROM beyond)")
    op.execute("DROP TABLE beyond")
    ended = "(SELECT count(*) FROM runs WHERE job_id = jobs.id AND state = '{}')"
    succeeded, failed = ended.format("succeeded"), ended.format("failed")
    for job in touched:
        for change in (
            f"n_failed = {failed} WHERE {OPEN} AND",  # that of an ended job is not counted by runs
            f"n_done = {succeeded} + n_failed WHERE",
            "n_done_at_claim = n_done WHERE",
        ):
            connection.execute(sa.text(f"UPDATE jobs SET {change} id = :job"), {"job": job})


def _create_indexes(indexes: tuple[tuple[str, str, list[str], str], ...]) -> None:
    for name, table, columns, condition in indexes:
        where = sa.text(condition)
        op.create_index(name, table, columns, sqlite_where=where, postgresql_where=where)
