"""Wire types of access: who asks, and the audit log."""

from datetime import datetime

from pydantic import Field

from service.core.bodies.wire import Answer, Page


class LimitsOut(Answer):
    """Limits of a project; null where there is none."""

    max_open_jobs: int = Field(description="most jobs that wait or run")
    max_open_runs: int = Field(description="most runs of these jobs that have not ended")
    max_stored_bytes: int | None = Field(description="most bytes of recordings and results")
    max_daily_evaluations: int | None = Field(
        description="most simulations of the last 24 hours, of jobs that ran and of requests"
    )


class UseOut(Answer):
    """What a project uses of its limits."""

    open_jobs: int = Field(description="jobs that wait or run")
    open_runs: int = Field(description="runs of these jobs that have not ended")
    stored_bytes: int = Field(description="bytes of recordings, and of results at 8.4 kB a run")
    daily_evaluations: int = Field(
        description="simulations of the last 24 hours, of jobs that ran and of requests"
    )


class AccessOut(Answer):
    """Who asks, in which project, and what it may do."""

    actor: str = Field(
        description="who sends the request: a key, a user of the proxy, or `loopback`"
    )
    project: str = Field(description="id of the project")
    project_name: str = Field(description="name of the project")
    scopes: list[str] = Field(description="what the caller may do: read, write, admin")
    limits: LimitsOut = Field(description="limits of the project")
    used: UseOut = Field(description="what the project uses of them")


class AuditEntryOut(Answer):
    """One action: who did what to which object."""

    id: int = Field(description="number of the entry; later ones are larger")
    at: datetime = Field(description="when it was done, UTC")
    actor: str = Field(description="who did it, as in `GET /v1/access`")
    action: str = Field(description="what was done, such as `job.submit`")
    object_id: str = Field(description="id of what was changed")
    request_id: str | None = Field(description="id of the request that did it")


class AuditPage(Page[AuditEntryOut]):
    """Entries of the audit log, latest first."""
