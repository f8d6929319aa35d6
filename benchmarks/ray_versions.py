"""The oldest Ray that is declared, and the newest one that there is, under the tests of workers.

Each is installed into a folder of its own, in front of the import path. A newer Ray than the
declared range is only tried: it tells early what the next version of lagid must know.
"""

import os
import re
import subprocess
import sys
from importlib.metadata import requires
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.table import Row, Skipped, parser, report
from tests.support.checkout import ROOT

TESTS = ("tests/integration/workers", "tests/unit/service/dispatch/test_process.py")
INSTALL_SECONDS, TEST_SECONDS = 900.0, 1800.0


def read_oldest() -> str:
    """Read the oldest version that lagid declares."""
    declared = next(line for line in requires("lagid") or () if re.match(r"ray\b", line))
    found = re.search(r">=\s*([\d.]+)", declared)
    assert found is not None
    return found[1]


def install(wanted: str, folder: Path) -> str | None:
    """Install a version of Ray into a folder; return it, or None if no index is reached."""
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(folder)]
    try:
        done = subprocess.run([*pip, wanted], timeout=INSTALL_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return None
    found = next(folder.glob("ray-*.dist-info"), None)
    if done.returncode or found is None:
        return None
    return found.name.removeprefix("ray-").removesuffix(".dist-info")


def count_failures(folder: Path) -> int:
    """Run the tests with the Ray of a folder; count what failed, 1 if they could not be run."""
    path = os.pathsep.join((str(folder), str(ROOT)))
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", *TESTS],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": path},
            capture_output=True,
            text=True,
            timeout=TEST_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return 1
    print(done.stdout[-3000:])
    failed = sum(int(n) for n in re.findall(r"(\d+) (?:failed|error)", done.stdout))
    return failed or min(done.returncode, 1)


def main() -> None:
    """Try both versions and print the table."""
    options = parser(__doc__ or "").parse_args()
    rows, skipped = [], []
    for what, wanted in (("oldest", f"ray=={read_oldest()}"), ("newest", "ray")):
        with TemporaryDirectory(prefix="lagid-ray-") as folder:
            found = install(wanted, Path(folder))
            if found is None:
                skipped.append(Skipped(f"{what} Ray", f"pip could not install {wanted}"))
                continue
            rows.append(
                Row(f"failures with the {what} Ray, {found}", count_failures(Path(folder)), "", 0)
            )
    report("Versions of Ray", rows, skipped, options)


if __name__ == "__main__":
    main()
