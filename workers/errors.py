"""Errors of the workers.

* WorkersError
    - ClusterUnavailable   Ray could not be started or joined
    - ClusterLost          Ray does not answer any more: the process should end and be restarted
    - RecordsUnavailable   a run's records cannot be loaded
    - RecordsDelayed       a run's records cannot be loaded now, and perhaps later
    - InvalidCheckpoint    a run's checkpoint does not fit its model or its settings
    - PackLost             a pack of work was not finished
        - WorkerDied           its process was killed or ran out of memory
        - PackCancelled        it was cancelled on request
        - PackFailed           a programming error, with the worker's traceback

An error in a run itself (`sysid.core.errors`) is not raised here; it is the outcome of the run.
"""


class WorkersError(Exception):
    """Base class of the errors of the workers."""


class ClusterUnavailable(WorkersError):
    """Ray could not be started or joined."""


class ClusterLost(WorkersError):
    """Ray does not answer any more."""


class RecordsUnavailable(WorkersError):
    """A run's records cannot be loaded; the message is a sentence for its user."""


class RecordsDelayed(WorkersError):
    """A run's records cannot be loaded now; the message says why.

    `seconds` is when to ask again.
    """

    def __init__(self, reason: str, seconds: float) -> None:
        super().__init__(reason)
        self.seconds = seconds


class InvalidCheckpoint(WorkersError):
    """A run's checkpoint does not fit its model or its settings."""

    def __init__(self) -> None:
        super().__init__("its checkpoint is of another model or of other settings; clone the job")


class PackLost(WorkersError):
    """A pack of work was not finished."""


class WorkerDied(PackLost):
    """The process that computed the pack was killed or ran out of memory."""


class PackCancelled(PackLost):
    """The pack was cancelled on request."""


class PackFailed(PackLost):
    """The pack met a programming error; the message is the worker's traceback."""
