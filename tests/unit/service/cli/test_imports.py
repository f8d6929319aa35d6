"""Libraries of the server and of other formats cost `lagid identify` time and do nothing for it."""

import subprocess
import sys
from pathlib import Path

RUN = """
import sys
from service.cli.main import main

words = ["--channels", "u=u", "--set", "algorithm.generations=9", "--set", "prediction=none"]
sys.argv = ["lagid", "identify", sys.argv[1], "--model", "fopdt", *words]
try:
    main()
finally:
    print(sorted({"sqlalchemy", "fastapi", "httpx", "asyncio", "mcap", "ray"} & set(sys.modules)))
"""


def test_identify_imports_nothing_that_it_does_not_need(tmp_path: Path) -> None:
    data = tmp_path / "d.csv"
    data.write_text("t,u,y\n" + "".join(f"{0.1 * k},{k % 3},{k}\n" for k in range(20)))
    done = subprocess.run(
        [sys.executable, "-c", RUN, data], capture_output=True, text=True, timeout=60, check=False
    )
    assert "prediction" in done.stderr, done.stderr  # refused before anything is compiled
    assert done.stdout.splitlines() == ["[]"]


SHORT = """
import sys
import numpy as np
from sysid.residuals.autocorrelation import space_residuals
from sysid.residuals.restricted_likelihood import fit_noise_colour

walk = np.cumsum(np.random.default_rng(0).standard_normal(60))
assert fit_noise_colour(space_residuals(np.arange(60.0), walk), np.ones((60, 1))) is not None
print("scipy.signal" in sys.modules)
"""


def test_the_colour_of_a_short_record_loads_no_filters_of_signals() -> None:
    """They took half a second, four fifths of what its first use in a process does."""
    done = subprocess.run(
        [sys.executable, "-c", SHORT], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.split() == ["False"], done.stderr
