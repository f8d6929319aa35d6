"""docs/client.md: every snippet runs, one after the other, against a server."""

import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.api.app import create_app
from service.api.requests.dependencies import Parts
from service.client.client import Client
from service.core.states import JobState
from service.repositories.job_rows import JobRepository
from tests.support.checkout import ROOT
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.local_runs import carry_out_job
from tests.support.service.web_app import settings_of
from tests.support.service.web_server import serve_in_thread

PAGE = (ROOT / "docs/client.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
ADDRESS = "http://127.0.0.1:8000"


class _Worker(threading.Thread):
    """Carries out what is queued, as a dispatcher would."""

    def __init__(self, parts: Parts) -> None:
        super().__init__(daemon=True)
        self._parts, self.ended = parts, threading.Event()

    def run(self) -> None:
        while not self.ended.wait(0.02):
            with self._parts.database.read_session() as session:
                queued = JobRepository(session).list_page(limit=10, states=[JobState.QUEUED]).items
                waiting = [job.id for job in queued]
            for job in reversed(waiting):
                carry_out_job(self._parts, job)


@pytest.fixture
def url(tmp_path: Path) -> Iterator[str]:
    app = create_app(settings_of(tmp_path))
    with serve_in_thread(app) as address:
        worker = _Worker(app.state.parts)
        worker.start()
        try:
            yield address
        finally:
            worker.ended.set()
            worker.join(timeout=LIMIT_SECONDS)


def test_the_page_shows_every_recipe_and_what_follows_it() -> None:
    for name in (
        "noise_sweep",
        "reidentify",
        "wait",
        "summary",
        "trend",
        "accept_reference",
        "validate_run",
        "simulate_run",
        "ProblemError",
    ):
        assert any(name in snippet for snippet in SNIPPETS), name


def test_every_method_that_the_page_names_is_there() -> None:
    for name in re.findall(r"\bclient\.([a-z]\w*)", PAGE):
        assert hasattr(Client, name), name


@pytest.mark.slow
def test_the_snippets_run_one_after_the_other(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    known: dict[str, Any] = {}
    assert any(ADDRESS in snippet for snippet in SNIPPETS)
    for snippet in SNIPPETS:
        exec(compile(snippet.replace(ADDRESS, url), "docs/client.md", "exec"), known)
    told = capsys.readouterr().out
    assert re.search(r"^L = 0\.\d+ ± 0\.\d+ s   identified$", told, re.MULTILINE)
    assert re.search(r"fit 9\d\.\d %", told)
    assert "{'/noise/sigma': 0.1, '/algorithm/method': 'improved'} 3 of 3" in told
    assert re.search(r"^L a.* \(0\.\d+, ", told, re.MULTILINE)
    assert "/algorithm/population" in told
