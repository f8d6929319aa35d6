"""A command that runs in the tests' process leaves nothing of itself there."""

import logging
import os
import signal
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest

from tests.support.service import commands


def read_state() -> dict[str, Any]:
    """What commands change in their process."""
    root = logging.getLogger()
    return {
        "arguments": list(sys.argv),
        "environment": dict(os.environ),
        "folder": Path.cwd(),
        "handlers": (list(root.handlers), root.level),
        "signals": [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)],
        "streams": (sys.stdout, sys.stderr),
        "warnings": list(warnings.filters),
    }


def test_what_a_command_changes_of_its_process_is_undone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    met: dict[str, Any] = {}

    def disturb() -> None:
        met.update(read_state())
        os.environ["LAGID_OTHER"] = "1"
        del os.environ["LAGID_URL"]
        os.chdir("/")
        logging.basicConfig(level=logging.INFO, format="%(message)s")
        logging.getLogger("lagid").info("begun")
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        warnings.simplefilter("ignore")
        sys.exit(3)

    monkeypatch.setattr(commands, "main", disturb)
    monkeypatch.setenv("LAGID_URL", "http://of-the-test")
    before = read_state()
    result = commands.run_lagid("jobs", 7, b"\xf6", cwd=tmp_path, LAGID_KEY="k")
    assert read_state() == before
    assert result == commands.CommandResult(3, "", "begun\n")
    assert met["arguments"] == ["lagid", "jobs", "7", "\udcf6"]
    assert met["folder"] == tmp_path
    assert met["handlers"] == ([], logging.WARNING)
    assert met["environment"]["LAGID_KEY"] == "k"
    assert met["environment"]["LAGID_URL"] == commands.NO_SERVER["LAGID_URL"]


def test_an_error_that_a_command_does_not_handle_is_not_hidden(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail() -> None:
        raise ArithmeticError("of the program")

    monkeypatch.setattr(commands, "main", fail)
    with pytest.raises(ArithmeticError, match="of the program"):
        commands.run_lagid("jobs")
