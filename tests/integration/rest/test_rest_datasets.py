"""Datasets over REST: stored once, read in parts, derived, simulated, traced back."""

from hashlib import sha256
from html import escape
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from starlette.testclient import TestClient

from service.core.label_text import format_subtracted
from service.formats.mcap.mcap_files import read_mcap
from tests.support.service.web_app import CSV, read_faults, recording, store_csv

SIMULATION: dict[str, Any] = {
    "name": "example",
    "model": "duffing-eq16",
    "parameters": {"c": 0.2, "L": 0.5, "b": 5.0, "a": 1.0},
    "inputs": {"q": {"kind": "cosine", "amplitude": 10, "omega": 5}},
    "samples": 60,
    "sample_time": 0.02,
}


def test_the_same_bytes_again_give_the_same_dataset(server: TestClient, dataset: str) -> None:
    again = server.post("/v1/datasets?name=other", content=recording(), headers=CSV)
    assert again.status_code == 200
    assert again.json()["id"] == dataset
    read_otherwise = server.post(
        "/v1/datasets?sample_time=0.2", content=b"u,y\n1,2\n2,3\n", headers=CSV
    )
    assert read_otherwise.json()["sample_time"] == pytest.approx(0.2)


def test_the_same_bytes_read_otherwise_are_another_dataset(server: TestClient) -> None:
    content = b"n,u,y\n1,2,3\n1,3,4\n2,4,5\n2,5,6\n"
    ways = ["sample_time=0.1", "sample_time=0.2", "sample_time=0.1&segments=n"]
    stored = [server.post(f"/v1/datasets?{way}", content=content, headers=CSV) for way in ways]
    assert [answer.status_code for answer in stored] == [201, 201, 201]
    assert len({answer.json()["id"] for answer in stored}) == 3
    again = server.post(f"/v1/datasets?{ways[0]}&name=else", content=content, headers=CSV).json()
    assert again["id"] == stored[0].json()["id"]
    assert any("already stored as" in warning for warning in again["warnings"])
    assert not any("already stored" in warning for warning in stored[0].json()["warnings"])


def test_recordings_of_two_loggers_are_joined(server: TestClient) -> None:
    rows = {
        "supply": "time,supply\n2026-03-14T08:00:00Z,40\n2026-03-14T08:00:10Z,45\n",
        "room": "time,room\n2026-03-14T08:00:02Z,20\n2026-03-14T08:00:08Z,21\n",
    }
    for name, text in rows.items():
        server.post(f"/v1/datasets?name={name}", content=text.encode(), headers=CSV)
    body = {"datasets": ["supply", "room"], "name": "heating"}
    answer = server.post("/v1/datasets:join", json=body)
    assert answer.status_code == 201
    joined = answer.json()
    assert [(one["name"], one["start"]) for one in joined["channels"]] == [
        ("supply", 0.0),
        ("room", 2.0),
    ]
    assert joined["started_at"] == "2026-03-14T08:00:00+00:00"
    assert "clocks are joined: supply begins first, room begins 2 s later" in joined["warnings"]
    assert server.post("/v1/datasets:join", json=body).status_code == 200
    edges = server.get(f"/v1/datasets/{joined['id']}/lineage").json()["edges"]
    assert len([edge for edge in edges if edge["child"] == joined["id"]]) == 2
    assert server.post("/v1/datasets:join", json={"datasets": ["supply"]}).status_code == 422
    missing = server.post("/v1/datasets:join", json={"datasets": ["supply", "attic"]})
    assert missing.status_code == 404
    pair = [
        server.post(f"/v1/datasets?name={name}", content=recording(length), headers=CSV)
        for name, length in (("a", 100), ("b", 120))
    ]
    same = server.post("/v1/datasets:join", json={"datasets": [one.json()["id"] for one in pair]})
    assert same.status_code == 422
    assert "so they are experiments. Fit them jointly" in same.text


def test_the_same_steps_on_two_datasets_give_two(server: TestClient, dataset: str) -> None:
    other = server.post("/v1/datasets?name=b", content=recording(120), headers=CSV).json()["id"]
    steps = {"steps": [{"trim": {"start": 0, "stop": 5}}]}
    made = [
        server.post(f"/v1/datasets/{one}:derive", json=steps).json() for one in (dataset, other)
    ]
    assert made[0]["id"] != made[1]["id"]
    for one, parent in zip(made, (dataset, other), strict=True):
        edges = server.get(f"/v1/datasets/{one['id']}/lineage").json()["edges"]
        assert [edge["parent"] for edge in edges if edge["child"] == one["id"]] == [parent]


def test_a_dataset_tells_its_channels_and_its_sampling(server: TestClient, dataset: str) -> None:
    told = server.get(f"/v1/datasets/{dataset}").json()
    assert [channel["name"] for channel in told["channels"]] == ["u", "y"]
    assert told["samples"] == 300
    assert told["sample_time"] == pytest.approx(0.1)
    listed = server.get("/v1/datasets").json()["items"]
    assert dataset in [one["id"] for one in listed]


def test_a_form_of_a_browser_is_an_upload_too(server: TestClient) -> None:
    file = ("filled in.csv", recording(40), "application/vnd.ms-excel")
    answer = server.post("/v1/datasets", files={"file": file})
    assert answer.status_code == 201, answer.text
    assert answer.json()["name"] == "filled in"


def test_content_goes_up_again_as_mcap_with_the_same_samples(
    server: TestClient, dataset: str
) -> None:
    content = server.get(f"/v1/datasets/{dataset}/content").content
    kind = {"content-type": "application/x-mcap"}
    copy = server.post("/v1/datasets?name=copy", content=content, headers=kind).json()
    first, second = (
        read_mcap(server.get(f"/v1/datasets/{one}/content").content)
        for one in (dataset, copy["id"])
    )
    for name in ("u", "y"):
        np.testing.assert_array_equal(first.channel(name).values, second.channel(name).values)
        np.testing.assert_array_equal(first.channel(name).times, second.channel(name).times)


def test_content_as_csv_goes_up_again_with_the_same_samples(server: TestClient) -> None:
    text = b"run,t,u [V],y\n1,0,1,2\n1,0.1,0.1,3\n2,0,5,0.30000000000000004\n2,0.1,7,\n"
    stored = server.post("/v1/datasets?segments=run", content=text, headers=CSV).json()
    again = server.get(f"/v1/datasets/{stored['id']}/content.csv").content
    copy = server.post("/v1/datasets?segments=run", content=again, headers=CSV).json()
    assert copy["segments"] == stored["segments"]
    first, second = (
        read_mcap(server.get(f"/v1/datasets/{one['id']}/content").content) for one in (stored, copy)
    )
    np.testing.assert_array_equal(first.channel("y").values, second.channel("y").values)
    assert second.channel("u").unit == "V"


def test_parts_of_content_make_the_whole(server: TestClient, dataset: str) -> None:
    path = f"/v1/datasets/{dataset}/content"
    whole = server.get(path)
    assert whole.headers["accept-ranges"] == "bytes"
    assert whole.headers["access-control-allow-origin"] == "*"
    size = len(whole.content)
    head = server.get(path, headers={"Range": "bytes=0-99"})
    rest = server.get(path, headers={"Range": "bytes=100-"})
    tail = server.get(path, headers={"Range": "bytes=-7"})
    assert (head.status_code, rest.status_code, tail.status_code) == (206, 206, 206)
    assert head.headers["content-range"] == f"bytes 0-99/{size}"
    assert head.content + rest.content == whole.content
    assert tail.content == whole.content[-7:]
    assert server.head(path).headers["content-length"] == str(size)


def test_a_range_outside_the_content_is_refused(server: TestClient, dataset: str) -> None:
    path = f"/v1/datasets/{dataset}/content"
    size = len(server.get(path).content)
    answer = server.get(path, headers={"Range": f"bytes={size}-"})
    read_faults(answer, 416, "range")
    assert answer.headers["content-range"] == f"bytes */{size}"


def test_content_that_is_known_is_not_sent_again(server: TestClient, dataset: str) -> None:
    path = f"/v1/datasets/{dataset}/content"
    etag = server.get(path).headers["etag"]
    assert server.get(path, headers={"If-None-Match": etag}).status_code == 304
    assert server.get(path, headers={"If-None-Match": '"x"'}).status_code == 200
    read_faults(server.get(path, headers={"If-Match": '"x"'}), 412, "stale")
    other = server.get(path, headers={"Range": "bytes=0-9", "If-Range": '"x"'})
    assert other.status_code == 200


def test_reduced_signals_keep_the_extremes(server: TestClient, dataset: str) -> None:
    whole = server.get(f"/v1/datasets/{dataset}/signals?max_points=1000").json()["channels"][1]
    few = server.get(f"/v1/datasets/{dataset}/signals?max_points=20").json()["channels"][1]
    assert len(whole["values"]) == 300
    assert len(few["values"]) <= 20
    assert max(few["values"]) == max(whole["values"])
    assert min(few["values"]) == min(whole["values"])


def test_a_simulation_with_noise_differs_by_the_noise_alone_and_is_made_once(
    server: TestClient,
) -> None:
    clean = server.post("/v1/datasets:simulate", json=SIMULATION).json()
    body = {**SIMULATION, "noise": {"sigma": 0.01, "seed": 1}}
    noisy, again = (server.post("/v1/datasets:simulate", json=body) for _ in range(2))
    assert noisy.status_code == 201
    assert again.status_code == 200
    assert noisy.json()["id"] == again.json()["id"]
    a, b = (
        read_mcap(server.get(f"/v1/datasets/{one}/content").content)
        for one in (clean["id"], noisy.json()["id"])
    )
    np.testing.assert_array_equal(a.channel("q").values, b.channel("q").values)
    error = b.channel("y").values - a.channel("y").values
    assert 0.005 < float(np.std(error)) < 0.02


def test_an_input_is_the_same_as_a_formula_and_as_a_frequency(server: TestClient) -> None:
    kinds: list[dict[str, Any]] = [
        {"kind": "expression", "expression": "10*cos(5*t)"},
        {"kind": "cosine", "amplitude": 10, "frequency": 5 / (2 * np.pi)},
        {"kind": "sine", "amplitude": 10, "omega": 5, "phase": np.pi / 2},
    ]
    values = []
    for kind in kinds:
        body = {**SIMULATION, "inputs": {"q": kind}}
        made = server.post("/v1/datasets:simulate", json=body).json()
        content = server.get(f"/v1/datasets/{made['id']}/content").content
        values.append(read_mcap(content).channel("y").values)
    np.testing.assert_allclose(values[0], values[1], atol=1e-9)
    np.testing.assert_allclose(values[0], values[2], atol=1e-9)


def test_a_file_names_its_source_and_the_recorded_clock(server: TestClient) -> None:
    rows = [f"2026-01-31T08:00:{second:02d}Z,{second},{second % 7}" for second in range(30)]
    content = "\n".join(["time,u,y", *rows]).encode()
    stored = server.post("/v1/datasets?name=clock", content=content, headers=CSV).json()
    assert stored["started_at"] == "2026-01-31T08:00:00+00:00"
    derived = server.post(
        f"/v1/datasets/{stored['id']}:derive", json={"steps": [{"trim": {"start": 5}}]}
    ).json()
    assert derived["started_at"] == stored["started_at"]
    files = {
        one["id"]: server.get(f"/v1/datasets/{one['id']}/content").content
        for one in (stored, derived)
    }
    metadata = [
        next(make_reader(BytesIO(file)).iter_metadata()).metadata for file in files.values()
    ]
    assert metadata[0]["source"] == sha256(content).hexdigest()
    assert (metadata[1]["source"], metadata[1]["parents"]) == ("", stored["id"])
    assert [one["started_at"] for one in metadata] == [stored["started_at"]] * 2
    shown = '<time datetime="2026-01-31T08:00:00+00:00">2026-01-31 08:00:00+00:00</time>'
    assert shown in server.get(f"/datasets/{stored['id']}").text


def test_lineage_leads_from_a_derived_dataset_to_its_source(
    server: TestClient, dataset: str
) -> None:
    path = f"/v1/datasets/{dataset}:derive"
    body = {"steps": [{"trim": {"start": 0, "stop": 20}}]}
    child = server.post(path, json=body).json()
    assert server.post(path, json=body).json()["id"] == child["id"]
    edge = {"parent": dataset, "child": child["id"], "relation": "derived"}
    assert edge in server.get(f"/v1/datasets/{child['id']}/lineage").json()["edges"]
    assert edge in server.get(f"/v1/datasets/{dataset}/lineage").json()["edges"]


def test_a_detrended_dataset_tells_what_was_subtracted(server: TestClient, dataset: str) -> None:
    steps = [{"trim": {"start": 5}}, {"detrend": {"kind": "linear", "channels": ["y"]}}]
    derived = server.post(f"/v1/datasets/{dataset}:derive", json={"steps": steps}).json()
    [line] = derived["details"]["subtracted"]
    assert (line["channel"], line["time"]) == ("y", 5.0)
    text = format_subtracted(line)
    assert f"Subtracted from {escape(text)}." in server.get(f"/datasets/{derived['id']}").text
    body = {"model": "fopdt", "datasets": [derived["id"]]}
    job = server.post("/v1/jobs", json=body).json()
    assert f"subtracted from {escape(text)}" in server.get(f"/jobs/{job['id']}").text


def test_a_part_tells_and_keeps_what_was_recorded_before_it(
    server: TestClient, dataset: str
) -> None:
    steps = [{"trim": {"rows": [100, 300]}}]
    part = server.post(f"/v1/datasets/{dataset}:derive", json={"steps": steps}).json()
    assert [one["history_samples"] for one in part["channels"]] == [100, 100]
    assert part["channels"][0]["history_start"] == 0.0
    assert part["samples"] == 200
    assert part["details"]["known_before"] == pytest.approx(10.0)
    signals = server.get(f"/v1/datasets/{part['id']}/signals").json()
    assert [len(one["times"]) for one in signals["history"]] == [100, 100]
    content = server.get(f"/v1/datasets/{part['id']}/content").content
    kind = {"content-type": "application/x-mcap"}
    copy = server.post("/v1/datasets?name=with history", content=content, headers=kind).json()
    assert [one["history_samples"] for one in copy["channels"]] == [100, 100]
    rows = server.get(f"/v1/datasets/{part['id']}/content.csv").text.splitlines()
    assert len(rows) == 201
    figure = server.get(f"/v1/datasets/{part['id']}/figures/signals").json()
    assert [one["name"] for one in figure["data"]] == [
        "u",
        "u, before the record",
        "y",
        "y, before the record",
    ]
    assert "Earlier samples" in server.get(f"/datasets/{part['id']}").text
    assert "Earlier samples" not in server.get(f"/datasets/{dataset}").text


def test_an_input_from_a_part_is_what_was_recorded_before_it(
    server: TestClient, dataset: str
) -> None:
    """It jumps at 7 s, and the part begins at 10 s."""
    steps = [{"trim": {"rows": [100, 300]}}]
    part = server.post(f"/v1/datasets/{dataset}:derive", json={"steps": steps}).json()["id"]
    body = {
        "model": "fopdt",
        "parameters": {"K": 2, "T": 0.5, "L": 0.5, "y0": 0},
        "samples": 120,
        "sample_time": 0.1,
        "inputs": {"u": {"kind": "dataset", "dataset": part, "channel": "u"}},
    }
    made = server.post("/v1/datasets:simulate", json=body)
    assert made.status_code == 201, made.text
    stored = read_mcap(server.get(f"/v1/datasets/{made.json()['id']}/content").content)
    u, y = stored.channel("u").values, stored.channel("y").values
    assert not u[:70].any()
    assert np.all(u[71:] == 1.0)
    assert not y[:74].any()
    assert y[-1] == pytest.approx(2.0, abs=0.01)


def test_a_part_without_history_is_another_dataset(server: TestClient, dataset: str) -> None:
    parts = [
        server.post(
            f"/v1/datasets/{dataset}:derive",
            json={"steps": [{"split": {"fraction": 0.5, "part": "validation", "history": keep}}]},
        ).json()
        for keep in (True, False)
    ]
    assert [one["channels"][0]["history_samples"] for one in parts] == [150, 0]
    assert parts[0]["channels"][0]["history_start"] == 0.0
    assert parts[1]["channels"][0]["history_start"] is None
    assert parts[0]["id"] != parts[1]["id"]
    bad = {"steps": [{"trim": {"start": 1, "history": 1}}]}
    fault = read_faults(server.post(f"/v1/datasets/{dataset}:derive", json=bad), 422, "invalid")[0]
    assert fault["pointer"] == "/steps/0/trim/history"


@pytest.mark.parametrize(
    ("signal", "hold"),
    [
        ({"kind": "step", "time": 1.05}, "zero"),
        ({"kind": "binary", "period": 0.7, "seed": 1}, "zero"),
        ({"kind": "cosine", "frequency": 0.5}, "first"),
    ],
)
def test_an_input_that_jumps_is_stored_as_held(
    server: TestClient, signal: dict[str, Any], hold: str
) -> None:
    body = {
        "model": "fopdt",
        "parameters": {"K": 2, "T": 0.5, "L": 0, "y0": 0},
        "samples": 40,
        "inputs": {"u": {"amplitude": 1, **signal}},
        "sample_time": 0.1,
    }
    made = server.post("/v1/datasets:simulate", json=body)
    assert made.status_code == 201, made.text
    assert [c["hold"] for c in made.json()["channels"] if c["name"] == "u"] == [hold]
    if signal["kind"] == "step":  # no ramp leads to it
        stored = read_mcap(server.get(f"/v1/datasets/{made.json()['id']}/content").content)
        values = stored.channel("y").values
        assert not values[:11].any()
        assert values[11] < 0.05  # a ramp from the sample before gives 0.2
        assert values[12] > 0.3


def test_a_recorded_input_keeps_its_hold_and_comes_in_the_unit_of_the_model(
    server: TestClient,
) -> None:
    rows = ["t,P [kPa]", *(f"{0.1 * k:.1f},{int(k >= 10)}" for k in range(40))]
    added = store_csv(server, "\n".join(rows).encode(), "P")
    held = server.post(
        f"/v1/datasets/{added}:derive", json={"steps": [{"hold": {"P": "zero"}}]}
    ).json()["id"]
    model = {
        "name": "gauge",
        "form": "differential",
        "inputs": {"u": "Pa"},
        "states": {"x": "Pa"},
        "parameters": {"T": {"lower": 0.1, "upper": 2, "unit": "s"}},
        "equations": {"x": "(u - x)/T"},
        "outputs": {"y": "x"},
        "initial": {"x": 0},
    }
    body = {
        "model": model,
        "parameters": {"T": 0.5},
        "samples": 40,
        "sample_time": 0.1,
        "inputs": {"u": {"kind": "dataset", "dataset": held, "channel": "P"}},
    }
    made = server.post("/v1/datasets:simulate", json=body)
    assert made.status_code == 201, made.text
    stored = read_mcap(server.get(f"/v1/datasets/{made.json()['id']}/content").content)
    u, y = stored.channel("u"), stored.channel("y")
    assert (u.hold, u.unit, u.values[9], u.values[10]) == ("zero", "Pa", 0.0, 1000.0)
    assert not y.values[:11].any()  # no ramp leads to the jump
    assert y.values[20] == pytest.approx(1000 * (1 - np.exp(-2)), rel=1e-3)
    body["model"] = {**model, "inputs": {"u": "V"}}
    fault = read_faults(server.post("/v1/datasets:simulate", json=body), 422, "invalid")[0]
    assert fault["pointer"] == "/inputs/u/channel"
    assert "is in kPa, but 'u' is in V" in fault["detail"]


def test_what_happened_to_a_recording_is_told_at_once_and_on_request(
    server: TestClient, dataset: str
) -> None:
    assert server.get(f"/v1/datasets/{dataset}/check").json() == {"id": dataset, "findings": []}
    rows = [f"{k},{k % 40 // 20},{np.sin(0.1 * k):.9f}" for k in range(600) if not 200 <= k < 400]
    content = "\n".join(["t,u,y", *rows, ""]).encode()
    stored = server.post("/v1/datasets?name=gap", content=content, headers=CSV).json()
    (finding,) = server.get(f"/v1/datasets/{stored['id']}/check").json()["findings"]
    assert finding["explanation"] == "outage"
    assert finding["channels"] == ["u", "y"]
    assert finding["spans"] == [[199.0, 400.0]]
    assert finding["text"] in stored["warnings"]
    figure = server.get(f"/v1/datasets/{stored['id']}/figures/signals").json()
    assert [shape["x0"] for shape in figure["layout"]["shapes"]] == [199.0, 199.0]
