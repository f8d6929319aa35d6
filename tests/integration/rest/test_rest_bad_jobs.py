"""Jobs whose data cannot tell what is asked: refused when sent, or said with the run."""

from collections.abc import Iterator
from typing import Any

import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner

from service.api.app import create_app
from service.api.requests.dependencies import Parts
from service.cli.main import build_program
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import read_faults, recording, settings_of, store_csv

SMALL = {"population": 20, "generations": 20, "islands": 1}
FIRST: dict[str, Any] = {
    "name": "first",
    "form": "differential",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {
        "K": {"lower": 0.1, "upper": 5},
        "T": {"lower": 0.1, "upper": 5},
        "L": {"lower": 0, "upper": 2},
    },
    "equations": {"x": "(K*u(t - L) - x)/T"},
    "outputs": {"y": "x"},
    "initial": {"x": 0},
}


def constant(u: float | None = None, y: float | None = None) -> bytes:
    """The usual recording with a constant in the place of its input or its output."""
    head, *rows = recording().decode().split()
    cells = [row.split(",") for row in rows]
    kept = [(t, a if u is None else str(u), b if y is None else str(y)) for t, a, b in cells]
    return "\n".join([head, *(",".join(row) for row in kept)]).encode()


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[TestClient, Parts]]:
    app = create_app(settings_of(tmp_path_factory.mktemp("bad")))
    with TestClient(app, raise_server_exceptions=False) as client:
        yield client, app.state.parts


def identify_on(parts: tuple[TestClient, Parts], content: bytes, **fields: Any) -> dict[str, Any]:
    """The one run of a job on that recording, carried out."""
    client, inside = parts
    body = {"model": FIRST, "datasets": [store_csv(client, content)], "algorithm": SMALL, **fields}
    _, (run,) = identify_job(inside, body)
    answer = client.get(f"/v1/runs/{run}")
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_a_delay_in_another_unit_is_refused_to_a_job_and_to_the_store(
    parts: tuple[TestClient, Parts],
) -> None:
    client, _ = parts
    delay = {"lower": 0, "upper": 2, "unit": "min"}
    model = {**FIRST, "parameters": {**FIRST["parameters"], "L": delay}}
    said = "found 'min', but this delay is in seconds: give it in s, or write t - 60*L"
    job = read_faults(
        client.post("/v1/jobs", json={"model": model, "datasets": ["r"]}), 422, "invalid"
    )
    assert ("/model/parameters/L/unit", said) in [(one["pointer"], one["detail"]) for one in job]
    [fault] = read_faults(client.post("/v1/models", json=model), 422, "invalid")
    assert (fault["pointer"], fault["detail"]) == ("/parameters/L/unit", said)


def test_an_input_that_is_zero_fails_the_run_with_one_line_that_says_why(
    parts: tuple[TestClient, Parts],
) -> None:
    run = identify_on(parts, constant(u=0.0))
    assert run["state"] == "failed"
    assert "none of K, T, L has an effect on the output" in str(run["error"])
    assert "Traceback" not in str(run["error"])


def test_an_input_that_is_constant_is_told_with_what_it_leaves_open(
    parts: tuple[TestClient, Parts],
) -> None:
    run = identify_on(parts, constant(u=1.0), model="fopdt")
    assert run["state"] == "succeeded"
    (text,) = (one for one in run["warnings"] if "excites nothing" in one)
    left = text.partition("unidentified: ")[2].partition(". ")[0].split(", ")
    status = {one["name"]: one["status"] for one in run["parameters"]}
    assert left
    assert all(status[name] in ("group", "unidentifiable") for name in left)


def test_a_constant_output_is_fitted_and_the_fit_is_said_to_be_none(
    parts: tuple[TestClient, Parts],
) -> None:
    run = identify_on(parts, constant(y=1.5))
    assert run["state"] == "succeeded"
    assert any("worse than a straight line" in one for one in run["warnings"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["--set", "parameters.L.fixed=9", "--set", "parameters.L.upper=5"],
            "9 lies outside the bounds [0, 5] of 'L'",
        ),
        (["--set", "parameters.K.tied=T", "--set", "parameters.T.tied=K"], "circular, K → T → K"),
    ],
)
def test_the_command_line_says_the_same_in_one_line(
    tmp_path: Any, options: list[str], words: str
) -> None:
    path = tmp_path / "steps.csv"
    path.write_bytes(recording())
    found = CliRunner().invoke(
        build_program(), ["identify", str(path), "--model", "fopdt", *options]
    )
    assert found.exit_code != 0
    assert words in " ".join((found.output + str(found.exception or "")).split())


def test_what_would_have_no_effect_is_refused_with_its_place(
    parts: tuple[TestClient, Parts],
) -> None:
    dead = {**FIRST, "parameters": {**FIRST["parameters"], "q": {"lower": 0, "upper": 1}}}
    terms = {
        "name": "terms",
        "form": "polynomial",
        "output": "y",
        "inputs": {"u": "1"},
        "degree": 1,
        "lags": {"y": [1], "u": ["1 + d"]},
        "parameters": {"d": {"lower": 0, "upper": 6}},
        "terms": ["y(k-1)"],
        "coefficients": {"lower": -2, "upper": 2},
    }
    data = store_csv(parts[0], recording())
    for body, pointer, words in (
        ({"model": dead}, "/parameters/q", "no equation and no output of model 'first' uses 'q'"),
        ({"model": terms}, "/parameters/d", "no term of model 'terms' uses 'd'"),
        ({"model": FIRST, "weights": {"y": 2}}, "/weights/y", "a weight would change nothing"),
    ):
        answer = parts[0].post("/v1/jobs", json={**body, "datasets": [data]})
        faults = read_faults(answer, 422, "invalid")
        assert [one for one in faults if one["pointer"] == pointer and words in one["detail"]], (
            faults
        )
    accepted = {"model": dead, "datasets": [data], "parameters": {"q": {"fixed": 0.5}}}
    assert parts[0].post("/v1/jobs", json=accepted).status_code == 202


def test_a_lag_that_the_record_has_no_room_for_is_refused_by_its_name(
    parts: tuple[TestClient, Parts],
) -> None:
    own = parts[0]
    short = store_csv(own, recording(40))
    body: dict[str, Any] = {
        "model": "fopdt",
        "datasets": [short],
        "parameters": {"L": {"upper": 5}},
    }
    fault = read_faults(own.post("/v1/jobs", json=body), 422, "invalid")[0]
    assert fault["pointer"] == "/datasets/0"
    assert "lasts 3.9 s" in fault["detail"]
    assert "the upper bound of L is 5 s" in fault["detail"]
    assert "a smaller upper bound of L: below 3.9 s" in fault["detail"]
    body["parameters"] = {"L": {"fixed": 4.5}}
    fault = read_faults(own.post("/v1/jobs", json=body), 422, "invalid")[0]
    assert "(L is 4.5 s); give a longer record, or a smaller L: below 3.9 s" in fault["detail"]
