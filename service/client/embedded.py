"""Run a private service for the length of a `with` block."""

import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

import httpx

from service.core.errors import ServiceDidNotStart
from sysid.core.child_processes import SAFE_FOLDER, build_child_command, build_import_path

START_LIMIT_SECONDS = 240.0
"""A first start compiles the loops, which takes minutes on a busy machine."""
STOP_LIMIT_SECONDS = 20.0


@contextmanager
def run_embedded_service(
    data_dir: str | PathLike[str],
    *,
    port: int | None = None,
    cpus: int | None = None,
    environment: Mapping[str, str] | None = None,
) -> Iterator[str]:
    """Start `lagid serve` as a child process, wait until it is ready, and stop it at the end.

    Parameters
    ----------
    data_dir : str or PathLike
        Folder of database, objects and logs; created if it does not exist.
    port : int, optional
        Port on loopback; a free one by default.
    cpus : int, optional
        Cores for the workers; all by default.
    environment : mapping, optional
        All variables of the service, which then reads no file `lagid.env`. By default it has those
        of this process, and reads the file of the working folder.

    Yields
    ------
    str
        Address of the service.

    Raises
    ------
    ServiceDidNotStart
        If it ended or was not ready in time; the message quotes the end of its log.
    """
    folder = Path(data_dir)
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    chosen_port = port or find_free_port()
    url = f"http://127.0.0.1:{chosen_port}"
    command = build_child_command("service.cli.main", "serve", "--data-dir", str(folder.absolute()))
    command += ["--host", "127.0.0.1", "--port", str(chosen_port)]
    command += ["--cpus", str(cpus)] if cpus else []
    log = folder / "serve.log"
    with log.open("ab") as sink:
        child = subprocess.Popen(
            command,
            env={
                **(os.environ if environment is None else environment),
                "PYTHONPATH": build_import_path(),
            },
            cwd=None if environment is None else SAFE_FOLDER,
            stdout=sink,
            stderr=sink,
            stdin=subprocess.DEVNULL,
        )
    try:
        _wait_until_ready(url, child, log)
        yield url
    finally:
        _stop_child(child)


def find_free_port() -> int:
    """Return a port of loopback that is free at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_until_ready(url: str, child: "subprocess.Popen[bytes]", log: Path) -> None:
    limit = time.monotonic() + START_LIMIT_SECONDS
    while time.monotonic() < limit:
        if child.poll() is not None:
            raise ServiceDidNotStart(
                f"it ended with exit code {child.returncode}", _read_log_tail(log)
            )
        try:
            if httpx.get(f"{url}/readyz", timeout=2.0).status_code == httpx.codes.OK:
                return
        except httpx.TransportError:
            pass  # not listening yet
        time.sleep(0.1)
    raise ServiceDidNotStart(
        f"it was not ready after {START_LIMIT_SECONDS:g} s", _read_log_tail(log)
    )


def _read_log_tail(log: Path) -> str:
    return "\n".join(log.read_text(errors="replace").splitlines()[-8:])


def _stop_child(child: "subprocess.Popen[bytes]") -> None:
    if child.poll() is not None:
        return
    child.send_signal(signal.SIGTERM)
    try:
        child.wait(timeout=STOP_LIMIT_SECONDS)
    except subprocess.TimeoutExpired:
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
