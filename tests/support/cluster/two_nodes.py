"""Two nodes of one Ray cluster, in processes of their own: the session's local Ray is not touched.

Run as ``python -m tests.support.cluster.two_nodes FOLDER TEMPORARY``.
It starts a head and another node of one CPU each, prints the address, and obeys lines on standard
input: ``kill`` (kill -9 of all of the second node), ``add`` (one more node), ``end``.
"""

import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from service.dispatch.supervisor import find_session_processes
from sysid.core.code_cache import find_cache_folder
from workers.ray_folders import kill_processes


class TwoNodes:
    """The cluster as the test sees it."""

    def __init__(self, address: str, token: str, orders: IO[str], answers: IO[str]) -> None:
        self.address, self.token = address, token
        self._orders, self._answers = orders, answers

    @property
    def environment(self) -> dict[str, str]:
        """What a process that joins needs to have in its environment."""
        return {"LAGID_RAY_ADDRESS": self.address, **_auth(self.token)}

    def order(self, what: str) -> None:
        """Have it done, and wait until it is."""
        self._orders.write(what + "\n")
        self._orders.flush()
        assert self._answers.readline().strip() == f"done {what}"


@contextmanager
def two_nodes(folder: Path) -> Iterator[TwoNodes]:
    """A cluster for the length of the block; nothing of it is left afterwards.

    The second node keeps its compiled kernels in ``folder/cache``, as another machine would.
    """
    token = secrets.token_hex(32)
    temporary = Path(tempfile.mkdtemp())  # in the folder of the session: sockets need a short path
    (temporary / "ray").mkdir()  # where Ray writes the address of its cluster
    log = (folder / "cluster.log").open("w")
    child = subprocess.Popen(
        [sys.executable, "-m", "tests.support.cluster.two_nodes", str(folder), str(temporary)],
        env={
            **os.environ,
            **_auth(token),
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_TMPDIR": str(temporary),
        },
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=log,
        text=True,
        start_new_session=True,
    )
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        address = child.stdout.readline().strip()
        assert address, "the cluster ended without an answer; see cluster.log"
        yield TwoNodes(address, token, child.stdin, child.stdout)
    finally:
        kill_processes(find_session_processes(child.pid))
        _kill_with(str(temporary))
        child.wait()
        for pipe in (child.stdin, child.stdout, log):
            pipe.close()
        shutil.rmtree(temporary, ignore_errors=True)


def _auth(token: str) -> dict[str, str]:
    return {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": token}


def _serve(folder: Path, temporary: Path) -> None:
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what Ray prints goes to the log
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
    head = {
        **node,
        "include_dashboard": False,
        "temp_dir": str(temporary),
        "_system_config": {"health_check_period_ms": 500},  # a dead node is noticed soon
    }
    cluster = Cluster(initialize_head=True, connect=False, head_node_args=head)
    loops = os.environ.get("NUMBA_CACHE_DIR") or str(
        find_cache_folder()
    )  # half a minute to compile
    elsewhere = {"LAGID_CACHE_DIR": str(folder / "cache"), "NUMBA_CACHE_DIR": loops}
    second: Any = cluster.add_node(**node, env_vars=elsewhere)
    print(cluster.address, file=answers)
    for line in sys.stdin:
        match line.strip():
            case "kill":
                _kill_node(second)
            case "add":
                second = cluster.add_node(**node, env_vars=elsewhere)
            case "end":
                break
        print(f"done {line.strip()}", file=answers)
    cluster.shutdown()


def _kill_node(node: Any) -> None:
    """Kill -9 of a node's raylet, of its workers and of its agents, as a power cut does."""
    (raylet,) = (info.process for info in node.all_processes["raylet"])
    for pid in [*_descendants(raylet.pid), raylet.pid]:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue


def _descendants(pid: int) -> list[int]:
    found = []
    for child in Path(f"/proc/{pid}/task").glob("*/children"):
        for one in map(int, child.read_text().split()):
            found += [*_descendants(one), one]
    return found


def _kill_with(mark: str) -> None:
    """Kill what names this folder in its command line."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if mark in (entry / "cmdline").read_bytes().decode(errors="replace"):
                os.kill(int(entry.name), signal.SIGKILL)
        except OSError:
            continue


if __name__ == "__main__":
    _serve(Path(sys.argv[1]), Path(sys.argv[2]))
