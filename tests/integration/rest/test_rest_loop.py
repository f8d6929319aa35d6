"""A job with noise inside the plant and with a controller's command, over REST."""

from typing import Any

import pytest
from starlette.testclient import TestClient

from service.api.requests.dependencies import Parts
from tests.integration.sysid.test_loop import make_loop
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import parts_of, read_faults, store_csv

SMALL = {"population": 24, "generations": 20, "islands": 1}
LOAD = {"noise_model": "load"}


@pytest.fixture(scope="module")
def loop(server: TestClient) -> str:
    (u,), (y,) = make_loop().inputs, make_loop().outputs
    rows = zip(u.times.tolist(), u.values.tolist(), y.values.tolist(), strict=True)
    lines = ["t,u,y", *(f"{t!r},{a!r},{b!r}" for t, a, b in rows)]
    return store_csv(server, "\n".join(lines).encode(), "loop")


@pytest.fixture
def parts(server: TestClient) -> Parts:
    return parts_of(server)


def write_job(loop: str, **more: Any) -> dict[str, Any]:
    return {"model": "fopdt", "datasets": [loop], "algorithm": SMALL, **more}


def test_sizes_of_noise_are_changed_as_any_parameter(
    server: TestClient, parts: Parts, loop: str
) -> None:
    changes = {"load[u]": {"lower": 0.5, "upper": 50.0}, "tau[u]": {"fixed": 50.0}}
    _, (name,) = identify_job(parts, write_job(loop, loss=LOAD, parameters=changes))
    run = server.get(f"/v1/runs/{name}").json()
    assert run["state"] == "succeeded", run["error"]
    known = {one["name"]: one for one in run["parameters"]}
    assert (known["load[u]"]["lower"], known["load[u]"]["upper"]) == (0.5, 50.0)
    assert (known["tau[u]"]["value"], known["tau[u]"]["status"]) == (50.0, "fixed")


def test_faults_of_noise_and_commands_are_at_their_places(server: TestClient, loop: str) -> None:
    size = {"load[u]": {"upper": 50.0}}
    for more, pointer, detail in (
        ({"parameters": size}, "/parameters/load[u]", "Set loss: {noise_model: load}"),
        ({"parameters": {"load[w]": {"upper": 2.0}}, "loss": LOAD}, "/parameters/load[w]", "load["),
        (
            {"parameters": {"load[u]": {"lower": -1.0}}, "loss": LOAD},
            "/parameters/load[u]",
            "log",
        ),
        ({"commands": ["v"]}, "/commands/0", "no input 'v'"),
    ):
        response = server.post("/v1/jobs", json=write_job(loop, **more))
        (fault,) = read_faults(response, 422, "invalid")
        assert fault["pointer"].startswith(pointer)
        assert detail in fault["detail"]


def test_a_recognised_command_is_held_where_signals_are_computed_again(
    server: TestClient, parts: Parts, loop: str
) -> None:
    bodies = [
        write_job(loop, commands=["u"]),
        write_job(loop, keep_signals=True, reuse=False),
        write_job(loop, keep_signals=False, reuse=False),
    ]
    names = [identify_job(parts, body)[1][0] for body in bodies]
    documents = [server.get(f"/v1/runs/{name}").json() for name in names]
    for document in documents:
        assert document["commands"] == ["u"]
        assert document["noise_model"] == "load"
        assert [one["chosen"] for one in document["input_hold"]] == ["zero"]
    shown = [server.get(f"/v1/runs/{name}/response?max_points=10000").json() for name in names]
    stored, again = (one["experiments"][0]["simulated"] for one in shown[1:])
    assert stored == again
