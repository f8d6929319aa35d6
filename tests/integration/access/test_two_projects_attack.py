"""Two projects with keys attack each other over every route of the application, and see nothing."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any, get_args

import pytest
from fastapi.routing import APIRoute
from sqlalchemy import select

from service.access.scopes import find_needed_scope
from service.jobs.job_schemas import ReferenceIn
from service.jobs.references import accept_reference
from service.models.models import add_model
from service.repositories.audit_rows import list_actions
from service.storage.tables import DEFAULT_PROJECT, ApiKey, AuditEntry, Base, Project
from sysid.models.catalogue.load import copy_catalogue_document
from sysid.results.figures import FigureName
from tests.support.service.keyed_service import Guarded
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import CSV, recording, store_csv_in

FAST = {"population": 20, "generations": 15, "islands": 1, "refine": False}
JSON = {"content-type": "application/json"}
IDS = ("job_id", "run_id", "dataset_id", "key_id")
FIGURES = list(get_args(FigureName))


@dataclass(frozen=True)
class Side:
    """A project with its key and what it has. `mark` is in every text that a user can write."""

    project: str
    key: str
    mark: str
    ids: dict[str, list[str]]

    @property
    def dataset(self) -> str:
        return self.ids["dataset_id"][0]

    @property
    def run(self) -> str:
        return self.ids["run_id"][0]

    @property
    def model(self) -> str:
        return self.ids["name"][0]

    @property
    def reference(self) -> str:
        return self.ids["name"][1]


@pytest.fixture(scope="module")
def sides(keyed_service: Guarded) -> tuple[Side, Side]:
    """The default project, and another one."""
    return (
        _fill(keyed_service, DEFAULT_PROJECT, "alphamark"),
        _fill(keyed_service, keyed_service.add_project("other"), "betamark"),
    )


def _fill(keyed_service: Guarded, project: str, mark: str) -> Side:
    parts, key = keyed_service.parts_for(project), keyed_service.add_key(project)
    dataset = store_csv_in(parts, recording(), f"steps {mark}")
    store_csv_in(parts, recording(n=100), "own")
    document = {**copy_catalogue_document("fopdt"), "name": f"lag-{project[-6:].replace('_', '-')}"}
    document |= {"title": f"model of {mark}", "description": mark}
    with parts.database.write_session() as session:
        model = add_model(session, document).name
    body = {
        "model": model,
        "name": f"job {mark}",
        "datasets": [dataset],
        "algorithm": FAST,
        "sweep": {"axes": [{"path": "/seed", "values": [1, 2]}]},
    }
    job, runs = identify_job(parts, body)
    reference = f"accepted-{project[-6:]}"
    with parts.database.write_session() as session:
        accept_reference(session, reference, ReferenceIn(run=runs[0], note=mark))
    with parts.database.read_session() as session:
        row = session.scalar(select(ApiKey.id).where(ApiKey.project_id == project))
    ids = {"job_id": [job], "run_id": runs, "dataset_id": [dataset], "key_id": [str(row)]}
    return Side(project, key, mark, {**ids, "name": [model, reference], "kind": ["quota"]})


def _list_routes(keyed_service: Guarded) -> list[tuple[str, APIRoute]]:
    entries: list[Any] = list(keyed_service.client.app.routes)  # type: ignore[attr-defined]
    found = []
    while entries:
        entry = entries.pop()
        if isinstance(entry, APIRoute):
            found += [(method, entry) for method in sorted(entry.methods)]
        elif hasattr(entry, "original_router"):
            entries += entry.original_router.routes
    return found


def _list_bodies(method: str, path: str, victim: Side) -> list[dict[str, Any]]:
    """The arguments of requests that name what the victim has, by the path of a route."""
    channels = {"u": "u", "y": "y"}
    job = {"model": "fopdt", "datasets": [victim.dataset], "channels": channels}
    own = {**job, "datasets": ["own"]}
    entry = {"x": 1, "datasets": [victim.dataset]}
    dataset_input = {"kind": "dataset", "dataset": victim.dataset, "channel": "u"}
    simulated = {
        "parameters": {"K": 1, "T": 1, "L": 0.1, "y0": 0},
        "samples": 50,
        "sample_time": 0.1,
    }
    bodies: dict[str, list[Any]] = {
        "/v1/jobs": [
            job,
            {**job, "datasets": [f"steps {victim.mark}"]},
            {**own, "model": victim.model},
            {**own, "warm_start": victim.run},
            {**own, "warm_start": f"reference:{victim.reference}"},
            {**own, "validation": {"datasets": [victim.dataset]}},
            {**own, "sweep": {"axes": [{"path": "/datasets", "values": [[victim.dataset]]}]}},
        ],
        "/v1/recipes/noise-sweep": [{"model": "fopdt", "datasets": [victim.dataset], "sigma": [0]}],
        "/v1/recipes/reidentify": [
            {"model": "fopdt", "label": "a", "batch": [entry]},
            {
                "model": "fopdt",
                "label": "a",
                "batch": [{**entry, "datasets": ["own"]}],
                "reference": victim.reference,
            },
        ],
        "/v1/datasets:simulate": [
            {"model": victim.model, **simulated, "inputs": {"u": {"kind": "step"}}},
            {"model": "fopdt", **simulated, "inputs": {"u": dataset_input}},
        ],
        "/v1/datasets:join": [{"datasets": [victim.dataset, victim.dataset]}],
        "/v1/datasets/{dataset_id}:derive": [{"steps": [{"trim": {"stop": 10}}]}],
        "/v1/runs/{run_id}:simulate": [
            {"inputs": {"u": {"kind": "step"}}, "samples": 200, "sample_time": 0.1, "store": True}
        ],
        "/v1/runs/{run_id}:validate": [{"dataset": victim.dataset}],
        "/v1/runs/{run_id}:profile": [{"points": 3}],
        "/v1/runs:compare": [{"runs": victim.ids["run_id"]}],
        "/v1/references/{name:path}": [{"run": victim.run}],
        "/v1/models": [{**copy_catalogue_document("fopdt"), "name": f"of-{len(victim.mark)}"}],
        "/v1/models:check": [{"name": victim.model}],
    }
    if method == "DELETE":
        return []  # what is deleted, others would not find
    if method == "PATCH":
        bodies = {path: [{"note": victim.mark, "tags": [victim.mark]}]}
    if path == "/v1/datasets":
        return [{"content": recording(n=60 + len(victim.mark)), "headers": CSV}]
    return [{"content": json.dumps(body), "headers": JSON} for body in bodies.get(path, [])]


def _list_requests(
    keyed_service: Guarded, victim: Side
) -> Iterator[tuple[str, APIRoute, str, Any]]:
    for method, route in _list_routes(keyed_service):
        is_reading = method in ("GET", "HEAD", "OPTIONS")
        arguments = [{}] if is_reading else _list_bodies(method, route.path, victim)
        if route.body_field is not None or "requestBody" in (route.openapi_extra or {}):
            assert arguments or route.path in ("/sign-in", "/keys"), f"no body for {route.path}"
        known = {**victim.ids, "path": ["README.md"]}
        known |= {"name": FIGURES} if "/figures/" in route.path else {}
        names = re.findall(r"{(\w+)(?::path)?}", route.path)
        values = [known[name] for name in names]
        for chosen in product(*values):
            path = route.path.replace(":path}", "}").format(**dict(zip(names, chosen, strict=True)))
            query = "?run=" + "&run=".join(victim.ids["run_id"]) if path == "/compare" else ""
            for one in arguments or [{}]:
                yield method, route, path + query, one


def test_the_walk_reaches_every_route_of_the_document(keyed_service: Guarded) -> None:
    walked = {route.path.replace(":path}", "}") for _, route in _list_routes(keyed_service)}
    assert walked >= set(keyed_service.client.app.openapi()["paths"])  # type: ignore[attr-defined]
    assert {"/", "/keys", "/jobs/{job_id}", "/pages/models/{name}.yaml"} <= walked


@pytest.mark.parametrize("direction", [0, 1], ids=["other on default", "default on other"])
def test_a_project_sees_and_changes_nothing_of_another(
    keyed_service: Guarded, sides: tuple[Side, Side], direction: int
) -> None:
    victim, attacker = sides[direction], sides[1 - direction]
    before = _read_rows(keyed_service, victim.project)
    seen = []
    for method, route, path, arguments in _list_requests(keyed_service, victim):
        answer = keyed_service.ask(method, path, attacker.key, **dict(arguments))
        told = (method, path, arguments, answer.status_code, answer.text[:300])
        sent = path + str(arguments.get("content", ""))
        if victim.mark not in sent:
            assert victim.mark not in answer.content.decode("latin-1"), told
        if any(f"{{{name}}}" in route.path for name in IDS) and method != "OPTIONS":
            assert answer.status_code in (404, 405), told
        theirs = (victim.dataset, victim.run, victim.model, victim.mark)
        names_theirs = any(name in sent for name in theirs)
        if names_theirs and "models:check" not in path and method != "OPTIONS":
            assert answer.is_error, told
        assert answer.status_code < 500 or path == "/readyz", told
        seen.append(answer.status_code)
    assert _read_rows(keyed_service, victim.project) == before
    assert seen.count(404) > 40


def test_the_same_requests_are_answered_to_who_owns_what_they_name(
    keyed_service: Guarded, sides: tuple[Side, Side]
) -> None:
    """Else the attack would be refused for another reason."""
    side = sides[1]
    marked, done, recorded = 0, set(), set()
    for method, route, path, arguments in _list_requests(keyed_service, side):
        if "content" in arguments:
            before = _count_actions(keyed_service, side)
            answer = keyed_service.ask(method, path, side.key, **dict(arguments))
            assert answer.is_success or "name" in route.path, (method, path, arguments, answer.text)
            if find_needed_scope(method, path) != "read":
                done.add(route.path)
                recorded |= {route.path} if _count_actions(keyed_service, side) > before else set()
        if method in ("GET", "HEAD") and any(f"{{{name}}}" in route.path for name in IDS):
            answer = keyed_service.ask(method, path, side.key, **dict(arguments))
            allowed = (200, 204, 404) if "figures" in path else (200, 204)
            allowed = (*allowed, 409, 422) if "trend" in path else allowed
            assert answer.status_code in allowed, (method, path, answer.text[:300])
            marked += side.mark in answer.text
    assert marked > 10
    assert done == recorded  # each kind of change is in the audit log
    assert len(done) > 7
    for path in ("/v1/jobs", "/v1/datasets", "/v1/models", "/", "/datasets"):
        assert side.mark in keyed_service.ask("GET", path, side.key).text


def test_equal_bytes_keys_and_runs_of_two_projects_stay_apart(
    keyed_service: Guarded, sides: tuple[Side, Side]
) -> None:
    content = recording(n=50)
    names = ("first", "second")
    stored = [
        keyed_service.ask(
            "POST", f"/v1/datasets?name={name}", side.key, content=content, headers=CSV
        )
        for side, name in zip(sides, names, strict=True)
    ]
    assert [answer.status_code for answer in stored] == [201, 201]
    assert [answer.json()["name"] for answer in stored] == list(names)
    assert stored[0].json()["sha256"] != ""
    assert stored[0].json()["id"] != stored[1].json()["id"]
    jobs = [
        keyed_service.ask(
            "POST",
            "/v1/jobs",
            side.key,
            json={"model": "fopdt", "datasets": [side.dataset], "algorithm": FAST},
            headers={"Idempotency-Key": "the same"},
        )
        for side in sides
    ]
    assert [answer.status_code for answer in jobs] == [202, 202]
    assert jobs[0].json()["id"] != jobs[1].json()["id"]
    # Both sides submitted the same computation: neither took the other's result.
    for side in sides:
        result = keyed_service.ask("GET", f"/v1/runs/{side.run}", side.key).json()
        assert "reused_from" not in result or result["reused_from"] is None


def _count_actions(keyed_service: Guarded, side: Side) -> int:
    with keyed_service.parts.database.read_session() as session:
        return len(list_actions(session, side.project, limit=1000).items)


def _read_rows(keyed_service: Guarded, project: str) -> dict[str, list[Any]]:
    """All rows that name the project, and those that belong to rows of it alone."""
    rows: dict[str, list[Any]] = {}
    skipped = (Project, ApiKey, AuditEntry)
    with keyed_service.parts.database.engine.connect() as connection:
        for table in Base.metadata.sorted_tables:
            if table.name in {kind.__tablename__ for kind in skipped}:
                continue
            query = table.select()
            if "project_id" in table.c:
                query = query.where(table.c.project_id == project)
            rows[table.name] = sorted(map(tuple, connection.execute(query)), key=repr)
    assert len(rows) > 10
    return rows
