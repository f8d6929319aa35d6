"""The tables. Times are UTC, identifiers sort by time, and rows of users name their project."""

from datetime import datetime
from typing import Any

from sqlalchemy import ForeignKey, Index, LargeBinary, MetaData, UniqueConstraint, text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from service.core.states import JobState
from service.storage.columns import (
    Document,
    DocumentType,
    LargeInteger,
    OrderedJsonType,
    TextT,
    UtcDateTime,
    make_state_type,
    utc_now,
)

DEFAULT_PROJECT = "proj_default"

OPEN_CONDITION = "state IN ('queued', 'running')"
"""Condition of the index of open jobs. SQLite uses the index only for queries with this text."""
WAITING_CONDITION = "lease_owner IS NULL"
"""Condition of the index of parcels that no dispatcher holds."""
TOLD_CONDITION = "kind <> 'progress'"
"""Condition of the index of the events that a page lists."""
DELETED_CONDITION = "deleted_at IS NOT NULL AND purged_at IS NULL"
"""Condition of the index of the deleted jobs whose runs are still stored."""


class Base(DeclarativeBase):
    """Base class of the tables."""

    metadata = MetaData(
        naming_convention={  # Alembic can only drop what has a name
            "ix": "ix_%(column_0_N_label)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map = {  # noqa: RUF012 - SQLAlchemy's declaration
        str: TextT,
        datetime: UtcDateTime,
        dict[str, Any]: DocumentType,
        list[Any]: DocumentType,
        JobState: make_state_type(JobState),
    }


def _partial_index(name: str, condition: str, *columns: str, unique: bool = False) -> Index:
    """Declare an index over the rows that meet a condition, on both databases."""
    where = text(condition)
    return Index(name, *columns, unique=unique, sqlite_where=where, postgresql_where=where)


class Project(Base):
    """Owner of everything that a user creates.

    The limits are those of the settings where they are None, or there is none.
    `keep_days` is how long its ended jobs are kept, in days. None: as the settings say.
    """

    __tablename__ = "projects"

    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(unique=True, index=True)
    keep_days: Mapped[float | None]
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    max_open_jobs: Mapped[int | None]
    max_open_runs: Mapped[int | None]
    max_stored_bytes: Mapped[int | None] = mapped_column(LargeInteger)
    max_daily_evaluations: Mapped[int | None] = mapped_column(LargeInteger)


class RequestedWork(Base):
    """Evaluations that a web process made for requests of a project within an hour."""

    __tablename__ = "requested_work"

    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"), primary_key=True)
    hour: Mapped[datetime] = mapped_column(primary_key=True)
    evaluations: Mapped[int] = mapped_column(LargeInteger)


class ApiKey(Base):
    """A key to a project; only the digest of its secret is stored.

    `last_used_at` is at most a minute old.
    """

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(primary_key=True)
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"), index=True)
    name: Mapped[str]
    digest: Mapped[str] = mapped_column(unique=True)
    scopes: Mapped[list[Any]]
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    expires_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]
    last_used_at: Mapped[datetime | None]


class WebSession(Base):
    """A browser that signed in with a key; `digest` is that of the cookie's secret."""

    __tablename__ = "web_sessions"

    digest: Mapped[str] = mapped_column(primary_key=True)
    key_id: Mapped[str] = mapped_column(ForeignKey("api_keys.id"), index=True)
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    expires_at: Mapped[datetime]


class AuditEntry(Base):
    """Who did what: written in the transaction of the change, and never changed."""

    __tablename__ = "audit_log"
    __table_args__ = (
        Index("ix_audit_log_project_id_id", "project_id", "id"),
        {"sqlite_autoincrement": True},  # no number is used twice
    )

    id: Mapped[int] = mapped_column(LargeInteger, primary_key=True)
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    at: Mapped[datetime] = mapped_column(default=utc_now)
    actor: Mapped[str]
    action: Mapped[str]
    object_id: Mapped[str]
    request_id: Mapped[str | None]


class Dataset(Base):
    """A stored recording: a description of its content, and the hash of its object.

    `sha256` names the MCAP object. `source_key` is a hash of the source: the uploaded bytes and how
    they were read, or the derivation. So the same source gives the same dataset. `sample_time` is
    None if a channel is sampled irregularly.
    """

    __tablename__ = "datasets"
    __table_args__ = (
        Index("ix_datasets_project_id_id", "project_id", "id"),
        _partial_index(
            "uq_datasets_project_id_source_key",
            "deleted_at IS NULL",
            "project_id",
            "source_key",
            unique=True,
        ),
        _partial_index("ix_datasets_named", "deleted_at IS NULL", "project_id", "id", "name"),
    )

    id: Mapped[str] = mapped_column(primary_key=True)
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    name: Mapped[str]
    kind: Mapped[str]
    sha256: Mapped[str] = mapped_column(index=True)
    source_key: Mapped[str]
    size_bytes: Mapped[int] = mapped_column(LargeInteger)
    n_channels: Mapped[int]
    n_samples: Mapped[int] = mapped_column(LargeInteger)
    duration: Mapped[float]
    sample_time: Mapped[float | None]
    channels: Mapped[list[Any]]
    details: Mapped[Document]
    note: Mapped[str | None]
    tags: Mapped[list[Any] | None]
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    deleted_at: Mapped[datetime | None]


class LineageEdge(Base):
    """`child` was made from `parent`; the prefix of an identifier tells its kind."""

    __tablename__ = "lineage_edges"
    __table_args__ = (Index("ix_lineage_edges_parent_child", "parent", "child"),)

    child: Mapped[str] = mapped_column(primary_key=True)
    parent: Mapped[str] = mapped_column(primary_key=True)
    relation: Mapped[str] = mapped_column(primary_key=True)
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    created_at: Mapped[datetime] = mapped_column(default=utc_now)


class ModelVersion(Base):
    """One version of a user's model document."""

    __tablename__ = "models"
    __table_args__ = (UniqueConstraint("project_id", "name", "version"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    name: Mapped[str]
    version: Mapped[int]
    document: Mapped[Document] = mapped_column(OrderedJsonType)
    document_hash: Mapped[str]
    note: Mapped[str | None]
    tags: Mapped[list[Any] | None]
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    deleted_at: Mapped[datetime | None]


class Job(Base):
    """A submitted job: one or more runs. While it is open, its `Parcel` rows hold its leases.

    `attempt` counts the claims of its parcels and gives each claim its fencing token. `lost_leases`
    is that of the parcel that was lost last. `evaluations`, `generation` and `seconds_left` are the
    progress over all runs. `best_rms` is the smallest RMS of any run so far. `fit_estimation` is
    the fit (%) of that run once the job has ended, `trust` that of its verdict; a batch has none.
    `n_reused` counts the runs taken over from other jobs. `cramer_rao` is the document that
    `service.dispatch.run_cramer_rao` computes for a job with noise. `evaluations_before` is the
    part of `evaluations` that was made a day or more before the job was resumed: it does not count
    for the limit of a day.

    `version` and `fingerprint` are those of the program that last started the job; until then
    `version` is that of the program that took it. `spec_hash` is the digest of its request.
    `purged_at` is set once the runs of a deleted job are gone.
    """

    __tablename__ = "jobs"
    __table_args__ = (
        Index("ix_jobs_project_id_id", "project_id", "id"),
        _partial_index("ix_jobs_by_state", "deleted_at IS NULL", "project_id", "state", "id"),
        # It holds all columns of jobs that a dispatcher reads to poll and to claim. Ended jobs are
        # not among them, so that their number costs nothing.
        _partial_index(
            "ix_jobs_open",
            OPEN_CONDITION,
            "state",
            "priority",
            "id",
            "project_id",
            "n_runs",
            "cancel_requested",
            "n_done",
        ),
        _partial_index(  # for the evaluations of a day
            "ix_jobs_finished",
            "finished_at IS NOT NULL",
            "project_id",
            "finished_at",
            "evaluations",
        ),
        _partial_index("ix_jobs_named", "deleted_at IS NULL", "project_id", "id", "name"),
        # It holds all columns by which a list is sorted, so that no row is read to sort them all.
        Index(
            "ix_jobs_sorted",
            "project_id",
            "deleted_at",
            "fit_estimation",
            "best_rms",
            "name",
            "state",
            "trust",
            "id",
        ),
        _partial_index(
            "ix_jobs_ended",
            "deleted_at IS NULL AND finished_at IS NOT NULL",
            "project_id",
            "finished_at",
            "id",
        ),
        _partial_index("ix_jobs_deleted", DELETED_CONDITION, "deleted_at"),
    )

    id: Mapped[str] = mapped_column(primary_key=True)
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    name: Mapped[str]
    state: Mapped[JobState] = mapped_column(default=JobState.QUEUED)
    spec: Mapped[Document] = mapped_column(OrderedJsonType)
    priority: Mapped[int] = mapped_column(default=0)
    max_attempts: Mapped[int] = mapped_column(default=3)
    attempt: Mapped[int] = mapped_column(default=0)
    lost_leases: Mapped[int] = mapped_column(default=0)
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    n_runs: Mapped[int]
    n_done: Mapped[int] = mapped_column(default=0)
    n_failed: Mapped[int] = mapped_column(default=0)
    n_reused: Mapped[int] = mapped_column(default=0)
    best_rms: Mapped[float | None]
    fit_estimation: Mapped[float | None]
    trust: Mapped[str | None]
    evaluations: Mapped[int] = mapped_column(LargeInteger, default=0)
    evaluations_before: Mapped[int] = mapped_column(LargeInteger, default=0)
    generation: Mapped[int] = mapped_column(default=0)
    seconds_left: Mapped[float | None]
    error: Mapped[str | None]
    cramer_rao: Mapped[Document | None]
    version: Mapped[str]
    fingerprint: Mapped[str | None]
    spec_hash: Mapped[str]
    note: Mapped[str | None]
    tags: Mapped[list[Any] | None]
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    deleted_at: Mapped[datetime | None]
    purged_at: Mapped[datetime | None]


class Parcel(Base):
    """A part of an open job: its unfinished runs with numbers from `first` to before `stop`.

    It is what a dispatcher leases, and it waits while `lease_owner` is None. `attempt` is the
    fencing token of its last claim, 0 before the first. `lost_leases` counts the dispatchers that
    stopped without progress; at the job's `max_attempts` of them the job fails. `n_ended` counts
    the runs that ended since the claim. `evaluations` is what its runs add to those of the job. The
    row is deleted when its runs have ended, the last one with the end of the job.
    """

    __tablename__ = "parcels"
    __table_args__ = (
        _partial_index("ix_parcels_waiting", WAITING_CONDITION, "job_id", "first"),
        _partial_index(
            "ix_parcels_owned", "lease_owner IS NOT NULL", "lease_owner", "job_id", "attempt"
        ),
    )

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"), primary_key=True)
    first: Mapped[int] = mapped_column(primary_key=True)
    stop: Mapped[int]
    attempt: Mapped[int] = mapped_column(default=0)
    lost_leases: Mapped[int] = mapped_column(default=0)
    lease_owner: Mapped[str | None]
    lease_until: Mapped[datetime | None]
    n_ended: Mapped[int] = mapped_column(default=0)
    evaluations: Mapped[int] = mapped_column(LargeInteger, default=0)


class Run(Base):
    """One identification: one cell of the sweep of a job, and its result.

    `number` is the position of the cell in the sweep, `spec_hash` identifies the computation.
    `result` is the result document. `estimates` repeats {name: {"value", "stderr"}} of it for
    summaries over many runs. `rms_noise_free` is the RMS against the records before noise was
    added. `kills` counts how often in a row a worker died in this run alone without progress.
    `signals_sha256` names the object of its fitted signals. If several runs share an object, the
    file of this run is `signals_size` bytes of it from `signals_start`. A deleted run keeps its row
    without results, so that the job does not compute it again.
    """

    __tablename__ = "runs"
    __table_args__ = (
        UniqueConstraint("job_id", "number"),
        Index("ix_runs_job_id_state_number", "job_id", "state", "number"),
        _partial_index(
            "ix_runs_job_id_best_rms", "best_rms IS NOT NULL", "job_id", "best_rms", "number"
        ),
        # Runs without a hash or signals are not among them: to enter an index takes time.
        _partial_index(
            "ix_runs_project_id_spec_hash", "spec_hash IS NOT NULL", "project_id", "spec_hash"
        ),
        _partial_index("ix_runs_signals_sha256", "signals_sha256 IS NOT NULL", "signals_sha256"),
    )

    id: Mapped[str] = mapped_column(primary_key=True)
    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"))
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"))
    number: Mapped[int]
    cell: Mapped[Document]
    labels: Mapped[Document]
    spec_hash: Mapped[str | None]
    method: Mapped[str]
    seed: Mapped[int] = mapped_column(LargeInteger)
    sigma: Mapped[float]
    state: Mapped[JobState] = mapped_column(default=JobState.QUEUED)
    attempt: Mapped[int] = mapped_column(default=0)
    kills: Mapped[int] = mapped_column(default=0)
    valid: Mapped[bool | None]
    best_rms: Mapped[float | None]
    rms_noise_free: Mapped[float | None]
    fit_estimation: Mapped[float | None]
    fit_validation: Mapped[float | None]
    evaluations: Mapped[int] = mapped_column(LargeInteger, default=0)
    generations: Mapped[int] = mapped_column(default=0)
    seconds: Mapped[float | None]
    estimates: Mapped[Document | None]
    result: Mapped[Document | None] = mapped_column(OrderedJsonType)  # PostgreSQL parses it once
    signals_sha256: Mapped[str | None]
    signals_start: Mapped[int | None] = mapped_column(LargeInteger)
    signals_size: Mapped[int | None] = mapped_column(LargeInteger)
    error: Mapped[str | None]
    note: Mapped[str | None]
    tags: Mapped[list[Any] | None]
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    deleted_at: Mapped[datetime | None]


class StoredSummary(Base):
    """What pages, figures and tables say of an ended job: `service.sweeps.job_summary`.

    It holds for this `attempt` of the job. It is deleted when the job is resumed.
    """

    __tablename__ = "job_summaries"

    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"), primary_key=True)
    attempt: Mapped[int]
    document: Mapped[Document] = mapped_column(OrderedJsonType)
    created_at: Mapped[datetime] = mapped_column(default=utc_now)


class RunHistory(Base):
    """Improved champions of the islands of a run, packed by `service.repositories.history_rows`.

    `digest` is the hash of `points`. `generation` and `evaluations` are the largest of these
    points, `rms` the smallest.
    """

    __tablename__ = "run_history"

    run_id: Mapped[str] = mapped_column(ForeignKey("runs.id"), primary_key=True)
    digest: Mapped[int] = mapped_column(LargeInteger, primary_key=True)
    n_parameters: Mapped[int]
    generation: Mapped[int]
    evaluations: Mapped[int] = mapped_column(LargeInteger)
    rms: Mapped[float]
    points: Mapped[bytes] = mapped_column(LargeBinary)


class MigrationLog(Base):
    """Migrants of a run, packed by `service.repositories.history_rows`; `digest` is their hash."""

    __tablename__ = "migrations_log"

    run_id: Mapped[str] = mapped_column(ForeignKey("runs.id"), primary_key=True)
    digest: Mapped[int] = mapped_column(LargeInteger, primary_key=True)
    migrants: Mapped[bytes] = mapped_column(LargeBinary)


class Checkpoint(Base):
    """State from which an unfinished run can continue; only the last one is stored."""

    __tablename__ = "checkpoints"

    run_id: Mapped[str] = mapped_column(ForeignKey("runs.id"), primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"), index=True)
    attempt: Mapped[int]
    evaluations: Mapped[int] = mapped_column(LargeInteger)
    state: Mapped[bytes] = mapped_column(LargeBinary)
    created_at: Mapped[datetime] = mapped_column(default=utc_now)


class Event(Base):
    """An event of a job, numbered in the order in which events become visible."""

    __tablename__ = "events"
    __table_args__ = (
        Index("ix_events_job_id_id", "job_id", "id"),
        # A page lists these; a long job has thousands of the others among them.
        _partial_index("ix_events_told", TOLD_CONDITION, "job_id", "id"),
        {"sqlite_autoincrement": True},  # no number is reused, so no event is missed
    )

    id: Mapped[int] = mapped_column(LargeInteger, primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"))
    kind: Mapped[str]
    data: Mapped[Document]
    created_at: Mapped[datetime] = mapped_column(default=utc_now)


class AcceptedReference(Base):
    """A run accepted as the reference of a name; the latest `number` is in use."""

    __tablename__ = "accepted_references"

    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"), primary_key=True)
    name: Mapped[str] = mapped_column(primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    run_id: Mapped[str] = mapped_column(ForeignKey("runs.id"))
    accepted_by: Mapped[str | None]
    note: Mapped[str | None]
    tags: Mapped[list[Any] | None]
    accepted_at: Mapped[datetime] = mapped_column(default=utc_now)


class SearchTerm(Base):
    """A term under which lists find an item: a tag, a label, a model or a dataset.

    `kind` is that of the item and of the term, such as ``job:tag``. A page of a list is then one
    range of the primary key.
    """

    __tablename__ = "search_terms"

    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"), primary_key=True)
    kind: Mapped[str] = mapped_column(primary_key=True)
    value: Mapped[str] = mapped_column(primary_key=True)
    item_id: Mapped[str] = mapped_column(primary_key=True, index=True)


class IdempotencyKey(Base):
    """A job submitted under a client's idempotency key."""

    __tablename__ = "idempotency_keys"

    project_id: Mapped[str] = mapped_column(ForeignKey("projects.id"), primary_key=True)
    key: Mapped[str] = mapped_column(primary_key=True)
    request_hash: Mapped[str]
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id"), index=True)
    created_at: Mapped[datetime] = mapped_column(default=utc_now)


class DispatcherHeartbeat(Base):
    """Heartbeat of a dispatcher: whether it is alive, and for how many cores it has work.

    `details` tells its process and its Ray cluster (`service.dispatch.held_leases`).
    """

    __tablename__ = "dispatchers"

    owner: Mapped[str] = mapped_column(primary_key=True)
    details: Mapped[Document]
    started_at: Mapped[datetime]
    seen_at: Mapped[datetime]
    wanted_cores: Mapped[int] = mapped_column(default=0)
