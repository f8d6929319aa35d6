"""Start or join Ray, and send it packs of work; only `workers` imports Ray.

By default Ray 2.60 joins any cluster that it finds, and retries killed tasks. It hangs if its
raylet is gone, and it listens on every interface (therefore the token). The measures against this
are described in ``docs/decisions/0007-driving-ray.md``.
"""

import logging
import os
import threading
import time
from collections.abc import Sequence
from contextlib import chdir, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from sysid.core.awake_clock import read_awake_seconds
from sysid.identification.fingerprint import compute_fingerprint
from workers.cluster_address import check_address, explain_failure
from workers.errors import ClusterLost, ClusterUnavailable, PackCancelled, PackFailed, WorkerDied
from workers.local_ray import (
    INIT_ARGUMENTS,
    INIT_ERRORS,
    ONE_THREAD_ENVIRONMENT,
    RAY_ENVIRONMENT,
    START_SECONDS,
    LocalRay,
)
from workers.memory_limit import compute_worker_memory, process_pack_within
from workers.protocol import Pack, PackHandle, PackResult, Records
from workers.ray_folders import find_folder_processes, kill_processes
from workers.warmup import warm_up_worker

_log = logging.getLogger(__name__)

FETCH_SECONDS = 20.0
SILENCE_SECONDS = 5.0
"""After this time without a finished task, a no-op task tests whether Ray is alive."""
ANSWER_SECONDS = 15.0
LATE_WORKER_SECONDS = 30.0
"""Workers that start later than this after the first are not waited for."""
SLOT_COUNT_SECONDS = 2.0
"""Interval at which the cores of a joined cluster are counted."""
LIVENESS_SECONDS = 0.1
"""Interval between two checks of the processes of a local Ray."""
VITAL_PROGRAMS = ("gcs_server", "raylet")
"""Programs without which a local Ray is lost."""


@dataclass(frozen=True, slots=True)
class ClusterSettings:
    """Settings of Ray: `address` None starts it on this machine with `cpus` cores (None: all).

    For a cluster that is joined, `cpus` is the largest number of cores used. `memory_bytes` is the
    memory limit of a worker for its runs. None: on a local Ray, its share of the machine's memory.
    `start_seconds` is the time limit for the start of Ray, and then of its first worker.
    """

    address: str | None = None
    cpus: int | None = None
    memory_bytes: int | None = None
    start_seconds: float = START_SECONDS


class RayExecutor:
    """The workers of a Ray cluster; implements `workers.protocol.Executor`.

    Parameters
    ----------
    local : LocalRay, optional
        A Ray that was started before. Otherwise one is started, unless the settings name a cluster.

    Raises
    ------
    ClusterUnavailable
        If Ray cannot be started or joined.
    """

    def __init__(self, settings: ClusterSettings, local: LocalRay | None = None) -> None:
        os.environ.update(RAY_ENVIRONMENT)
        self._local = None
        if settings.address is None:
            self._local = local or LocalRay(settings.cpus, None, settings.start_seconds)
        else:
            check_address(settings.address)
        import ray  # it reads its environment now, unless the local one has imported it

        self._ray: Any = ray
        if settings.address is not None:
            _join_cluster(ray, settings.address)
        self._advance = ray.remote(num_cpus=1, max_retries=0)(process_pack_within)
        self._noop = ray.remote(num_cpus=0, max_retries=0)(_answer_probe)
        self._in_flight: set[Any] = set()
        self._probe: Any = None
        self._last_answer = read_awake_seconds()
        self._last_process_check = time.monotonic()
        self._vital_pids = () if settings.address else _find_vital_processes()
        self._most_slots, self._start_seconds = settings.cpus, settings.start_seconds
        self._shared_slots: int | None = None
        self.identity = None if settings.address is None else _name_cluster(ray)
        self.n_cores = self._count_cores()
        self.slots = self._count_slots()
        self._memory = settings.memory_bytes
        if self._memory is None and settings.address is None:
            self._memory = compute_worker_memory(self.slots)
        self._closing = threading.Event()
        if settings.address is not None:  # nodes come and go
            threading.Thread(target=self._watch_slot_count, name="slots", daemon=True).start()

    def warm_up_workers(self) -> None:
        """Load the compiled loops in every worker before the first run.

        Once one worker is up, busy cores of a joined cluster are not waited for.

        Raises
        ------
        ClusterUnavailable
            If the workers do not start, or run another version of this program.
        """
        task = self._ray.remote(num_cpus=1, max_retries=0, scheduling_strategy="SPREAD")(
            warm_up_worker
        )
        tasks = [task.remote() for _ in range(self.slots)]
        limit = time.monotonic() + self._start_seconds
        ready, late = self._ray.wait(tasks, timeout=self._start_seconds)
        if late and ready:
            left = min(LATE_WORKER_SECONDS, limit - time.monotonic())
            ready, late = self._ray.wait(tasks, num_returns=len(tasks), timeout=max(0.0, left))
        if not ready:
            raise ClusterUnavailable(f"no worker of Ray came up within {self._start_seconds:.0f} s")
        try:
            fingerprints = self._ray.get(ready, timeout=FETCH_SECONDS)
        except self._ray.exceptions.RayError as error:
            last = str(error).strip().splitlines()[-1]
            raise ClusterUnavailable(f"Ray's workers do not come up: {last}") from error
        for pending in late:
            self._ray.cancel(pending, force=False)
        if self._local is None:
            _require_same_program(fingerprints)
        self._last_answer = read_awake_seconds()

    def share_records(self, records: Records) -> Any:
        """Put records into the object store; afterwards only the reference is sent."""
        return self._ray.put(records)

    def submit_pack(self, pack: Pack) -> PackHandle:
        """Send a pack."""
        # Ray fetches shared records only if they are arguments of their own.
        handle = self._advance.remote(
            self._memory,
            pack.encoder,
            tuple(pack.items),
            tuple(pack.records),
            *pack.records.values(),
        )
        self._in_flight.add(handle)
        return handle

    def wait_for_packs(self, timeout: float) -> tuple[PackHandle, ...]:
        """Return handles of packs that ended; wait at most `timeout` seconds for the first."""
        if not self._in_flight:
            time.sleep(timeout)
            return ()
        in_flight = list(self._in_flight)
        ready, _ = self._ray.wait(in_flight, num_returns=1, timeout=timeout, fetch_local=False)
        if ready:  # all others that have ended by now
            ready, _ = self._ray.wait(
                in_flight, num_returns=len(in_flight), timeout=0, fetch_local=False
            )
            self._last_answer = read_awake_seconds()
        return tuple(ready)

    def fetch_results(self, handle: PackHandle) -> PackResult:
        """Return the results of a finished pack.

        Raises
        ------
        PackLost
            If it was cancelled, its worker died, or it met a programming error.
        ClusterLost
            If Ray does not deliver the results.
        """
        errors = self._ray.exceptions
        self._in_flight.discard(handle)
        self._check_processes_alive()
        try:
            done: PackResult = self._ray.get(handle, timeout=FETCH_SECONDS)
        except errors.TaskCancelledError as error:
            raise PackCancelled("cancelled") from error
        except errors.GetTimeoutError as error:
            raise ClusterLost("Ray does not deliver a finished result") from error
        except errors.RayTaskError as error:
            raise PackFailed(str(error)) from error
        except errors.RayError as error:  # crashed, out of memory, node or object lost
            self._check_processes_alive(at_once=True)  # if the raylet died, no run is the cause
            raise WorkerDied(str(error).splitlines()[0]) from error
        return done

    def cancel_pack(self, handle: PackHandle, *, force: bool) -> None:
        """Interrupt a pack between two kernel calls, or kill its worker."""
        self._ray.cancel(handle, force=force, recursive=False)

    def check_cluster_alive(self) -> None:
        """Test whether Ray still responds, after a while without a result; never waits.

        Raises
        ------
        ClusterLost
            If a process of a local Ray is gone, or a no-op task has not been answered in time.
        """
        self._check_processes_alive()
        silence = read_awake_seconds() - self._last_answer
        if self._probe is None:
            if silence > SILENCE_SECONDS:
                self._probe = self._noop.remote()
            return
        answered, _ = self._ray.wait([self._probe], timeout=0)
        if answered:
            self._probe, self._last_answer = None, read_awake_seconds()
        elif silence > SILENCE_SECONDS + ANSWER_SECONDS:
            raise ClusterLost(f"Ray has not answered for {silence:.0f} s")

    def is_alive(self) -> bool:
        """Whether the processes of a local Ray are running; True for a joined one."""
        return all(map(_is_running, self._vital_pids))

    def close(self) -> None:
        """Leave the cluster; a local one is shut down."""
        self._closing.set()
        self._ray.shutdown()
        self._remove_folder()

    def abandon_cluster(self) -> None:
        """Abandon a lost cluster, without any call to it."""
        if self._local is not None:
            kill_processes(find_folder_processes(os.getpid()))
            self._remove_folder()

    def _check_processes_alive(self, *, at_once: bool = False) -> None:
        """Check the processes of a local Ray: without them calls hang, or end this process."""
        now = time.monotonic()
        if at_once or now - self._last_process_check > LIVENESS_SECONDS:
            self._last_process_check = now
            if not self.is_alive():
                raise ClusterLost("a process of the local Ray is gone")

    def limit_slots(self, n_cores: int) -> None:
        """Use that many cores at most: the part of this dispatcher in a shared cluster."""
        self._shared_slots = n_cores
        slots = self._count_slots()
        if slots != self.slots:
            _log.info("%d of %d cores are used now, before %d", slots, self.n_cores, self.slots)
            self.slots = slots

    def _count_cores(self) -> int:
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def _count_slots(self) -> int:
        limits = (self.n_cores, self._most_slots, self._shared_slots)
        return max(1, min(limit for limit in limits if limit is not None))

    def _watch_slot_count(self) -> None:
        """Count cores in a thread, as the call may hang; the scheduler reads `slots` each step."""
        while not self._closing.wait(SLOT_COUNT_SECONDS):
            try:
                n_cores = self._count_cores()
            except (self._ray.exceptions.RayError, RuntimeError, ConnectionError) as error:
                _log.warning("the cores of the cluster could not be counted: %s", error)
                continue
            if n_cores != self.n_cores:
                _log.info("the cluster has %d cores now, before %d", n_cores, self.n_cores)
                self.n_cores = n_cores
                self.slots = self._count_slots()

    def _remove_folder(self) -> None:
        if self._local is not None:
            self._local.remove_folder()


def _find_vital_processes() -> tuple[psutil.Process, ...]:
    vital = []
    for child in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):
            if child.name() in VITAL_PROGRAMS:
                vital.append(child)
    return tuple(vital)


def _is_running(process: psutil.Process) -> bool:
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def _join_cluster(ray: Any, address: str) -> None:
    try:
        # The workers import from this working folder first: on their machines only root writes it.
        with chdir("/"):
            ray.init(
                address=address, runtime_env={"env_vars": ONE_THREAD_ENVIRONMENT}, **INIT_ARGUMENTS
            )
    except INIT_ERRORS as error:
        raise ClusterUnavailable(explain_failure(address, error)) from error


def _name_cluster(ray: Any) -> str | None:
    """Return the identifier of the head node, which all dispatchers of a cluster see."""
    heads = [node for node in ray.nodes() if "node:__internal_head__" in node["Resources"]]
    return str(heads[0]["NodeID"]) if heads else None


def _require_same_program(fingerprints: Sequence[str]) -> None:
    others = set(fingerprints) - {compute_fingerprint(Path(__file__).parent)}
    if others:
        raise ClusterUnavailable(
            "some Ray workers differ from the dispatcher in the version of lagid, in its "
            "libraries or in the kind of machine. Results would depend on where they are computed."
        )


def _answer_probe() -> bool:
    return True
