"""Machine code on disk is used only with the sources it came from."""

import subprocess
import sys
from pathlib import Path

import pytest

from sysid.kernels import caching

PROGRAM = """
import sys
sys.path.insert(0, sys.argv[1])
from sysid.kernels import caching
caching.fingerprint = lambda: sys.argv[2]
from module import doubled
print(doubled(2.0), sum(doubled.stats.cache_hits.values()))
"""
MODULE = """
from sysid.kernels.caching import compiled

@compiled
def doubled(x):
    return 2.0 * x
"""


def test_the_fingerprint_covers_the_search_and_the_evaluation() -> None:
    package = Path(caching.__file__).parents[1]
    covered = {path for pattern in caching._SOURCES for path in package.glob(pattern)}
    assert package / "ga" / "gauss_newton.py" in covered
    assert package / "kernels" / "evaluation.py" in covered
    assert len(caching.fingerprint()) == 64


@pytest.mark.slow
def test_another_fingerprint_compiles_anew(tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(MODULE)

    def run(fingerprint: str) -> str:
        command = [sys.executable, "-c", PROGRAM, str(tmp_path), fingerprint]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    assert run("a") == "4.0 0"
    assert run("a") == "4.0 1"
    assert run("b") == "4.0 0"


WARM = """
import sys
from sysid.warming import warm_up
warm_up()
loaded = ("numba.np.arraymath", "numba.np.npyimpl", "scipy.special", "scipy.linalg")
print([name for name in loaded if name in sys.modules])
"""


@pytest.mark.slow
def test_what_was_compiled_before_is_loaded_without_the_compiler() -> None:
    for _ in range(2):  # the first may have to compile
        ran = subprocess.run(
            [sys.executable, "-c", WARM], check=True, capture_output=True, text=True
        )
    assert ran.stdout.strip() == "[]"
