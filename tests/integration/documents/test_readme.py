"""README.md: each block of commands works, word for word, on a server without any data."""

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.api.app import create_app
from service.dispatch.dispatcher import Dispatcher
from service.dispatch.held_leases import HeldLeases
from tests.support.checkout import ROOT
from tests.support.cluster.inline_executor import InlineExecutor
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.web_app import settings_of
from tests.support.service.web_server import serve_in_thread

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

PAGE = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```sh\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
FILES = re.findall(r"^```yaml\n(# (\S+)\n.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
# A recording of one's own is the reader's; the environment is made by make, which is not run here.
ACTIVATE = f'PATH="{Path(sys.executable).parent}:$PATH"\n'
MAKE = f'make() {{ command make --dry-run --directory="{ROOT}" "$@"; }}\n'


@pytest.fixture
def url(tmp_path: Path) -> Iterator[str]:
    app = create_app(settings_of(tmp_path / "data"))
    with serve_in_thread(app) as address:
        parts = app.state.parts
        leases = HeldLeases(parts.database, 60.0)
        dispatcher = Dispatcher(parts.database, parts.store, InlineExecutor(), leases)
        thread = threading.Thread(target=dispatcher.run_until_stopped)
        thread.start()
        try:
            yield address
        finally:
            dispatcher.stopping.set()
            thread.join(LIMIT_SECONDS)


def write_recording(path: Path) -> None:
    """Write a recording with the channels that the page's job names."""
    rows, pressure = ["t,P1 [Pa],P2 [Pa]"], 0.0
    for k in range(400):
        rows.append(f"{0.01 * k:.2f},{1e5 * is_open(k)},{pressure:.1f}")
        pressure += 0.05 * (1e5 * is_open(k - 10) - pressure)
    path.write_text("\n".join(rows))


def is_open(k: int) -> int:
    return k // 50 % 2


def test_each_block_of_commands_works_on_an_empty_server(tmp_path: Path, url: str) -> None:
    assert len(BLOCKS) == 4
    assert [name for _, name in FILES] == ["job.yaml"]
    folder = tmp_path / "work"
    (folder / ".venv/bin").mkdir(parents=True)
    (folder / ".venv/bin/activate").write_text(ACTIVATE)
    for text, name in FILES:
        (folder / name).write_text(text)
    write_recording(folder / "recording.csv")
    for block in BLOCKS:
        done = subprocess.run(
            ["bash", "-e", "-c", MAKE + ACTIVATE + block],
            cwd=folder,
            env={**os.environ, "LAGID_URL": url, "PYTHONPATH": str(ROOT), "NO_COLOR": "1"},
            capture_output=True,
            text=True,
            timeout=3 * LIMIT_SECONDS,
            check=False,
        )
        assert done.returncode == 0, f"{block}\n{done.stdout}\n{done.stderr}"
