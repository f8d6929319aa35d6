"""Every error the workers raise on purpose.

* WorkersError
    - ClusterUnavailable   Ray could not be started or joined
    - ClusterLost          Ray does not answer any more: the process should end and be restarted
    - RecordsUnavailable   a run's records cannot be had
    - PackLost             a pack of work was not finished
        - WorkerDied           its process was killed or ran out of memory
        - PackCancelled        it was cancelled, as asked
        - PackFailed           a programming error, with the worker's traceback

What is wrong with a run itself (`sysid.core.errors`) is no error here but its outcome.
"""


class WorkersError(Exception):
    """Base class of the errors that the workers raise on purpose."""


class ClusterUnavailable(WorkersError):
    """Ray could not be started or joined."""


class ClusterLost(WorkersError):
    """Ray does not answer any more."""


class RecordsUnavailable(WorkersError):
    """A run's records cannot be had; the message is a sentence for its user."""


class PackLost(WorkersError):
    """A pack of work was not finished."""


class WorkerDied(PackLost):
    """The process that computed the pack was killed or ran out of memory."""


class PackCancelled(PackLost):
    """The pack was cancelled, as asked."""


class PackFailed(PackLost):
    """The pack met a programming error; the message is the worker's traceback."""
