"""The states of jobs and runs, for tables, answers, commands and the client alike."""

from enum import StrEnum
from typing import Literal

StateName = Literal["queued", "running", "succeeded", "failed", "cancelled"]


class JobState(StrEnum):
    """How far a job or a run has come."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_terminal(self) -> bool:
        """Whether no dispatcher will ever change it again."""
        return self not in OPEN_STATES


OPEN_STATES = (JobState.QUEUED, JobState.RUNNING)
