"""The states of jobs and runs: for tables, responses, commands and the client."""

from enum import StrEnum
from typing import Literal

RunStateName = Literal["queued", "running", "succeeded", "failed", "cancelled"]
StateName = Literal[RunStateName, "incomplete"]


class JobState(StrEnum):
    """State of a job or of a run; only a job is incomplete: some of its runs have failed."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    INCOMPLETE = "incomplete"

    @property
    def is_terminal(self) -> bool:
        """Whether no dispatcher will ever change the state again."""
        return self not in OPEN_STATES


def describe_state(state: str, n_failed: int, n_runs: int) -> str:
    """Describe the state of a job that has `n_failed` failed runs among `n_runs`."""
    if state == JobState.INCOMPLETE:
        return f"{n_failed} of {n_runs} failed"
    return state


OPEN_STATES = (JobState.QUEUED, JobState.RUNNING)
RUN_STATES = tuple(state for state in JobState if state is not JobState.INCOMPLETE)
