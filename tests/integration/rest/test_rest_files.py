"""Every kind of file over REST: as bytes, as a form, and as the page sends it."""

from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from service.formats.mcap.mcap_files import read_mcap
from tests.support.files.experiment_files import (
    INPUT,
    OUTPUT,
    START,
    TIMES,
    compress,
    join_rows,
    stamp,
    write_experiment_sheet,
    write_mat,
    write_npz,
    write_parquet,
)
from tests.support.service.web_app import read_faults

BYTES = {"content-type": "application/octet-stream"}
ARRAYS = {"t": TIMES, "u": INPUT, "y": OUTPUT}
FILES: dict[str, tuple[str, bytes]] = {
    "stamps.csv": (
        "csv",
        join_rows("Zeit;u;y", ";", time=stamp("%d.%m.%Y %H:%M:%S,%f")).encode("latin-1"),
    ),
    "packed.csv.gz": ("csv", compress(join_rows("t,u,y"))),
    "sheet.xlsx": ("excel", write_experiment_sheet()),
    "columns.parquet": ("parquet", write_parquet(**ARRAYS)),
    "arrays.npz": ("numpy", write_npz(**ARRAYS)),
    "arrays.mat": ("matlab", write_mat({"data": ARRAYS})),
}


def check_stored(server: TestClient, answer: Any, kind: str) -> dict[str, Any]:
    assert answer.status_code in (200, 201), answer.text
    stored: dict[str, Any] = answer.json()
    assert stored["details"]["source"]["format"] == kind
    content = read_mcap(server.get(f"/v1/datasets/{stored['id']}/content").content)
    for name, values in (("u", INPUT), ("y", OUTPUT)):
        np.testing.assert_array_equal(content.channel(name).times, TIMES)
        np.testing.assert_array_equal(content.channel(name).values, values)
    return stored


@pytest.mark.parametrize("name", FILES)
def test_a_file_is_stored_once_however_it_is_sent(server: TestClient, name: str) -> None:
    kind, content = FILES[name]
    stored = check_stored(server, server.post("/v1/datasets", content=content, headers=BYTES), kind)
    form = server.post("/v1/datasets", files={"file": (name, content, "application/x-anything")})
    assert form.json()["id"] == stored["id"]
    text = {"content-type": "text/csv"}
    page = server.post("/v1/datasets", params={"name": name}, content=content, headers=text)
    assert page.json()["id"] == stored["id"]


def test_a_form_names_the_dataset_without_its_suffixes(server: TestClient) -> None:
    content = compress(join_rows("t,u,y", time=lambda t: f"{t:.2f}"))
    stored = server.post("/v1/datasets", files={"file": ("rig.csv.gz", content)}).json()
    assert stored["name"] == "rig"


def test_the_clock_of_a_recording_is_kept_and_told(server: TestClient) -> None:
    for suffix, zone in (("", ""), ("Z", "+00:00")):
        write = stamp("%Y-%m-%dT%H:%M:%S.%f")
        text = join_rows("t,u,y", time=lambda t, write=write, suffix=suffix: write(t) + suffix)
        stored = server.post("/v1/datasets", content=text.encode(), headers=BYTES).json()
        assert stored["started_at"] == START.isoformat() + zone
        assert any("time stamps, 0.1 s apart" in note for note in stored["warnings"])
        assert (
            server.get(f"/v1/datasets/{stored['id']}").json()["started_at"] == stored["started_at"]
        )
        shown = f'{stored["started_at"]}">{stored["started_at"].replace("T", " ")}</time>'
        assert shown in server.get(f"/datasets/{stored['id']}").text
        steps = {"steps": [{"trim": {"start": 1}}, {"resample": {"sample_time": 0.2}}]}
        part = server.post(f"/v1/datasets/{stored['id']}:derive", json=steps).json()
        assert part["started_at"] == stored["started_at"]  # the time axis is that of the parent
        content = server.get(f"/v1/datasets/{part['id']}/content").content
        again = server.post("/v1/datasets?name=copy", content=content, headers=BYTES).json()
        assert again["started_at"] == stored["started_at"]
    plain = server.post("/v1/datasets", content=b"t,u\n0,1\n1,3\n", headers=BYTES).json()
    assert plain["started_at"] is None


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b'{"t": [0, 1]}', "the JSON holds no list of records. Write"),
        (b"u,y\n1,2\n2,3\n", "give the sampling period with sample_time"),
        (b"\x89HDF\r\n\x1a\n\0", "HDF5"),
        (write_npz(u=INPUT, y=OUTPUT), "there is no time column; found u, y"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_with_what_to_do(
    server: TestClient, content: bytes, words: str
) -> None:
    answer = server.post("/v1/datasets", content=content, headers=BYTES)
    (fault,) = read_faults(answer, 422, "invalid-upload")
    assert words in fault["detail"]


def test_the_form_of_the_page_offers_the_files_that_are_read(server: TestClient) -> None:
    page = server.get("/").text
    for suffix in (".csv", ".xlsx", ".parquet", ".npz", ".mat", ".mcap", ".gz"):
        assert f"{suffix}," in page or f'{suffix}"' in page
