"""Commands of `lagid`: in this process through the function of the console script, or as one."""

import io
import logging
import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import pytest

from service.cli.main import main
from tests.support.checkout import ROOT
from tests.support.limits import LIMIT_SECONDS

PROGRAM = (sys.executable, "-m", "service.cli.main")
NO_SERVER = {"LAGID_URL": "http://127.0.0.1:1"}


class CommandResult(NamedTuple):
    """Exit code and output of a command that has ended."""

    code: int
    stdout: str
    stderr: str


def run_lagid(*words: object, cwd: Path | None = None, **environment: str) -> CommandResult:
    """Run a command in this process; what it changes in the process is undone.

    An error that the command does not handle goes on: a process would end with a traceback.
    """
    out, err = _make_stream("strict"), _make_stream("backslashreplace")
    with (
        _restore_process(),
        chdir(cwd or "."),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        os.environ.update({**NO_SERVER, **environment})
        sys.argv = ["lagid", *map(_to_word, words)]
        with pytest.raises(SystemExit) as end:
            main()
    assert isinstance(end.value.code, int)
    return CommandResult(end.value.code, _read_stream(out), _read_stream(err))


def run_lagid_process(*words: object, cwd: Path | None = None, **environment: str) -> CommandResult:
    """Run a command as a process of its own."""
    done = subprocess.run(
        [*PROGRAM, *(word if isinstance(word, bytes) else str(word) for word in words)],
        capture_output=True,
        text=True,
        timeout=LIMIT_SECONDS,
        check=False,
        cwd=cwd,
        env=make_environment(environment),
    )
    return CommandResult(done.returncode, done.stdout, done.stderr)


def make_environment(changes: Mapping[str, str]) -> dict[str, str]:
    """Environment of a command's process; modules come from the checkout in every folder."""
    return {**os.environ, "PYTHONPATH": str(ROOT), **NO_SERVER, **changes}


def check_refusal(result: CommandResult, code: int = 1) -> str:
    """Check that a command was refused in one line, and return the line."""
    assert result.code == code, result
    assert "Traceback" not in result.stderr
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    return lines[0]


def _to_word(word: object) -> str:
    return os.fsdecode(word) if isinstance(word, bytes) else str(word)


def _make_stream(errors: str) -> io.TextIOWrapper:
    return io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors=errors)


def _read_stream(stream: io.TextIOWrapper) -> str:
    stream.seek(0)
    return stream.read()


@contextmanager
def _restore_process() -> Iterator[None]:
    """Restore arguments, environment, signal handlers, logging and warnings at the end.

    Inside, no logger has a handler, as in a process that has just started.
    """
    arguments, environment = sys.argv, dict(os.environ)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    root = logging.getLogger()
    level, log_handlers = root.level, root.handlers
    root.handlers = []
    root.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            yield
    finally:
        root.handlers = log_handlers
        root.setLevel(level)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        sys.argv = arguments
        for name in os.environ.keys() - environment.keys():
            del os.environ[name]
        os.environ.update(environment)
