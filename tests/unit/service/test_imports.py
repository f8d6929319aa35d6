"""What each entry of the program loads: a library that it does not need costs its start time."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.checkout import ROOT

# Statements of one process, in order. What is loaded stays loaded, so a later entry may only be
# forbidden what no earlier one needs.
SERVICE = {
    "client": "import service.client.client",
    "dispatcher": "import service.dispatch.process",
    "web application": "import service.api.app",
}
COMMANDS = {
    "command line": "import service.cli.main",
    "identify": "identify()",
    "search": "import sysid.identification.identify",
    "whole identification": "identify_white()",
    "colour of a short record": "fit_short_record()",
}

PROGRAM = """
import contextlib, io, json, sys

def identify():
    words = ["--channels", "u=u", "--set", "algorithm.generations=9", "--set", "prediction=none"]
    sys.argv = ["lagid", "identify", sys.argv[2], "--model", "fopdt", *words]
    text = io.StringIO()
    with contextlib.redirect_stderr(text), contextlib.suppress(SystemExit):
        service.cli.main.main()
    assert "prediction" in text.getvalue()  # refused before anything is compiled

def identify_white():
    import numpy as np
    from lagid import Channel, Record, identify, load_model

    t, noise = np.arange(60.0), np.random.default_rng(0).standard_normal(60)
    u = Channel("u", t, np.where(t < 5.0, 0.0, 1.0))
    y = Channel("y", t, 2.0 - 2.0 * np.exp(-np.maximum(t - 8.0, 0.0) / 5.0) + 0.01 * noise)
    assert identify(load_model("fopdt"), Record((u,), (y,))).residual_tests.passed

def fit_short_record():
    import numpy as np
    from sysid.residuals.autocorrelation import space_residuals
    from sysid.residuals.restricted_likelihood import fit_noise_colour

    walk = np.cumsum(np.random.default_rng(0).standard_normal(60))
    assert fit_noise_colour(space_residuals(np.arange(60.0), walk), np.ones((60, 1))) is not None

loaded = {}
for entry, statement in json.loads(sys.argv[1]).items():
    exec(statement)
    loaded[entry] = sorted(sys.modules)
print(json.dumps(loaded))
"""


@pytest.fixture(scope="module")
def loaded_modules(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Names of all modules that are loaded after each entry."""
    data = tmp_path_factory.mktemp("imports") / "d.csv"
    data.write_text("t,u,y\n" + "".join(f"{0.1 * k},{k % 3},{k}\n" for k in range(20)))
    return {
        entry: set(names)
        for statements in (SERVICE, COMMANDS)
        for entry, names in run_statements(statements, data).items()
    }


def run_statements(statements: dict[str, str], data: Path) -> dict[str, list[str]]:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(statements), data],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    names: dict[str, list[str]] = json.loads(done.stdout)
    return names


@pytest.mark.parametrize(
    ("entry", "heavy"),
    [
        ("client", {"numpy", "ray", "sysid", "fastapi", "sqlalchemy", "pydantic"}),
        # Ray starts first, and meanwhile all else is imported.
        ("dispatcher", {"ray", "numpy", "numba", "sqlalchemy", "service.dispatch.dispatcher"}),
        (
            "web application",
            {"ray", "workers.tasks", "workers.ray_executor", "numba", "llvmlite"},
        ),
        ("command line", {"numpy"}),
        (
            "identify",
            {"sqlalchemy", "fastapi", "httpx", "asyncio", "mcap", "ray", "polars"}
            | {"pandas", "plotly"}
            | {f"service.cli.{group}" for group in ("access", "datasets", "jobs", "server")},
        ),
        # SciPy's functions are loaded while the search runs.
        ("search", {"scipy.special"}),
        ("whole identification", {"psutil", "sysid.kernels.kernel"}),
        # They took half a second, four fifths of what its first use in a process does.
        ("colour of a short record", {"scipy.signal"}),
    ],
)
def test_an_entry_loads_no_library_that_it_does_not_need(
    loaded_modules: dict[str, set[str]], entry: str, heavy: set[str]
) -> None:
    assert "service" in loaded_modules[entry]
    assert heavy & loaded_modules[entry] == set()
