"""What tests of the REST interface share."""

import asyncio
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

import httpx
import numpy as np
from starlette.testclient import TestClient

from service.api.requests.dependencies import Parts
from service.core.settings import Settings
from service.datasets.datasets import add_recording, hash_source
from service.formats.read_options import ReadOptions
from service.formats.tabular.csv_recordings import read_csv
from tests.support.storage.databases import copy_sqlite_template

CSV = {"content-type": "text/csv"}
PROBLEM = "application/problem+json"


def recording(n: int = 300, period: float = 0.1, columns: tuple[str, ...] = ("u", "y")) -> bytes:
    """CSV of a step response with gain 2, time constant 1 s and dead time 0.5 s.

    It has a little noise. Without any, half the integration step changes every estimate by more
    than its standard error, and each identification goes on to hundreds of substeps.
    """
    t = np.arange(n) * period
    u = np.where((t // 7) % 2 == 0, 0.0, 1.0)
    y = np.zeros(n)
    lag = round(0.5 / period)
    for k in range(1, n):
        y[k] = y[k - 1] + period * (2 * u[max(k - 1 - lag, 0)] - y[k - 1])
    y += np.random.default_rng(1).normal(0.0, 0.005, n)
    rows = [",".join(["t", *columns])]
    rows += [f"{a:.6g},{b:.6g},{c:.6g}" for a, b, c in zip(t, u, y, strict=True)]
    return ("\n".join(rows) + "\n").encode()


T = TypeVar("T")


def await_in_thread(work: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """What a coroutine gives, in a thread of its own: a browser test may have left a loop here."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(lambda: asyncio.run(work())).result()


def settings_of(folder: Path, **changes: object) -> Settings:
    """Settings of a data folder whose database has the tables of today."""
    folder.mkdir(parents=True, exist_ok=True)
    copy_sqlite_template(folder)
    # Tests claim jobs without a heartbeat, and compile between two writes: the lease is long.
    values = {
        "data_dir": folder,
        "poll_seconds": 0.02,
        "lease_seconds": 3600,
        "allowed_hosts": ("testserver",),  # the name that Starlette's test client asks for
        **changes,
    }
    return Settings.model_validate(values)


def parts_of(server: TestClient) -> Parts:
    parts: Parts = server.app.state.parts  # type: ignore[attr-defined]
    return parts


def store_csv(
    server: TestClient, content: bytes, name: str = "steps", segments: Sequence[str] = ()
) -> str:
    """Store a recording as its upload does, without the process that reads uploads: 0.3 s each."""
    return store_csv_in(parts_of(server), content, name, segments)


def store_csv_in(
    parts: Parts, content: bytes, name: str = "steps", segments: Sequence[str] = ()
) -> str:
    """The same for the project that these parts show."""
    options = ReadOptions(segments=tuple(segments))
    source = {
        "sha256": sha256(content).hexdigest(),
        "format": "csv",
        **options.list_given(),
    }
    read, notes = read_csv(content, options)
    details = {"source": source, "warnings": list(notes)}
    key = hash_source(source)
    return add_recording(
        parts.database, parts.store, read, name=name, kind="upload", key=key, details=details
    ).dataset.id


def read_faults(answer: Any, status: int, kind: str) -> list[dict[str, Any]]:
    """The faults of a problem document, after a look at its form."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == PROBLEM
    document = answer.json()
    assert document["type"] == f"/problems/{kind}"
    assert document["status"] == status
    assert document["title"]
    assert document["detail"]
    assert "Traceback" not in answer.text
    return list(document.get("errors", []))


class Through(httpx.BaseTransport):
    """Sends a client's requests to an application of this process."""

    def __init__(self, server: TestClient) -> None:
        self._server = server

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        answer = self._server.request(
            request.method, str(request.url), content=request.read(), headers=dict(request.headers)
        )
        headers = [(k, v) for k, v in answer.headers.items() if k != "content-encoding"]
        return httpx.Response(answer.status_code, headers=headers, content=answer.content)
