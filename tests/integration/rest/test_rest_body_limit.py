"""Bodies that are too large: refused before they are read, or as soon as they are too long."""

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from threading import get_ident
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from service.api.requests import bodies, middleware
from service.api.requests.middleware import BodyLimit, BodyPace
from service.core.errors import InvalidRequest, StalledRequest, TooLarge
from service.core.settings import Settings
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.web_app import CSV, await_in_thread, read_faults, recording, settings_of

LIMIT = 20_000


@pytest.fixture(scope="module")
def limited_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    settings = settings_of(tmp_path_factory.mktemp("limited"), max_body_bytes=LIMIT)
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


ROUTES = [
    "/v1/jobs",
    "/v1/recipes/noise-sweep",
    "/v1/recipes/reidentify",
    "/v1/runs:compare",
    "/v1/datasets:simulate",
    "/v1/models",
]
JSON = {"content-type": "application/json"}


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("is_chunked", [False, True])
def test_a_body_over_the_limit_is_a_problem_document_that_tells_the_limit(
    limited_server: TestClient, route: str, is_chunked: bool
) -> None:
    pieces = [b"[", b" " * LIMIT, b"]"]
    content: Any = iter(pieces) if is_chunked else b"".join(pieces)
    answer = limited_server.post(route, content=content, headers=JSON)
    read_faults(answer, 413, "too-large")
    assert str(LIMIT) in answer.json()["detail"]
    assert "LAGID_MAX_BODY_BYTES" in answer.json()["detail"]


def test_a_body_within_the_limit_and_an_upload_are_read(limited_server: TestClient) -> None:
    body = json.dumps({"model": "fopdt", "datasets": ["none"]}).encode().ljust(LIMIT)
    read_faults(limited_server.post("/v1/jobs", content=body, headers=JSON), 422, "invalid")
    long = recording(3000)
    assert len(long) > LIMIT
    assert limited_server.post("/v1/datasets", content=long, headers=CSV).status_code == 201


def read(headers: list[tuple[bytes, bytes]], pieces: int) -> int:
    """How many pieces of 10 bytes an application is given that reads all of a body."""
    taken = 0

    async def receive() -> dict[str, Any]:
        nonlocal taken
        taken += 1
        return {"type": "http.request", "body": b"x" * 10, "more_body": taken < pieces}

    async def application(scope: Any, receive: Any, send: Any) -> None:
        while (await receive())["more_body"]:
            await asyncio.sleep(0)

    async def play() -> None:
        scope = {"type": "http", "method": "POST", "path": "/v1/jobs", "headers": headers}
        with pytest.raises(TooLarge):
            await BodyLimit(application, 35)(scope, receive, receive)

    await_in_thread(play)
    return taken


def test_nothing_of_a_long_body_is_read_and_of_one_of_unknown_length_no_more_than_the_limit() -> (
    None
):
    assert read([(b"content-length", b"1000")], 100) == 0
    assert read([], 100) == 4


class Sender:
    """Sends pieces of a body with pauses, and then nothing."""

    def __init__(self, pieces: list[tuple[float, bytes]]) -> None:
        self.pieces = list(pieces)

    async def __call__(self) -> dict[str, Any]:
        if not self.pieces:
            await asyncio.sleep(LIMIT_SECONDS)
        pause, piece = self.pieces.pop(0)
        await asyncio.sleep(pause)
        return {"type": "http.request", "body": piece, "more_body": piece != b"end"}


def receive_all(sender: Sender, thinking: float = 0.0) -> int:
    """The bytes that an application gets, which may take its time between two pieces."""
    sizes = []

    async def application(scope: Any, receive: Any, send: Any) -> None:
        is_complete = False
        while not is_complete:
            message = await receive()
            sizes.append(len(message["body"]))
            is_complete = not message["more_body"]
            await asyncio.sleep(thinking)

    async def play() -> None:
        await BodyPace(application)({"type": "http", "method": "POST"}, sender, sender)

    await_in_thread(play)
    return sum(sizes)


def test_a_body_that_stops_or_trickles_is_refused_and_one_that_waits_for_us_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(middleware, "BODY_SECONDS", 0.5)
    monkeypatch.setattr(middleware, "BODY_RATE", 100.0)
    end = (0.0, b"end")
    trickle = [(0.2, b"x")] * 10
    for pieces in ([(0.0, b"x")], trickle, [*trickle, end]):
        with pytest.raises(StalledRequest, match=r"100 bytes a second after the first 0\.5 s"):
            receive_all(Sender(pieces))
    steady = [(0.1, b"x" * 20)] * 10  # 200 bytes a second
    assert receive_all(Sender([*steady, end])) == 203
    assert receive_all(Sender([(0.0, b"x")] * 8 + [end]), thinking=0.1) == 11
    monkeypatch.setattr(middleware, "MAX_PAUSE_SECONDS", 0.2)
    with pytest.raises(StalledRequest, match=r"nothing for 0\.2 s"):
        receive_all(Sender([(0.0, b"x" * 10_000), (0.6, b"x")]))


def test_a_sweep_over_forty_thousand_labelled_values_is_within_the_limit(
    tmp_path: Path,
) -> None:
    axis = {
        "path": "/datasets",
        "values": [["ds_0123456789abcdefghjkmnpqrs"]] * 40_000,
        "labels": [{"pressure_bar": 1.2345678901234567 + k, "length_m": k} for k in range(40_000)],
    }
    body = {"model": "fopdt", "datasets": ["ds"], "sweep": {"axes": [axis]}}
    assert len(json.dumps(body)) < Settings(data_dir=tmp_path).max_body_bytes


@pytest.mark.parametrize(
    ("axis", "pointer"),
    [
        ({"zip": "z" * 101}, "/sweep/axes/0/zip"),
        ({"labels": [{f"l{n}": n for n in range(33)}]}, "/sweep/axes/0/labels/0"),
        ({"values": [0] * 1_000_001}, "/sweep/axes/0/values"),
    ],
)
def test_lengths_of_an_axis_are_bounded(own: TestClient, axis: Any, pointer: str) -> None:
    body = {
        "model": "fopdt",
        "datasets": ["none"],
        "sweep": {"axes": [{"path": "/seed", "values": [1], **axis}]},
    }
    faults = read_faults(own.post("/v1/jobs", json=body), 422, "invalid")
    assert [one["pointer"] for one in faults] == [pointer]  # of type: no other is sought


def test_the_fields_of_an_object_are_counted_before_they_are_looked_at(own: TestClient) -> None:
    paths = own.get("/openapi.json").json()["paths"]
    routes = [
        (method, path.replace("{", "").replace("}", ""))
        for path, methods in paths.items()
        for method, operation in methods.items()
        if "application/json" in operation.get("requestBody", {}).get("content", {})
    ]
    assert {("post", "/v1/jobs"), ("post", "/v1/models"), ("put", "/v1/references/name")} <= {
        *routes
    }
    many = {f"k{n}": 1 for n in range(30_000)}
    told = "an object of the body has 30000 fields; at most 10000 are read"
    for method, path in routes:
        answer = own.request(method, path, json={"model": many})
        if path == "/v1/models:check":
            assert answer.json()["errors"][0]["detail"] == told
        else:
            assert read_faults(answer, 422, "invalid") == [{"pointer": "", "detail": told}]


def test_more_faults_than_anybody_reads_are_counted_and_not_described(own: TestClient) -> None:
    axis: dict[str, Any] = {"path": "/seed", "values": [1], "labels": [0] * 10_001}
    body = {"model": "fopdt", "datasets": ["none"], "sweep": {"axes": [axis]}}
    [fault] = read_faults(own.post("/v1/jobs", json=body), 422, "invalid")
    assert fault["pointer"] == ""
    assert "the body has 10001 faults" in fault["detail"]
    axis["labels"].pop()
    faults = read_faults(own.post("/v1/jobs", json=body), 422, "invalid")
    assert faults[-1]["detail"] == "9000 more faults are not listed"


def test_long_bodies_are_read_outside_the_event_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[int] = []

    def read(body: bytes, kind: Any) -> int:
        threads.append(get_ident())
        return len(body)

    async def play() -> int:
        for size in (bodies.SMALL_BODY_BYTES, bodies.SMALL_BODY_BYTES + 1):

            async def receive(size: int = size) -> dict[str, Any]:
                return {"type": "http.request", "body": b" " * size, "more_body": False}

            scope = {"type": "http", "method": "POST", "path": "/", "headers": []}
            assert await bodies._JsonRequest(scope, receive).json() == size
        return get_ident()

    monkeypatch.setattr(bodies, "_read_body", read)
    loop = await_in_thread(play)
    assert [thread == loop for thread in threads] == [True, False]


@pytest.mark.parametrize(
    ("document", "told"),
    [
        ({"model": [{}] * 100_000}, "100002 lists and objects with 1 fields"),
        ({"model": [{f"k{n}": n for n in range(9000)}] * 23}, "25 lists and objects with 207001 "),
    ],
)
def test_objects_and_fields_are_counted_before_anything_is_made_of_them(
    own: TestClient, monkeypatch: pytest.MonkeyPatch, document: Any, told: str
) -> None:
    monkeypatch.setattr(bodies, "check_shape", None)  # what would follow
    content = json.dumps(document, separators=(",", ":")).encode()
    for path in ("/v1/jobs", "/v1/models"):
        [fault] = read_faults(own.post(path, content=content, headers=JSON), 422, "invalid")
        assert told in fault["detail"]


def test_brackets_and_colons_inside_texts_do_not_count() -> None:
    text = "[{:" * bodies.MAX_CONTAINERS + '\\"[{'
    bodies.check_counts(json.dumps({text: [text, 1]}).encode())


def test_quotes_without_an_end_are_counted_at_once() -> None:
    """Each quote would else search to the end of the body: hours for a body of 4 MB."""
    torn = b"[{" * bodies.MAX_CONTAINERS + b'"' + b'\\"' * 300_000
    with pytest.raises(InvalidRequest):
        bodies.check_counts(torn)
