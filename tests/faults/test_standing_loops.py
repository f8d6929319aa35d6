"""A process whose main loop or whose threads stand is ended, and says so."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import psutil
import pytest

from service.client.embedded import find_free_port
from service.dispatch.supervisor import RESTART_EXIT_CODE
from tests.support.limits import LIMIT_SECONDS

STANDING = """
import sys, threading, time
from service.core.process import loop_watch
from service.core.process.loop_watch import LoopWatch
from service.dispatch import dispatcher
loop_watch.STANDS_SECONDS, loop_watch.LOOK_SECONDS = 0.5, 0.1
class Executor:
    def is_alive(self): return True
    def abandon_cluster(self): print("abandoned", flush=True)
loop = LoopWatch()
loop.turn()
dispatcher._watch_process(threading.Event(), Executor(), loop)
def wait_for_ever():
    time.sleep(1.0 if sys.argv[1] == "native" else 600)
wait_for_ever()
"""

# Native code that keeps all threads of Python from running.
NATIVE = (
    STANDING
    + """
import ctypes
ctypes.PyDLL(None).sleep(600)
"""
)

WEB = """
import sys, threading, time
from service.cli import server_processes
server_processes.END_SECONDS = 0.5
threading.Thread(target=lambda: time.sleep(600), name="stuck").start()
server_processes._exit_on_signals()
print("ready", flush=True)
time.sleep(600)
"""


def run(code: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        timeout=LIMIT_SECONDS,
    )


def test_a_dispatcher_whose_main_loop_stands_ends_and_tells_where_it_stood() -> None:
    ended = run(STANDING, "sleep")
    assert ended.returncode == RESTART_EXIT_CODE
    assert "the main loop stands for 0.5 s" in ended.stderr
    assert "in wait_for_ever" in ended.stderr
    assert "abandoned" in ended.stdout


def test_a_dispatcher_that_stands_in_native_code_ends_too() -> None:
    code = NATIVE.replace("loop.turn()", "")  # no loop is watched: only the outer watch ends it
    ended = run(code, "native")
    assert ended.returncode == -signal.SIGABRT
    assert "Aborted" in ended.stderr
    assert "in <module>" in ended.stderr


TURNING = """
import sys, threading, time
from sysid.core import awake_clock
from service.core.process import loop_watch, outer_watch
awake_clock.NAP_SECONDS = outer_watch.NAP_SECONDS = 0.1
loop_watch.STANDS_SECONDS, loop_watch.LOOK_SECONDS = 1.0, 0.1
loop, stopping = loop_watch.LoopWatch(), threading.Event()
loop.turn()
loop_watch.end_if_standing(loop, stopping, lambda: print("ended", flush=True))
for _ in range(int(sys.argv[1])):
    time.sleep(0.02)
    loop.turn()
    print(".", flush=True)
stopping.set()
time.sleep(0.3)
"""


@pytest.mark.parametrize("stops_all", [True, False], ids=["all", "alone"])
def test_a_process_that_was_stopped_for_long_goes_on(stops_all: bool) -> None:
    """SIGSTOP stops a process as a suspended machine does, while its clocks go on."""
    process = subprocess.Popen(
        [sys.executable, "-c", TURNING, "60"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    stop = os.killpg if stops_all else os.kill  # with the child that watches it, or without
    assert process.stdout is not None
    try:
        for _ in range(20):
            assert process.stdout.readline() == ".\n"
        stop(process.pid, signal.SIGSTOP)
        time.sleep(4.0)
        stop(process.pid, signal.SIGCONT)
        said, log = process.communicate(timeout=LIMIT_SECONDS)
    finally:
        os.killpg(process.pid, signal.SIGKILL) if process.poll() is None else None
    assert process.returncode == 0, log
    assert said.count(".") == 40
    assert "ended" not in said
    assert log == ""


def test_no_process_is_left_of_one_that_was_watched_and_killed() -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", TURNING, "10000"], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    limit = time.monotonic() + LIMIT_SECONDS
    while not (children := psutil.Process(process.pid).children()):
        assert process.stdout.readline() == ".\n"
        assert time.monotonic() < limit
    process.kill()
    process.communicate()
    _, alive = psutil.wait_procs(children, timeout=LIMIT_SECONDS)
    assert alive == []


def test_a_web_process_ends_after_a_signal_whatever_its_threads_wait_for() -> None:
    web = subprocess.Popen(
        [sys.executable, "-c", WEB], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert web.stdout is not None
    assert web.stdout.readline() == "ready\n"
    web.send_signal(signal.SIGTERM)
    _, said = web.communicate(timeout=LIMIT_SECONDS)
    assert web.returncode == 128 + signal.SIGTERM
    assert "stuck" in said


SERVE = """
import asyncio, os, sys, time
from service.api.routes import health_routes
from lagid import main
from service.core.process import loop_watch
loop_watch.STANDS_SECONDS, loop_watch.LOOK_SECONDS = 1.0, 0.1

async def stand():
    time.sleep(600)

health_routes.router.add_api_route("/stand", stand)
sys.argv = ["lagid", "serve", "--no-dispatcher", "--port", sys.argv[1], "--data-dir", sys.argv[2]]
main()
"""


def is_up(url: str) -> bool:
    try:
        return httpx.get(f"{url}/healthz").status_code == 200
    except httpx.TransportError:
        return False


def test_a_web_process_whose_event_loop_stands_ends_and_tells_where(tmp_path: Path) -> None:
    port = find_free_port()
    web = subprocess.Popen(
        [sys.executable, "-c", SERVE, str(port), str(tmp_path)], stderr=subprocess.PIPE, text=True
    )
    url, limit = f"http://127.0.0.1:{port}", time.monotonic() + LIMIT_SECONDS
    try:
        while not is_up(url):
            assert time.monotonic() < limit, "it did not start"
            time.sleep(0.1)
        with pytest.raises(httpx.TransportError):
            httpx.get(f"{url}/stand", timeout=LIMIT_SECONDS)
        _, said = web.communicate(timeout=LIMIT_SECONDS)
    finally:
        web.kill()
        web.communicate()
    assert web.returncode == RESTART_EXIT_CODE
    assert "in stand" in said
