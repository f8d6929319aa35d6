"""A model stored by an earlier version, which took what is refused now, can still be read."""

from typing import Any

from starlette.testclient import TestClient

from service.repositories.models import ModelRepository

OLD: dict[str, Any] = {
    "name": "old", "form": "difference", "inputs": {"u": "V"}, "states": {"x": "V"},
    "parameters": {"a": {"lower": 0, "upper": 1}, "L": {"lower": 0, "upper": 5, "unit": "s"}},
    "equations": {"x": "a*x(k-1) + u(k - L)"}, "outputs": {"y": "x"}, "initial": {"x": 0},
}  # fmt: skip
FAULT = "found 's', but this lag counts samples: write L/h, or the unit samples"


def test_a_stored_lag_in_another_unit_is_read_and_refused_to_new_jobs(
    own: TestClient,
) -> None:
    with own.app.state.parts.database.write() as session:  # type: ignore[attr-defined]
        ModelRepository(session).add("old", OLD)
    listed = own.get("/v1/models").json()["items"]
    assert "old" in [one["name"] for one in listed]
    assert own.get("/v1/models/old").json()["document"]["parameters"]["L"]["unit"] == "s"
    assert faults(own, "old")["/model"] == f"old: /parameters/L/unit: {FAULT}"
    assert faults(own, OLD)["/model/parameters/L/unit"] == FAULT
    assert faults(own, "odl")["/model"].startswith("there is no model 'odl'")
    assert own.post("/v1/models", json=OLD).status_code == 422


def faults(client: TestClient, model: Any) -> dict[str, str]:
    answer = client.post("/v1/jobs", json={"model": model, "datasets": ["r"]})
    assert answer.status_code == 422
    return {fault["pointer"]: fault["detail"] for fault in answer.json()["errors"]}
