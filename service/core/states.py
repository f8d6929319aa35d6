"""The states of jobs and runs: for tables, responses, commands and the client."""

from enum import StrEnum
from typing import Literal

StateName = Literal["queued", "running", "succeeded", "failed", "cancelled"]


class JobState(StrEnum):
    """State of a job or of a run."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_terminal(self) -> bool:
        """Whether no dispatcher will ever change the state again."""
        return self not in OPEN_STATES


OPEN_STATES = (JobState.QUEUED, JobState.RUNNING)
