"""A job on a recording with an outage: its experiments are counted and fitted as they are cut."""

import numpy as np
from starlette.testclient import TestClient

from benchmarks.judgement_kinds import draw_case
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import CSV, parts_of


def write_gap() -> bytes:
    """A sound record of which rows 120 to 199 are missing."""
    logged = draw_case("sound_fopdt", 41_004).logged
    kept = np.delete(np.arange(logged["t"].size), np.arange(120, 200))
    columns = zip(*(logged[name][kept].tolist() for name in ("t", "u", "y")), strict=True)
    rows = [f"{t:.6g},{u:.9g},{y:.9g}" for t, u, y in columns]
    return "\n".join(["t,u,y", *rows, ""]).encode()


def test_a_job_fits_the_parts_between_outages_as_experiments(server: TestClient) -> None:
    stored = server.post("/v1/datasets?name=gap", content=write_gap(), headers=CSV).json()
    assert "u" in stored["details"]["outages"]
    body = {
        "model": "fopdt",
        "datasets": [stored["id"]],
        "initial": "free",
        "parameters": {"x(0)[2]": {"lower": -1000.0, "upper": 1000.0}},
        "weights": {"y": [1.0, 2.0]},
    }
    job, (run,) = identify_job(parts_of(server), body)
    result = server.get(f"/v1/runs/{run}").json()
    assert "x(0)[2]" in [one["name"] for one in result["parameters"]]
    assert "outage" in [one["explanation"] for one in result["findings"]]
    assert server.get(f"/runs/{run}").status_code == 200
    assert server.get(f"/v1/runs/{run}/figures/response?experiment=1").status_code == 200
    wrong = server.post("/v1/jobs", json={**body, "weights": {"y": [1.0, 2.0, 3.0]}})
    assert wrong.status_code == 422
    assert job
