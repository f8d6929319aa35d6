"""Wire types of access: who asks, and the audit log."""

from datetime import datetime

from service.core.wire import Answer


class LimitsOut(Answer):
    """Limits of a project; null where there is none."""

    max_open_jobs: int
    max_open_runs: int
    max_stored_bytes: int | None
    max_daily_evaluations: int | None


class UseOut(Answer):
    """What a project uses of its limits: evaluations are those of the last 24 hours."""

    open_jobs: int
    open_runs: int
    stored_bytes: int
    daily_evaluations: int


class AccessOut(Answer):
    """Who asks, in which project, and what it may do."""

    actor: str
    project: str
    project_name: str
    scopes: list[str]
    limits: LimitsOut
    used: UseOut


class AuditEntryOut(Answer):
    """One action: who did what to which object."""

    id: int
    at: datetime
    actor: str
    action: str
    object_id: str | None
    request_id: str | None
