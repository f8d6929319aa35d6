"""Background thread of the dispatcher, which builds documents of ended jobs."""

import threading
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Generic, TypeVar

from service.storage.columns import Document

STOP_SECONDS = 2.0
"""Longest wait for the step in progress when the dispatcher stops."""

Key = TypeVar("Key", bound=Hashable)
DocumentSteps = Iterator[Document | None]
"""Steps that build a document. The last value is the document."""
DocumentMaker = Callable[[], DocumentSteps]


@dataclass(slots=True, eq=False)
class _BackgroundJob:
    steps: DocumentSteps
    future: "Future[Document | None]" = field(default_factory=Future)
    latest: Document | None = None


class BackgroundJobs(Generic[Key]):
    """One thread for all jobs. Each job gets one step in turn, so that short ones are not delayed.

    Compiling a model takes a tenth of a second, and simulating a long record takes more. Meanwhile
    the dispatcher must keep the workers busy.
    """

    def __init__(self) -> None:
        self._jobs: dict[Key, _BackgroundJob] = {}
        self._queue: SimpleQueue[_BackgroundJob | None] = SimpleQueue()
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def __contains__(self, key: Key) -> bool:
        return key in self._jobs

    @property
    def pending_keys(self) -> tuple[Key, ...]:
        """Keys of documents that were started and neither taken nor cancelled."""
        return tuple(self._jobs)

    def start_job(self, key: Key, make: DocumentMaker) -> None:
        """Start to build the document of a key."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run_jobs, name="background", daemon=True)
            self._thread.start()
        self._jobs[key] = job = _BackgroundJob(make())
        self._queue.put(job)

    def list_done(self) -> tuple[Key, ...]:
        """List the keys of finished documents."""
        return tuple(key for key, job in self._jobs.items() if job.future.done())

    def take_result(self, key: Key) -> Document | None:
        """Take the finished document. An error of its steps is raised here."""
        return self._jobs.pop(key).future.result()

    def cancel_job(self, key: Key) -> None:
        """Cancel a document."""
        job = self._jobs.pop(key, None)
        if job is not None:
            job.future.cancel()

    def stop(self) -> None:
        """Stop the thread."""
        self._ending.set()
        self._queue.put(None)
        if self._thread is not None:
            self._thread.join(STOP_SECONDS)

    def _run_jobs(self) -> None:
        while (job := self._queue.get()) is not None and not self._ending.is_set():
            if job.future.cancelled():
                continue
            try:
                job.latest = next(job.steps)
            except StopIteration:
                _set_outcome(job, None)
            except Exception as error:  # noqa: BLE001 - border of the thread: `take_result` raises it
                _set_outcome(job, error)
            else:
                self._queue.put(job)


def _set_outcome(job: _BackgroundJob, error: Exception | None) -> None:
    if not job.future.set_running_or_notify_cancel():
        return
    if error is None:
        job.future.set_result(job.latest)
    else:
        job.future.set_exception(error)
