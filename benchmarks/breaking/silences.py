"""Faults without an end or an error: silence, hangs, damage, and clients that are slow.

A silent part is noticed by a limit. Recovery counts from the fault, so its bar is that limit and
what other faults may take.
"""

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import httpx
import psutil

from benchmarks.breaking.faults import LIMIT_SECONDS, Bench, goes_on, recovery
from benchmarks.breaking.stand import until

SLOW_SECONDS = 12.0
IDLE_CONNECTIONS, SLOW_UPLOADS = 300, 3  # a project has four places for uploads
UPLOAD_SECONDS = 20.0
"""Within so long another client's recording is stored while others send slowly."""
_CSV = {"Content-Type": "text/csv"}


def hang_worker(bench: Bench) -> float:
    """Stop a process that computes, for ever: it is replaced."""
    family = bench.stand.family
    until(lambda: bool(family.named("ray::process_pack")), "a worker computes", LIMIT_SECONDS)
    (hung,) = family.named("ray::process_pack")[:1]

    def stop() -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(hung, signal.SIGSTOP)

    try:
        return recovery(bench, stop, lambda: not psutil.pid_exists(hung))
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            os.kill(hung, signal.SIGCONT)
        raise


def silence_connections(bench: Bench) -> float:
    """Let all open connections to the database fall silent; new ones work."""
    assert bench.door is not None
    return recovery(bench, bench.door.silence_all, lambda: bench.stand.answers() == httpx.codes.OK)


def damage_object(bench: Bench) -> float:
    """Flip a bit of a stored recording: it is told, and storing it again heals it."""
    content = _make_recording(time.monotonic())
    stored = _store(bench, content)
    sha256, address = stored["sha256"], f"{bench.stand.url}/v1/datasets/{stored['id']}/content"
    path = bench.stand.folder / "objects" / "sha256" / sha256[:2] / f"{sha256}.mcap"
    whole = path.read_bytes()
    begun = time.monotonic()
    path.chmod(0o600)
    path.write_bytes(whole[:-40] + bytes([whole[-40] ^ 1]) + whole[-39:])
    answer = httpx.get(address, timeout=60.0)
    if answer.status_code != httpx.codes.INTERNAL_SERVER_ERROR:
        raise AssertionError(f"a damaged object was answered by {answer.status_code}")
    if not answer.json()["type"].endswith("/damaged-object"):
        raise AssertionError(f"a damaged object was told as {answer.text}")
    _store(bench, content)
    if httpx.get(address, timeout=60.0).content != whole:
        raise AssertionError("storing a recording again did not heal it")
    goes_on(bench, begun)
    return time.monotonic() - begun


def send_slowly(bench: Bench) -> float:
    """Open connections that send nothing, and uploads of a byte now and then; others are served."""
    with _slow_clients(bench.stand.port):
        limit = time.monotonic() + SLOW_SECONDS
        while time.monotonic() < limit:
            begun = time.monotonic()
            _store(bench, _make_recording(begun))
            if (took := time.monotonic() - begun) > UPLOAD_SECONDS:
                raise AssertionError(f"an upload waited {took:.0f} s for slow ones")
            if bench.stand.answers() != httpx.codes.OK:
                raise AssertionError("the web does not answer beside slow clients")
            time.sleep(1.0)
    return recovery(bench, lambda: None, lambda: bench.stand.answers() == httpx.codes.OK)


def _make_recording(new: float) -> bytes:
    """A small recording that is not stored yet."""
    rows = [f"{0.1 * i:.1f},{new + i % 7},{new - i}" for i in range(200)]
    return "\n".join(["t,q [N],y [m]", *rows, ""]).encode()


def _store(bench: Bench, content: bytes) -> dict[str, str]:
    answer = httpx.post(
        f"{bench.stand.url}/v1/datasets", content=content, headers=_CSV, timeout=60.0
    )
    answer.raise_for_status()
    document: dict[str, str] = answer.json()
    return document


@contextmanager
def _slow_clients(port: int) -> Iterator[None]:
    head = b"POST /v1/datasets HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: text/csv\r\n"
    head += b"Content-Length: 100000\r\n\r\nt,q,y\n"
    ending = threading.Event()
    with ExitStack() as stack:

        def connect() -> socket.socket:
            return stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10.0))

        for _ in range(IDLE_CONNECTIONS):
            connect()
        uploads = [connect() for _ in range(SLOW_UPLOADS)]
        for upload in uploads:
            upload.sendall(head)

        def trickle() -> None:
            while not ending.wait(2.0):
                for upload in uploads:
                    with contextlib.suppress(OSError):
                        upload.sendall(b"0")

        thread = threading.Thread(target=trickle, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ending.set()
            thread.join()
