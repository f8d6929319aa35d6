"""A process whose main loop or whose threads stand is ended, and says so."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
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
    code = NATIVE.replace("loop.turn()", "")  # no loop is watched: only the timer ends it
    ended = run(code, "native")
    assert ended.returncode == 1
    assert "Timeout" in ended.stderr


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
