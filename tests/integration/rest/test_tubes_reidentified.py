"""Tubes of three lengths through the recipe, on stored records of another program."""

from pathlib import Path

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from tests.support.requirements import DATA
from tests.support.service.local_runs import carry_out_job
from tests.support.service.web_app import CSV, settings_of

# T and L in s by another program's least squares, printed to 0.1 ms.
KNOWN = {5: (0.0153, 0.0181), 20: (0.1287, 0.0494), 40: (0.3492, 0.1127)}

pytestmark = pytest.mark.data


def test_a_warm_batch_finds_the_known_time_constants_and_lags(tmp_path: Path) -> None:
    app = create_app(settings_of(tmp_path))
    with TestClient(app) as server:
        batch = []
        for length in KNOWN:
            name = f"tube_{length:03d}m_pattern1.csv"
            content = (DATA / "tube_reference" / name).read_bytes()
            stored = server.post(f"/v1/datasets?name={name}", content=content, headers=CSV)
            batch.append({"x": length, "datasets": [stored.json()["id"]]})
        body = {
            "model": "tube",
            "label": "length_m",
            "batch": batch,
            "predict": [30],
            "channels": {"u": "P1_meas_Pa", "y": "P2_meas_Pa"},
        }
        job = server.post("/v1/recipes/reidentify", json=body).json()["id"]
        carry_out_job(app.state.parts, job)
        trend = server.get(f"/v1/jobs/{job}/trend").json()
    found = {one["name"]: one for one in trend["quantities"]}
    for number, (constant, lag) in enumerate(KNOWN.values()):
        assert found["T"]["points"][number]["value"] == pytest.approx(constant, rel=0.01, abs=5e-5)
        assert found["L"]["points"][number]["value"] == pytest.approx(lag, abs=2.05e-3)
    onset = next(law for law in found["onset delay"]["laws"] if law["is_chosen"])
    assert onset["coefficients"][1]["value"] == pytest.approx(3.1e-3, rel=0.15)
    (prediction,) = found["T"]["predictions"]
    assert prediction["lower"] < 0.23 < prediction["upper"]
    assert trend["labels"][2]["spans"][0]["upper"] == pytest.approx(482_000, rel=0.01)
