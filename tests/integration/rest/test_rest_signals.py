"""The fitted signals of runs that were stored together, over REST: each run has its own file."""

import json
from collections.abc import Iterator
from io import BytesIO
from typing import NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from starlette.testclient import TestClient

from service.api.requests.dependencies import Parts
from service.dispatch import fitted_signals
from service.formats.mcap.mcap_files import read_fitted_outputs, read_mcap
from service.repositories.run_rows import RunRepository
from service.storage.storage_errors import ObjectStoreFailed
from service.storage.tables import Run
from tests.support.files.mcap_files import read_run_record
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import parts_of, recording, store_csv
from workers import job_queue, packing, tasks

SMALL = {"population": 8, "generations": 5, "islands": 1}
SIGMAS = [0.0, 0.1, 0.2]


class SignalRuns(NamedTuple):
    server: TestClient
    parts: Parts
    runs: list[str]
    body: dict[str, object]


@pytest.fixture(scope="module")
def signals(server: TestClient) -> Iterator[SignalRuns]:
    body = {
        "model": "fopdt",
        "datasets": [store_csv(server, recording())],
        "algorithm": SMALL,
        "reuse": False,
        "keep_signals": True,
        "sweep": {"axes": [{"path": "/noise/sigma", "values": SIGMAS}]},
    }
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(job_queue, "choose_pack_size", lambda cost, waiting, slots: waiting)
        for module, name in (  # however busy the machine is, the pack is not cut
            (packing, "PACK_SECONDS"),
            (packing, "FIRST_SLICE_SECONDS"),
            (tasks, "PACK_LIMIT_SECONDS"),
        ):
            patched.setattr(module, name, 600.0)
        _, runs = identify_job(parts_of(server), body)
        yield SignalRuns(server, parts_of(server), runs, body)


def list_rows(signals: SignalRuns, runs: list[str]) -> list[Run]:
    with signals.parts.database.read_session() as session:
        return [RunRepository(session).get(run) for run in runs]


def test_each_run_has_a_file_of_its_own_in_the_object_of_its_pack(signals: SignalRuns) -> None:
    found = [signals.server.get(f"/v1/runs/{run}/signals.mcap") for run in signals.runs]
    assert len({row.signals_sha256 for row in list_rows(signals, signals.runs)}) == 1
    assert len({one.headers["etag"] for one in found}) == len(found)
    assert len({read_fitted_outputs(one.content)[0].measured.tobytes() for one in found}) == len(
        SIGMAS
    )
    for answer, run in zip(found, signals.runs, strict=True):
        (fit,) = read_fitted_outputs(answer.content)
        shown = signals.server.get(f"/v1/runs/{run}/response?max_points=10000").json()
        (experiment,) = shown["experiments"]
        assert experiment["simulated"][0]["values"] == fit.simulated.tolist()
        assert experiment["measured"][0]["values"] == fit.measured.tolist()
        told = signals.server.get(f"/v1/runs/{run}").json()["rms"]
        assert np.sqrt(np.mean((fit.measured - fit.simulated) ** 2)) == pytest.approx(told)


def test_ranges_are_of_the_runs_own_file(signals: SignalRuns) -> None:
    path = f"/v1/runs/{signals.runs[1]}/signals.mcap"
    whole = signals.server.get(path)
    head = signals.server.head(path)
    assert int(head.headers["content-length"]) == len(whole.content)
    part = signals.server.get(path, headers={"Range": "bytes=5-20"})
    assert (part.status_code, part.content) == (206, whole.content[5:21])
    assert part.headers["content-range"] == f"bytes 5-20/{len(whole.content)}"
    last = signals.server.get(path, headers={"Range": "bytes=-8"})
    assert last.content == whole.content[-8:] == whole.content[:8]  # the magic of a whole file
    beyond = signals.server.get(path, headers={"Range": f"bytes={len(whole.content)}-"})
    assert beyond.status_code == 416
    etag = whole.headers["etag"]
    assert signals.server.get(path, headers={"If-None-Match": etag}).status_code == 304


def test_a_run_that_is_taken_over_shows_the_same_signals(signals: SignalRuns) -> None:
    _, again = identify_job(signals.parts, {**signals.body, "reuse": True})
    for old, new in zip(signals.runs, again, strict=True):
        first, second = (
            signals.server.get(f"/v1/runs/{run}/signals.mcap").content for run in (old, new)
        )
        fits = [read_fitted_outputs(content) for content in (first, second)]
        assert fits[0][0].simulated.tobytes() == fits[1][0].simulated.tobytes()
        about = read_run_record(second)
        assert (about["run"], about["reused_from"]) == (new, old)  # a file of its own


def test_the_file_of_a_run_says_what_it_was_made_from(signals: SignalRuns) -> None:
    run = signals.runs[1]
    told = signals.server.get(f"/v1/runs/{run}").json()
    content = signals.server.get(f"/v1/runs/{run}/signals.mcap").content
    about = read_run_record(content)
    assert (about["run"], about["job"]) == (run, told["job"])
    for name in ("version", "fingerprint", "spec_hash"):
        assert about[name] == told[name]
        assert told[name]
    assert json.loads(about["seed"]) == told["seed"]
    assert json.loads(about["model"])["name"] == "fopdt"
    estimates = {one["name"]: one["value"] for one in told["parameters"]}
    assert {one["name"]: one["value"] for one in json.loads(about["parameters"])} == estimates
    (dataset,) = json.loads(about["datasets"])
    assert dataset["id"] == signals.body["datasets"][0]
    stored = signals.server.get(f"/v1/datasets/{dataset['id']}").json()
    assert dataset["sha256"] == stored["sha256"]
    summary = make_reader(BytesIO(content)).get_summary()
    assert summary is not None
    assert {channel.topic for channel in summary.channels.values()} == {"/fit", "/inputs"}
    recording = read_mcap(content)
    whole = read_mcap(signals.server.get(f"/v1/datasets/{dataset['id']}/content").content)
    np.testing.assert_array_equal(
        recording.channel("estimation 1/u/input").values, whole.channel("u").values
    )


def test_a_job_and_an_export_name_the_program_that_identified(
    signals: SignalRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = signals.server.get(f"/v1/runs/{signals.runs[0]}").json()["job"]
    told = signals.server.get(f"/v1/jobs/{job}").json()
    run = signals.server.get(f"/v1/runs/{signals.runs[0]}").json()
    assert (told["version"], told["fingerprint"]) == (run["version"], run["fingerprint"])
    assert len(told["spec_hash"]) == 64
    with signals.parts.database.write_session() as session:
        row = session.get_one(Run, signals.runs[0])
        row.result = {**(row.result or {}), "version": "0.0.7"}
    exported = signals.server.get(f"/v1/runs/{signals.runs[0]}/export?format=python").text
    assert "Identified by lagid 0.0.7." in exported
    document = signals.server.get(f"/v1/runs/{signals.runs[0]}/export").json()
    assert document["lagid"] == "0.0.7"


def test_signals_that_cannot_be_stored_cost_no_result_and_are_told_once(
    signals: SignalRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_blocks: object) -> None:
        raise ObjectStoreFailed("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(signals.parts.store, "put_stream", full)
        patched.setattr(fitted_signals, "RETRY_SECONDS", 0.1)
        job, runs = identify_job(signals.parts, signals.body)
    found = list_rows(signals, runs)
    assert [(row.state.value, row.signals_sha256) for row in found] == [("succeeded", None)] * 3
    again = signals.server.get(f"/v1/runs/{runs[0]}/signals.mcap")
    assert (again.status_code, again.headers["etag"][0]) == (200, '"')
    stored = signals.server.get(f"/v1/runs/{signals.runs[0]}/signals.mcap")
    assert [fit.simulated.tobytes() for fit in read_fitted_outputs(again.content)] == [
        fit.simulated.tobytes() for fit in read_fitted_outputs(stored.content)
    ]
    part = signals.server.get(f"/v1/runs/{runs[0]}/signals.mcap", headers={"Range": "bytes=5-20"})
    assert (part.status_code, part.content) == (206, again.content[5:21])
    events = signals.server.get(f"/v1/jobs/{job}/events").text
    assert events.count("are not stored") == 1
    assert f"{runs[0]} and 2 others" in events
