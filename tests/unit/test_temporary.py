"""Temporary files of processes that are gone are cleared; those of the living stay."""

import os
import subprocess
import sys
from pathlib import Path

from service import temporary

LEAVE = "import sys; from service import temporary; open(sys.argv[1] + temporary.prefix(), 'w')"


def test_what_a_dead_process_left_goes_and_what_a_living_one_has_stays(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", LEAVE, f"{tmp_path}/"], check=True, timeout=60)
    mine = tmp_path / f"{temporary.prefix()}file"
    mine.touch()
    other = tmp_path / "lagid-tmp-another-host-1-file"
    other.touch()
    temporary.clear(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {mine.name, other.name}
    old = 2 * temporary.STALE_SECONDS
    os.utime(other, (other.stat().st_mtime - old, other.stat().st_mtime - old))
    temporary.clear(tmp_path)
    assert list(tmp_path.iterdir()) == [mine]
