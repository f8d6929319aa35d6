"""Bad input over REST: a problem document that says what was wrong, where, and what was found."""

from typing import Any

import pytest
from starlette.testclient import TestClient

from tests.support.service.web_app import CSV, read_faults, recording, store_csv

MODEL: dict[str, Any] = {
    "name": "own",
    "form": "differential",
    "inputs": {"u": "V"},
    "states": {"x": "m"},
    "parameters": {"K": {"lower": 0, "upper": 5}, "L": {"lower": 0, "upper": 2}},
    "equations": {"x": "K*u(t - L) - x"},
    "outputs": {"y": "x"},
    "initial": {"x": 0},
}


FEW = {
    **MODEL,
    "parameters": {name: {"lower": 0.1, "upper": 0.5} for name in "abcd"},
    "equations": {"x": "a*u - b*x + c + d*x**2"},
}


def with_changes(dataset: str, changes: dict[str, Any]) -> dict[str, Any]:
    return {"model": "fopdt", "datasets": [dataset], **changes}


JOBS: list[tuple[dict[str, Any], str, str]] = [
    ({"model": "fopd"}, "/model", "did you mean 'fopdt'?"),
    ({"model": 7}, "/model", "found 7"),
    ({"datasets": ["ds_nothing"]}, "/datasets/0", "no dataset 'ds_nothing'"),
    ({"datasets": []}, "/datasets", "found []"),
    ({"datasets": ["./recording.csv"]}, "/datasets/0", "lagid dataset add"),
    ({"channels": {"u": "volts"}}, "/channels/u", "no channel 'volts'"),
    ({"channels": {"w": "u"}}, "/channels/w", "no signal 'w'"),
    ({"algorithm": {"populaton": 50}}, "/algorithm/populaton", "did you mean 'population'?"),
    ({"algorithm": {"population": 2}}, "/algorithm/population", "found 2"),
    ({"algorithm": {"population": 12, "islands": 4}}, "/algorithm/population", "4 islands"),
    ({"algorithm": {"mutation": [[5, 0.2]]}}, "/algorithm/mutation", "generation 0"),
    ({"parameters": {"LL": {"upper": 1}}}, "/parameters/LL", "no parameter 'LL'"),
    ({"parameters": {"L": {"lower": 4, "upper": 1}}}, "/parameters/L", "[4, 1]"),
    ({"parameters": {"L": {"lower": -1}}}, "/parameters", "-1 s"),
    ({"hold": {"y": "zero"}}, "/hold/y", "need one of auto, mean"),
    ({"weights": {"z": 1}}, "/weights/z", "no output 'z'"),
    ({"weights": {"y": -1}}, "/weights/y", "found -1"),
    ({"skip": 300}, "/datasets/0", "300 samples"),
    ({"validation": {}}, "/validation", "either"),
    ({"validation": {"datasets": ["ds_x"]}}, "/validation/datasets/0", "'ds_x'"),
    ({"algorithm": {"stop": {"evaluations": 10**40}}}, "/algorithm/stop/evaluations", "10000000"),
    ({"algorithm": {"mutation": [[0, 0.2], [10**30, 0.8]]}}, "/algorithm/mutation/1/0", "found 1"),
    (
        {"validation": {"fraction": 0.9}, "parameters": {"L": {"upper": 5}}},
        "/datasets/0",
        "estimation part: the record lasts 2.9 s",
    ),
    ({"validation": {"fraction": 0.001}}, "/validation/fraction", "would be empty"),
    (
        {"parameters": {"K": {"tied": "T"}, "T": {"tied": "K"}}},
        "/parameters/K/tied",
        "circular, K → T → K",
    ),
    (
        {"skip": 207, "validation": {"fraction": 0.3}, "model": FEW},
        "/datasets",
        "3 scored samples for 4 free parameters",
    ),
    (
        {"parameters": {name: {"fixed": 1} for name in ("K", "T", "L", "y0", "x(0)")}},
        "/parameters",
        "Leave at least one free",
    ),
]


@pytest.mark.parametrize(("changes", "pointer", "words"), JOBS)
def test_a_job_that_cannot_be_used_is_refused_with_the_place_and_what_was_found(
    server: TestClient, dataset: str, changes: dict[str, Any], pointer: str, words: str
) -> None:
    answer = server.post("/v1/jobs", json=with_changes(dataset, changes))
    faults = read_faults(answer, 422, "invalid")
    assert [fault for fault in faults if fault["pointer"] == pointer and words in fault["detail"]]


AXES: list[tuple[dict[str, Any], str, str]] = [
    ({"path": "/noise/sigm", "values": [1]}, "path", "did you mean 'sigma'?"),
    ({"path": "noise", "values": [1]}, "path", "found 'noise'"),
    ({"path": "/name", "values": ["a"]}, "path", "cannot be swept"),
    ({"path": "/seed"}, "", "exactly one of"),
    ({"path": "/seed", "values": [1], "range": [0, 2]}, "", "values and range"),
    ({"path": "/seed", "range": [5, 2]}, "range", "[5, 2]"),
    ({"path": "/seed", "range": [0, 900000]}, "axes", "900000 runs"),
    ({"path": "/noise/sigma", "log": [0, 1, 3]}, "log", "start > 0"),
    ({"path": "/seed", "log": [1, 10, 5]}, "log", "found 1.778"),
    ({"path": "/seed", "values": [1, "3"]}, "values/1", "found '3'; write 3"),
    ({"path": "/algorithm/population", "values": [50.0]}, "values/0", "found 50.0; write 50"),
    ({"path": "/seed", "range": [-3, 5]}, "range", "found -3"),
    ({"path": "/algorithm/method", "values": ["simple", "bes"]}, "values/1", "found 'bes'"),
    ({"path": "/parameters/L/upper", "values": [1, -1]}, "values/1", "/parameters/L"),
    ({"path": "/seed", "values": [1, 2], "labels": [{"n": 1}]}, "labels", "1 labels for 2"),
    ({"path": "/seed", "values": [1], "labels": [{"a\\b": 1}]}, "labels/0", "backslashes"),
    ({"path": "/seed", "values": [1], "labels": [{"a\nb": 1}]}, "labels/0", "printable"),
    ({"path": "/seed", "values": [1], "labels": [{"a" * 65: 1}]}, "labels/0", "1 to 64"),
    ({"path": "/algorithm", "values": [{}, {"metod": 1}]}, "values/1", "did you mean 'method'?"),
    ({"path": "/datasets", "values": [["nope"]]}, "values/0", "no dataset 'nope'"),
]


@pytest.mark.parametrize(("axis", "place", "words"), AXES)
def test_a_sweep_that_cannot_be_expanded_is_refused_at_its_axis(
    server: TestClient, dataset: str, axis: dict[str, Any], place: str, words: str
) -> None:
    body = with_changes(dataset, {"sweep": {"axes": [axis]}})
    faults = read_faults(server.post("/v1/jobs", json=body), 422, "invalid")
    pointer = "/sweep/axes" if place == "axes" else f"/sweep/axes/0/{place}".rstrip("/")
    assert [fault for fault in faults if fault["pointer"] == pointer and words in fault["detail"]]


MODELS: list[tuple[dict[str, Any], str, int | None, str]] = [
    ({"equations": {"x": "K*u(t - L) - z"}}, "/equations/x", 14, "'z'"),
    (
        {"parameters": {"K": {"lower": 5, "upper": 0}, "L": {"lower": 0, "upper": 2}}},
        "/parameters/K",
        None,
        "[5, 0]",
    ),
]


@pytest.mark.parametrize(("changes", "pointer", "column", "words"), MODELS)
def test_a_model_with_a_fault_is_refused_with_its_column(
    server: TestClient,
    dataset: str,
    changes: dict[str, Any],
    pointer: str,
    column: int | None,
    words: str,
) -> None:
    document = {**MODEL, **changes}
    told = server.post("/v1/models:check", json=document).json()
    assert told["valid"] is False
    fault = told["errors"][0]
    assert fault["pointer"].startswith(pointer)
    assert fault["column"] == column
    assert words in fault["detail"]
    read_faults(server.post("/v1/models", json=document), 422, "invalid")
    answer = server.post("/v1/jobs", json={"model": document, "datasets": [dataset]})
    assert read_faults(answer, 422, "invalid")[0]["pointer"].startswith(f"/model{pointer}")


@pytest.mark.parametrize("text", [b"{", b"[1,2]", b'{"a": NaN}', b"\xff\xfe", b"null"])
def test_the_check_of_a_model_answers_whatever_is_sent(server: TestClient, text: bytes) -> None:
    answer = server.post(
        "/v1/models:check", content=text, headers={"content-type": "application/json"}
    )
    assert answer.status_code == 200, answer.text
    assert answer.json()["valid"] is False
    assert answer.json()["errors"][0]["detail"]


def test_an_own_model_cannot_take_the_name_of_a_built_in_one(server: TestClient) -> None:
    answer = server.post("/v1/models", json={**MODEL, "name": "tube"})
    assert read_faults(answer, 422, "invalid")[0]["pointer"] == "/name"


def test_a_name_under_which_a_model_could_not_be_read_is_refused(server: TestClient) -> None:
    for name in ("a/b", "a@1", ".", "a?b", "a b"):
        answer = server.post("/v1/models", json={**MODEL, "name": name})
        assert read_faults(answer, 422, "invalid")[0]["pointer"] == "/name"


def test_a_model_can_be_read_under_every_name_that_it_may_have(server: TestClient) -> None:
    for name in ("a", "A.b_c-1", "9" * 64):
        assert server.post("/v1/models", json={**MODEL, "name": name}).status_code == 201
        assert server.get(f"/v1/models/{name}").json()["name"] == name


def test_pages_of_models_have_each_once_and_the_built_in_ones_first(own: TestClient) -> None:
    for name in ("first", "second", "third"):
        assert own.post("/v1/models", json={**MODEL, "name": name}).status_code == 201
    whole = [one["name"] for one in own.get("/v1/models").json()["items"]]
    names, cursor = [], ""
    while cursor is not None:
        page = own.get(f"/v1/models?limit=2{cursor and f'&cursor={cursor}'}").json()
        names += [one["name"] for one in page["items"]]
        cursor = page["next"]
    assert names == whole
    assert names[-3:] == ["third", "second", "first"]
    assert len(names) == len(set(names))


def test_a_csv_that_cannot_be_read_is_refused_with_its_row(server: TestClient) -> None:
    answer = server.post("/v1/datasets", content=b"t,u,y\n0,1,2\n0.1,volt,3\n", headers=CSV)
    read_faults(answer, 422, "invalid-upload")
    assert "row 3, column 'u'" in answer.json()["detail"]


def test_a_damaged_mcap_is_refused(server: TestClient, dataset: str) -> None:
    whole = server.get(f"/v1/datasets/{dataset}/content").content
    kind = {"content-type": "application/x-mcap"}
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0x10
    answer = server.post("/v1/datasets", content=bytes(flipped), headers=kind)
    read_faults(answer, 422, "invalid-upload")


def test_an_upload_of_another_kind_is_refused(server: TestClient) -> None:
    answer = server.post("/v1/datasets", content=b"x", headers={"content-type": "image/png"})
    read_faults(answer, 415, "unsupported-media-type")
    assert "'image/png'" in answer.json()["detail"]


def test_an_upload_over_the_limit_is_refused(server: TestClient) -> None:
    large = b"t,u,y\n" + b"0,0,0\n" * 60_000
    read_faults(server.post("/v1/datasets", content=large, headers=CSV), 413, "too-large")
    pieces = (large[i : i + 1000] for i in range(0, len(large), 1000))
    read_faults(server.post("/v1/datasets", content=pieces, headers=CSV), 413, "too-large")


def test_a_form_without_a_file_is_refused(server: TestClient) -> None:
    answer = server.post("/v1/datasets", files={"note": (None, "text")})
    assert read_faults(answer, 422, "invalid")[0]["pointer"] == "/file"


SIMULATIONS: list[tuple[dict[str, Any], str, str]] = [
    ({"model": "nope"}, "/model", "no model 'nope'"),
    ({"parameters": {"K": 1, "T": 1, "y0": 0}}, "/parameters/L", "true value"),
    ({"parameters": {"K": 1, "T": 1, "L": 0.5, "Z": 1}}, "/parameters/Z", "no parameter 'Z'"),
    ({"inputs": {"u": {"kind": "cosine"}}}, "/inputs/u", "omega"),
]


@pytest.mark.parametrize(("changes", "pointer", "words"), SIMULATIONS)
def test_a_simulation_that_cannot_be_done_is_refused(
    server: TestClient, changes: dict[str, Any], pointer: str, words: str
) -> None:
    body: dict[str, Any] = {
        "model": "fopdt",
        "parameters": {"K": 2, "T": 1, "L": 0.5, "y0": 0},
        "samples": 20,
        "inputs": {"u": {"kind": "step"}},
        "sample_time": 0.1,
        **changes,
    }
    faults = read_faults(server.post("/v1/datasets:simulate", json=body), 422, "invalid")
    assert [fault for fault in faults if fault["pointer"] == pointer and words in fault["detail"]]


def test_a_derivation_that_cannot_be_done_is_refused_at_its_step(
    server: TestClient, dataset: str
) -> None:
    steps = [{"detrend": {}}, {"noise": {"sigma": -1, "channels": ["y"]}}]
    answer = server.post(f"/v1/datasets/{dataset}:derive", json={"steps": steps})
    assert read_faults(answer, 422, "invalid")[0]["pointer"] == "/steps/1/noise/sigma"


def test_a_body_that_is_not_json_is_refused(server: TestClient) -> None:
    json_type = {"content-type": "application/json"}
    answer = server.post("/v1/jobs", content=b'{"model": ', headers=json_type)
    assert "not JSON" in read_faults(answer, 422, "invalid")[0]["detail"]
    assert answer.json()["detail"].startswith("the body is not JSON")  # and no empty place


def test_a_fault_of_json_has_its_line_and_column(server: TestClient) -> None:
    answer = server.post(
        "/v1/jobs",
        content=b'{\n "model": "fopdt",\n "datasets": x\n}',
        headers={"content-type": "application/json"},
    )
    (fault,) = read_faults(answer, 422, "invalid")
    assert fault["detail"] == "the body is not JSON: line 3, column 14: Expecting value"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b'{"model": "\xff"}', "not UTF-8 text: byte 11"),
        (b"[" * 90_000, "nested too deeply"),
        (b'{"seed": ' + b"9" * 5000 + b"}", "a number with more than 4300 digits"),
    ],
)
def test_a_body_that_no_json_reader_takes_is_refused_with_the_reason(
    server: TestClient, text: bytes, words: str
) -> None:
    answer = server.post("/v1/jobs", content=text, headers={"content-type": "application/json"})
    assert words in read_faults(answer, 422, "invalid")[0]["detail"]


def test_a_recording_is_not_taken_twice(server: TestClient, dataset: str) -> None:
    for changes, pointer in (
        ({"datasets": [dataset, "steps"]}, "/datasets/1"),
        ({"validation": {"datasets": [dataset]}}, "/validation/datasets/0"),
    ):
        answer = server.post("/v1/jobs", json=with_changes(dataset, changes))
        fault = read_faults(answer, 422, "invalid")[0]
        assert fault["pointer"] == pointer
        assert "same recording" in fault["detail"]


def test_a_fixed_start_is_no_free_parameter_and_an_estimated_one_is(
    server: TestClient, dataset: str
) -> None:
    model = {**MODEL, "initial": {"x": {"lower": -1, "upper": 1}}}
    fixed = {"K": {"fixed": 1}, "L": {"fixed": 1}}
    body = {"model": model, "datasets": [dataset], "parameters": fixed}
    assert server.post("/v1/jobs", json=body).status_code == 202
    body["parameters"] = {**fixed, "x(0)": {"fixed": 0}}
    assert (
        read_faults(server.post("/v1/jobs", json=body), 422, "invalid")[0]["pointer"]
        == "/parameters"
    )


def test_a_population_that_no_memory_holds_is_refused(server: TestClient, dataset: str) -> None:
    names = [f"k{i}" for i in range(101)]
    model = {
        **MODEL,
        "parameters": {name: {"lower": 0, "upper": 1} for name in names},
        "equations": {"x": " + ".join(names) + " + u"},
    }
    body = {"model": model, "datasets": [dataset], "algorithm": {"population": 100_000}}
    fault = read_faults(server.post("/v1/jobs", json=body), 422, "invalid")[0]
    assert fault["pointer"] == "/algorithm/population"
    assert "At most 99009" in fault["detail"]


@pytest.mark.parametrize(
    ("query", "pointer"),
    [
        ("limit=x", "?limit"),
        ("limit=1001", "?limit"),
        ("state=queued&state=foo", "?state"),
    ],
)
def test_a_query_value_that_cannot_be_used_is_named(
    server: TestClient, query: str, pointer: str
) -> None:
    faults = read_faults(server.get(f"/v1/jobs?{query}"), 422, "invalid")
    assert faults[0]["pointer"] == pointer


def test_a_text_that_no_database_can_keep_is_refused(server: TestClient, dataset: str) -> None:
    body = with_changes(dataset, {"name": "nul \x00"})
    read_faults(server.post("/v1/jobs", json=body), 422, "invalid")


def test_an_unknown_channel_names_those_that_are_there(own: TestClient) -> None:
    stored = store_csv(own, recording(columns=("P1", "P2")))
    body = {"model": "fopdt", "datasets": [stored]}
    faults = read_faults(own.post("/v1/jobs", json=body), 422, "invalid")
    assert faults[0]["pointer"] == "/channels"
    assert "P1, P2" in faults[0]["detail"]


def test_an_output_that_is_its_own_input_is_refused(own: TestClient) -> None:
    stored = store_csv(own, recording(columns=("P1", "P2")))
    body = {"model": "fopdt", "datasets": [stored], "channels": {"u": "P2", "y": "P2"}}
    [fault] = read_faults(own.post("/v1/jobs", json=body), 422, "invalid")
    assert fault["pointer"] == "/channels/u"
    assert "both input 'u' and output 'y'" in fault["detail"]


def test_validation_data_in_other_units_or_with_other_channels_are_refused(own: TestClient) -> None:
    def store_columns(columns: str) -> str:
        text = recording().decode().replace("t,u,y", columns)
        return store_csv(own, text.encode(), f"{len(columns)}")

    fitted, other, alien = (
        store_columns("t,u [V],y [m]"),
        store_columns("t,u [V],y [mm]"),
        store_columns("t,u,z"),
    )
    body = {"model": "fopdt", "datasets": [fitted], "validation": {"datasets": [other]}}
    fault = read_faults(own.post("/v1/jobs", json=body), 422, "invalid")[0]
    assert fault["pointer"] == "/validation/datasets/0"
    assert "channel 'y' is in mm" in fault["detail"]
    body["validation"] = {"datasets": [alien]}
    fault = read_faults(own.post("/v1/jobs", json=body), 422, "invalid")[0]
    assert "has no channel 'y'" in fault["detail"]
    pooled = {"model": "fopdt", "datasets": [fitted, other]}
    fault = read_faults(own.post("/v1/jobs", json=pooled), 422, "invalid")[0]
    assert fault["pointer"] == "/datasets/1"
    assert "1 mm is 0.001 m" in fault["detail"]
    declared = {"model": "duffing-delay", "datasets": [fitted], "channels": {"q": "u"}}
    fault = read_faults(own.post("/v1/jobs", json=declared), 422, "invalid")[0]
    assert fault["pointer"] == "/datasets/0"
    assert "channel 'u' (signal 'q')" in fault["detail"]
    assert "but in model 'duffing-delay' it is in N" in fault["detail"]
