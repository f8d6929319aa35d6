"""Words of a command that are no text."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.integration.cli.test_command_line import refused
from tests.repository import ROOT
from tests.rest import recording


@pytest.mark.parametrize("words", [["watch"], ["dataset", "add", "d.csv", "--name"]])
def test_a_word_that_is_no_text_is_one_line(words: list[str], tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_bytes(recording())
    done = subprocess.run(
        [sys.executable, "-m", "service.cli.main", *words, b"\xf6sse"],
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    told = refused(done)
    assert r"\udcf6" in told
    assert told.endswith("is not UTF-8 text; encode it in UTF-8")
