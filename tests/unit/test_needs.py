"""Skips are honest: required needs fail, and too many skips fail the run."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.checkout import ROOT

TESTS = """
import pytest
pytest_plugins = ["tests.support.requirements"]

@pytest.mark.data
def test_with_records(): pass

@pytest.mark.skip(reason="an example")
def test_skipped(): pass

def test_passed(): pass
"""


def run(tmp_path: Path, **environment: str) -> tuple[int, str]:
    (tmp_path / "test_example.py").write_text(TESTS)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = data: records\n")
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path)],
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin", **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    return ran.returncode, ran.stdout


@pytest.mark.parametrize(
    ("environment", "code", "said"),
    [
        ({}, 0, "1 passed, 2 skipped"),
        ({"LAGID_MAX_SKIPPED": "1"}, 0, "1 tests were skipped besides"),
        ({"LAGID_MAX_SKIPPED": "0"}, 1, "more than LAGID_MAX_SKIPPED=0: the run fails"),
        ({"LAGID_REQUIRE_DATA": "1"}, 1, "are absent, and LAGID_REQUIRE_DATA is 1"),
    ],
)
def test_what_is_skipped_counts(
    tmp_path: Path, environment: dict[str, str], code: int, said: str
) -> None:
    found, output = run(tmp_path, LAGID_DATA=str(tmp_path / "absent"), **environment)
    assert found == code, output
    assert said in output
