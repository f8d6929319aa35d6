"""The command line: what it prints, its exit codes, and one readable line for a mistake."""

import json
import os
import re
import signal
import socket
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.responses import PlainTextResponse

from service.api.app import create_app
from service.cli import drill
from service.cli.identify_command import FIELD_ORIGINS
from service.client.embedded import find_free_port
from service.core.errors import ServiceDidNotStart
from service.storage.migrate import find_head_revision
from sysid.core.errors import InvalidSettings
from sysid.identification import identify
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.commands import (
    PROGRAM,
    check_refusal,
    make_environment,
    run_lagid,
    run_lagid_process,
)
from tests.support.service.web_app import recording, settings_of
from tests.support.service.web_server import serve_in_thread

pytestmark = pytest.mark.slow  # some are processes of their own, and one identifies

OWN = """
name: own
form: differential
inputs: {u: V}
states: {x: m}
parameters: {K: {lower: 0, upper: 5}, T: {lower: 0.1, upper: 5}, L: {lower: 0, upper: 2, unit: s}}
equations: {x: (K*u(t - L) - x)/T}
outputs: {y: x}
initial: {x: measured}
"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The web application without a dispatcher."""
    with serve_in_thread(create_app(settings_of(tmp_path_factory.mktemp("served")))) as url:
        yield url


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recordings") / "steps.csv"
    path.write_bytes(recording())
    return path


def test_help_names_every_command() -> None:
    text = run_lagid_process("--help").stdout
    for command in (
        "serve",
        "identify",
        "submit",
        "watch",
        "jobs",
        "runs",
        "datasets",
        "models",
        "dataset",
        "cancel",
        "export",
        "db",
        "doctor",
        "demo",
        "dispatcher",
    ):
        assert command in text


def test_a_command_that_is_called_wrongly_exits_with_2(data: Path) -> None:
    assert run_lagid("submitt").code == 2
    assert run_lagid("identify", data).code == 2
    line = check_refusal(run_lagid("identify", data, "--model", "fopdt", "--set", "seed"), 2)
    assert "path=value" in line
    line = check_refusal(
        run_lagid("identify", data, "--model", "fopdt", "--set", "algorithm.bit=3"), 2
    )
    assert "did you mean 'bits'?" in line
    line = check_refusal(
        run_lagid("identify", data, "--model", "fopdt", "--noise-model", "pink"), 2
    )
    assert "need 'auto', 'white', 'ar1', 'plant', 'load' or 'drift'" in line


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["submitt"], "no such command 'submitt'. Did you mean 'submit'?"),
        (["identify", "a.csv"], "missing option '--model' (lagid identify --help)"),
        (["jobs", "--stat", "queued"], "no such option: --stat (Possible options: --state, --tag)"),
        (["jobs", "--state", "late"], "invalid value for '--state': 'late' is not one of"),
        (
            ["runs", "profile", "run_1", "--points", "2"],
            "invalid value for '--points': found '2'; need 3 or more (lagid runs profile --help)",
        ),
        (
            ["identify", "a.csv", "--model", "m", "--sample-time", "x"],
            "invalid value for '--sample-time': found 'x'; need a number (lagid identify --help)",
        ),
    ],
)
def test_words_that_a_command_does_not_have_are_one_line_of_ours(
    words: list[str], expected: str
) -> None:
    assert check_refusal(run_lagid(*words), 2).startswith(f"lagid: {expected}")


def test_a_command_without_its_words_shows_the_help() -> None:
    for words in ((), ("sweep",)):
        done = run_lagid(*words)
        assert done.code == 2
        assert "--help" in done.stdout + done.stderr
        assert "lagid: " not in done.stderr


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--set", "sweep.axes=[{path: /seed, values: [1, 2]}]"], "lagid submit"),
        (["--set", "validation.datasets=[other]"], "--validation FILE"),
        (["--set", "validation={datasets: [other]}"], "--validation FILE"),
        (["--set", "datasets=[other]"], "DATA"),
        (["--set", "model=tube"], "--model"),
        (
            ["--set", "initial.x.upper=9"],
            "is a parameter: --set 'parameters.x(0).upper=9'",
        ),
        (["--set", f"algorithm.stagnation={10**30}"], "lagid: --set algorithm.stagnation: "),
        (["--set", f"algorithm.stagnation={'9' * 5000}"], "lagid: "),
        (["--validation", "{data}"], "this is the estimation recording"),
    ],
)
def test_what_identify_cannot_do_in_this_process_is_refused(
    data: Path, words: list[str], expected: str
) -> None:
    words = [word if word != "{data}" else str(data) for word in words]
    done = run_lagid("identify", data, "--model", "fopdt", *words)
    assert expected in check_refusal(done, done.code)
    assert done.code in (1, 2)


def test_a_file_that_is_not_utf8_is_said_without_an_empty_place(tmp_path: Path) -> None:
    job = tmp_path / "job.yaml"
    job.write_bytes(b"model: \xff")
    assert check_refusal(run_lagid("submit", job)).startswith(
        f"lagid: {job}: the document is not UTF-8"
    )


def test_no_server_is_said_with_what_to_do() -> None:
    assert "lagid serve" in check_refusal(run_lagid("jobs"))


def test_a_port_in_use_is_one_line(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        words = ("serve", "--port", port, "--data-dir", tmp_path)
        ended = run_lagid_process(*words)
        assert run_lagid(*words) == ended
    line = check_refusal(ended)
    assert f"port {port}" in line
    assert "in use" in line


def test_a_data_folder_that_is_not_writable_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    line = check_refusal(run_lagid("serve", "--port", 0, "--data-dir", tmp_path / "file" / "data"))
    assert "not writable" in line


def test_a_database_that_cannot_be_opened_is_one_line(tmp_path: Path) -> None:
    nowhere = "postgresql://lagid:secret@127.0.0.1:1/lagid"
    line = check_refusal(
        run_lagid("serve", "--port", 0, "--data-dir", tmp_path, LAGID_DATABASE_URL=nowhere)
    )
    assert "the database cannot be opened" in line
    assert "LAGID_DATABASE_URL" in line
    assert "secret" not in line


def test_another_host_is_refused_without_keys(tmp_path: Path) -> None:
    line = check_refusal(run_lagid("serve", "--host", "0.0.0.0", "--data-dir", tmp_path))
    assert "LAGID_ALLOW_OPEN_HOST" in line


def test_a_setting_that_cannot_be_used_names_its_variable(tmp_path: Path) -> None:
    line = check_refusal(run_lagid("serve", "--data-dir", tmp_path, LAGID_PORT="many"))
    assert "LAGID_PORT" in line


def test_built_in_models_are_listed_shown_and_checked(tmp_path: Path) -> None:
    environment = {"LAGID_URL": ""}
    listed = json.loads(run_lagid("models", "list", "--json", **environment).stdout)
    assert {"tube", "duffing-eq16"} <= {one["name"] for one in listed}
    shown = tmp_path / "tube.yaml"
    shown.write_text(run_lagid("models", "show", "tube", **environment).stdout)
    assert run_lagid("models", "check", shown).code == 0


def test_a_fault_of_a_model_has_its_column(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(OWN.replace("- x)/T", "- z)/T"))
    line = check_refusal(run_lagid("models", "check", path))
    assert "column" in line
    assert "'z'" in line
    path.write_text(OWN.replace("K: {", "P: {lower: 0, upper: 1}, K: {") + "let: {spare: 2*T}\n")
    checked = run_lagid("models", "check", path)
    assert checked.code == 0
    assert "/let/spare: warning: nothing uses 'spare'" in checked.stderr
    assert "/parameters/P: warning: no equation" in checked.stderr


@pytest.mark.slow
def test_identify_finds_gain_lag_and_time_constant_in_this_process(
    data: Path, tmp_path: Path
) -> None:
    model = tmp_path / "own.yaml"
    model.write_text(OWN)
    result = tmp_path / "out.json"
    done = run_lagid_process(
        "identify",
        data,
        "--model",
        model,
        "--set",
        "algorithm.generations=150",
        "--set",
        "validation.fraction=0.4",
        "--output",
        result,
    )
    assert done.code == 0, done.stderr
    document = json.loads(result.read_text())
    assert done.stdout.startswith(f"verdict: {document['verdict']['text']}\n")
    notes = " ".join(done.stderr.split())
    assert document["warnings"]
    for text in document["warnings"]:
        assert f"note: {FIELD_ORIGINS.rewrite_note(text)}" in notes
    found = {one["name"]: one for one in document["parameters"]}
    truth = {"K": 2.0, "T": 1.0, "L": 0.5}
    for name, value in truth.items():
        assert np.isclose(found[name]["value"], value, atol=0.2)
    assert document["fit_percent"]["validation"] > 80
    assert f"; validation RMS {document['rms_validation']:.6g}" in done.stdout
    verdict = "passed" if json.loads(result.read_text())["residual_tests"]["passed"] else "failed"
    assert f"residuals on validation data: {verdict}" in done.stdout


def test_identify_starts_at_rest_if_it_is_told_to(data: Path, tmp_path: Path) -> None:
    result = tmp_path / "out.json"
    settings = ("initial=rest", "algorithm.generations=20")
    options = [word for setting in settings for word in ("--set", setting)]
    done = run_lagid("identify", data, "--model", "fopdt", *options, "--output", result)
    assert done.code == 0, done.stderr
    document = json.loads(result.read_text())
    assert document["initial"] == "rest"
    assert [one["name"] for one in document["parameters"]] == ["K", "T", "L", "y0"]


@pytest.mark.slow
def test_identify_samples_the_posterior_as_far_as_the_budget_goes(
    data: Path, tmp_path: Path
) -> None:
    settings = ("noise.sigma=0.05", "algorithm.generations=20", "algorithm.stop.evaluations=6000")
    options = [word for setting in settings for word in ("--set", setting)]
    result = tmp_path / "out.json"
    words = ("identify", data, "--model", "fopdt", *options, "--posterior", "--output", result)
    done = run_lagid(*words)
    assert done.code == 0, done.stderr
    (heading,) = [line for line in done.stdout.splitlines() if line.startswith("posterior ")]
    assert heading.split("  ")[-1].strip() == "effective samples"
    assert "the samples of the posterior have not converged" in " ".join(done.stderr.split())
    document = json.loads(result.read_text())
    assert document["evaluations"] <= 6000
    for parameter in document["posterior"]["parameters"]:
        assert f"{parameter['median']:.6g}" in done.stdout


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--model", "fopd"], "did you mean 'fopdt'?"),
        (["--model", "missing.yaml"], "missing.yaml"),
        (["--model", "."], "--model: . is a folder"),
        (["--model", "fopdt", "--set", "L.upper=20"], "did you mean parameters.L"),
        (["--model", "fopdt", "--channels", "u=volts"], "no channel 'volts'"),
        (["--model", "fopdt", "--channels", "w=u"], "no signal 'w'"),
        (
            ["--model", "fopdt", "--set", "parameters.L.lower=9", "--set", "parameters.L.upper=5"],
            "[9, 5]",
        ),
        (
            ["--model", "fopdt", "--set", "parameters.K.tied=T", "--set", "parameters.T.tied=K"],
            "lagid: --set parameters.K.tied: the ties are circular",
        ),
        (
            ["--model", "fopdt", "--set", "parameters.LL.upper=9", "--set", "hold.y=zero"],
            "did you mean 'L'?; --set hold.y: found 'zero'; need one of auto, mean, mean-after for "
            "an output",
        ),
        (
            ["--model", "fopdt", "--noise-model", "ar1", "--set", "prediction=one-step"],
            "--noise-model: ar1 needs the prediction 'simulation'",
        ),
        (
            ["--model", "fopdt", "--set", "initial=resting"],
            "--set initial: found 'resting'; need 'rest', 'free', 'measured' or 'auto'",
        ),
        (
            ["--model", "fopdt", "--set", "initial=measured"],
            "--set initial: 'measured' has no meaning for model 'fopdt'",
        ),
    ],
)
def test_a_mistake_of_identify_is_one_line(data: Path, words: list[str], expected: str) -> None:
    assert expected in check_refusal(run_lagid("identify", data, *words), 2)


def test_identify_tells_all_that_cannot_be_read_first(data: Path) -> None:
    words = ("--set", "seed=x", "--set", "parameters.LL.upper=9", "--set", "bits=3")
    line = check_refusal(run_lagid("identify", data, "--model", "fopdt", *words), 2)
    assert "--set seed: found 'x'; need a whole number" in line
    assert "--set bits: unknown field 'bits'; there is --set algorithm.bits" in line
    assert "LL" not in line


def test_a_constant_output_is_told_once_and_before_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "idle.csv"
    path.write_text("t,u,y\n" + "".join(f"{t},{int(t > 9)},20.5\n" for t in range(40)))
    words = ("identify", path, "--model", "fopdt", "--set", "algorithm.generations=5")
    note = "output 'y' is constant (20.5) at all 40 samples"
    assert run_lagid(*words).stderr.count(note) == 1

    def refuse(*_: object) -> None:
        raise InvalidSettings("/seed", "no search in this test")

    monkeypatch.setattr(identify, "begin_run", refuse)
    ended = run_lagid(*words)
    assert ended.code == 2
    assert ended.stderr.index(note) < ended.stderr.index("no search in this test")


def test_a_recording_that_is_not_there_or_not_readable_is_one_line(tmp_path: Path) -> None:
    assert "there is no file" in check_refusal(
        run_lagid("identify", tmp_path / "x.csv", "--model", "fopdt")
    )
    bad = tmp_path / "bad.csv"
    bad.write_text("t,u,y\n0,1,2\n0.1,volt,2\n")
    assert "row 3" in check_refusal(run_lagid("identify", bad, "--model", "fopdt"))


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b'{"t": [0, 1]}', "the JSON holds no list of records"),
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "the spreadsheet cannot be opened"),
        (b"t,u\n0,1\n1,a\n", "row 3, column 'u': found 'a'"),
        (b"u,y\n0,1\n1,2\n", "row 1: there is no time column; found u, y"),
    ],
)
def test_every_refusal_of_a_file_begins_with_its_name(
    server: str, tmp_path: Path, content: bytes, told: str
) -> None:
    path = tmp_path / "rig.dat"
    path.write_bytes(content)
    for words in (
        ("identify", path, "--model", "fopdt"),
        ("dataset", "add", path),
        ("reidentify", "--model", "fopdt", "--label", "x", f"1={path}", f"2={path}"),
    ):
        line = check_refusal(run_lagid(*words, LAGID_URL=server))
        assert line.startswith(f"lagid: {path}: {told}")
    folder = check_refusal(run_lagid("dataset", "add", tmp_path, LAGID_URL=server))
    assert folder == f"lagid: {tmp_path} is a folder; name a file"


def test_several_recordings_are_stored_at_once(server: str, data: Path, tmp_path: Path) -> None:
    copies = [tmp_path / f"tube {number}.csv" for number in (1, 2)]
    for number, copy in enumerate(copies):
        copy.write_bytes(data.read_bytes().replace(b"0.5", b"0.5%d" % number))
    named = check_refusal(run_lagid("dataset", "add", *copies, "--name", "x", LAGID_URL=server), 2)
    assert named == "lagid: --name names one recording; found 2 files"
    stored = run_lagid("dataset", "add", *copies, LAGID_URL=server)
    lines = [line for line in stored.stdout.splitlines() if line.startswith("ds_")]
    assert [line.partition(":")[0].split()[1:] for line in lines] == [["tube", "1"], ["tube", "2"]]
    listed = json.loads(run_lagid("dataset", "add", *copies, "--json", LAGID_URL=server).stdout)
    assert [dataset["name"] for dataset in listed] == ["tube 1", "tube 2"]


def test_a_recording_and_a_job_go_to_the_server_and_can_be_cancelled(
    server: str, data: Path, tmp_path: Path
) -> None:
    environment = {"LAGID_URL": server}
    stored = json.loads(run_lagid("dataset", "add", data, "--json", **environment).stdout)
    assert stored["name"] == "steps"
    assert "steps" in run_lagid("datasets", **environment).stdout
    again = run_lagid("dataset", "add", data, "--name", "other", **environment)
    assert "already stored as 'steps'" in again.stdout
    job = tmp_path / "job.yaml"
    job.write_text("model: fopdt\ndatasets: [steps]\nseed: 3\n")
    done = run_lagid("submit", job, "--json", **environment)
    submitted: dict[str, Any] = json.loads(done.stdout)
    assert submitted["id"] in run_lagid("jobs", **environment).stdout
    assert "queued" in run_lagid("runs", **environment).stdout
    assert "cancelled" in run_lagid("cancel", submitted["id"], **environment).stdout
    watched = run_lagid_process("watch", submitted["id"], "--json", **environment)
    assert watched.code == 1
    assert json.loads(watched.stdout)["state"] == "cancelled"
    assert "queued" in run_lagid("resume", submitted["id"], **environment).stdout


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("model: fopdt\ndatasets: [steps.csv]\n", "lagid dataset add steps.csv"),
        ("- a\n", "does not hold a job"),
        ("model: [\n", "line"),
        ("model: fopdt\ndatasets: [nothing]\n", "no dataset 'nothing'"),
        ("model: fopdt\ndatasets: []\nsed: 1\n", "did you mean 'seed'?"),
    ],
)
def test_a_job_file_that_cannot_be_used_is_one_line(
    server: str, tmp_path: Path, text: str, expected: str
) -> None:
    job = tmp_path / "job.yaml"
    job.write_text(text)
    assert expected in check_refusal(run_lagid("submit", job, LAGID_URL=server))


def test_a_server_ends_in_order_on_sigterm_and_so_does_an_open_event_stream(
    tmp_path: Path,
) -> None:
    port = find_free_port()
    url = f"http://127.0.0.1:{port}"
    words = ("serve", "--no-dispatcher", "--port", str(port), "--data-dir", str(tmp_path))
    child = subprocess.Popen(
        [*PROGRAM, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=make_environment({}),
    )
    try:
        assert child.stdout is not None
        assert url in child.stdout.readline()
        _wait_until_answering(url)
        with httpx.Client(base_url=url, timeout=LIMIT_SECONDS) as http:
            csv = {"content-type": "text/csv"}
            dataset = http.post("/v1/datasets", content=recording(), headers=csv).json()["id"]
            body = {"model": "fopdt", "datasets": [dataset]}
            job = http.post("/v1/jobs", json=body).json()["id"]
            with http.stream("GET", f"/v1/jobs/{job}/events") as stream:
                lines = stream.iter_lines()
                assert next(lines).startswith("retry")
                child.send_signal(signal.SIGTERM)
                for _ in lines:
                    pass  # the stream ends, and so does the loop
        rest, _ = child.communicate(timeout=LIMIT_SECONDS)
        assert child.returncode == 0, rest
    finally:
        child.kill()
        child.communicate()


def _wait_until_answering(url: str) -> None:
    limit = time.monotonic() + LIMIT_SECONDS
    while time.monotonic() < limit:
        try:
            httpx.get(f"{url}/healthz").raise_for_status()
            return
        except httpx.HTTPError:
            time.sleep(0.1)
    raise AssertionError("the server does not answer")


def test_a_reader_that_goes_away_ends_a_command_without_a_message() -> None:
    """As in `lagid export … | head -1`."""
    app = FastAPI()
    app.get("/v1/runs/run_1/export")(lambda: PlainTextResponse("line\n" * 1000))
    reading, writing = os.pipe()
    os.close(reading)
    with serve_in_thread(app) as url, os.fdopen(writing, "wb") as closed:
        done = subprocess.run(
            [*PROGRAM, "export", "run_1"],
            stdout=closed,
            stderr=subprocess.PIPE,
            text=True,
            timeout=LIMIT_SECONDS,
            check=False,
            env=make_environment({"LAGID_URL": url}),
        )
    assert (done.returncode, done.stderr) == (1, "")


def test_tables_are_made_and_checked_by_command(tmp_path: Path) -> None:
    assert "no database" in check_refusal(run_lagid("db", "check", "--data-dir", tmp_path))
    assert run_lagid("db", "upgrade", "--data-dir", tmp_path).code == 0
    assert "at head" in run_lagid("db", "check", "--data-dir", tmp_path).stdout


def test_a_database_of_another_lagid_is_one_line_for_every_command(tmp_path: Path) -> None:
    assert run_lagid("db", "upgrade", "--data-dir", tmp_path).code == 0
    with closing(sqlite3.connect(tmp_path / "lagid.db")) as database, database:
        database.execute("UPDATE alembic_version SET version_num = '9999'")
    commands = [("serve", "--no-dispatcher", "--port", 0), ("db", "check"), ("db", "upgrade")]
    for words in (*commands, ("db", "downgrade", "base", "--yes")):
        line = check_refusal(run_lagid(*words, "--data-dir", tmp_path))
        assert "the database is at revision 9999" in line
        assert f"`lagid db downgrade {find_head_revision()}`" in line
        assert "a new folder with --data-dir" in line


def test_a_downgrade_tells_what_is_lost_and_asks(tmp_path: Path) -> None:
    place = ("--data-dir", tmp_path)
    assert "no database" in check_refusal(run_lagid("db", "downgrade", "base", *place))
    assert run_lagid("db", "upgrade", *place).code == 0
    unknown = check_refusal(run_lagid("db", "downgrade", "0009", *place))
    assert "'0009' is not an earlier revision" in unknown
    assert "base" in unknown
    asked = run_lagid("db", "downgrade", "base", *place)
    assert "undoes v1: Create the first tables" in asked.stdout
    assert "loses all of its data" in asked.stdout
    assert "--yes" in check_refusal(asked)
    assert "at head" in run_lagid("db", "check", *place).stdout  # nothing was done
    assert run_lagid("db", "downgrade", "base", "--yes", *place).code == 0
    assert "revision none" in check_refusal(run_lagid("db", "check", *place))
    assert run_lagid("db", "upgrade", *place).code == 0


def test_a_data_folder_that_others_can_read_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data").chmod(0o750)
    with socket.socket() as taken:  # so that it ends
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        words = ("serve", "--port", taken.getsockname()[1], "--data-dir", tmp_path / "data")
        warning, _refused = run_lagid(*words).stderr.splitlines()
    assert warning.startswith("warning: other users")
    assert f"`chmod 700 {tmp_path / 'data'}`" in warning


@pytest.mark.slow
def test_the_doctor_finds_a_sound_installation(tmp_path: Path) -> None:
    done = run_lagid_process("doctor", "--data-dir", tmp_path, LAGID_PORT=str(find_free_port()))
    assert done.code == 0, done.stderr
    assert "compiled" in done.stdout


@pytest.mark.slow
def test_the_doctor_kills_a_worker_and_restores_a_backup_beside_the_users_data(
    tmp_path: Path,
) -> None:
    own = {"LAGID_DATABASE_URL": "postgresql://nobody@127.0.0.1:1/none", "LAGID_AUTH": "keys"}
    told = run_lagid_process(
        "doctor",
        "--deep",
        "--json",
        "--data-dir",
        tmp_path / "data",
        LAGID_PORT=str(find_free_port()),
        LAGID_CPUS="1",
        **own,
    )
    assert told.code == 0, told.stdout + told.stderr
    found = {one["check"]: one["detail"] for one in json.loads(told.stdout)}
    assert re.search(r"process \d+ was killed.* bit for bit equal", found["drill: a worker dies"])
    assert "objects" in found["drill: backup"]
    assert not (tmp_path / "data").exists()


def test_a_drill_whose_service_does_not_start_says_so_in_each_step(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(*_arguments: object, **_options: object) -> None:
        raise ServiceDidNotStart("it ended with exit code 1")

    monkeypatch.setattr(drill, "run_embedded_service", fail)
    monkeypatch.setenv("LAGID_PORT", str(find_free_port()))
    told = run_lagid("doctor", "--deep", "--json", "--data-dir", tmp_path)
    assert told.code == 1
    failed = {one["check"]: one["detail"] for one in json.loads(told.stdout) if not one["ok"]}
    assert failed == {
        "drill: start": "the service did not start: it ended with exit code 1",
        "drill: a worker dies": "not tried: the service did not start",
        "drill: backup": "not tried: the service did not start",
    }


def test_a_number_that_is_none_is_one_line_and_never_sent(tmp_path: Path) -> None:
    job = tmp_path / "job.yaml"
    job.write_text("model: fopdt\ndatasets: [a]\nparameters: {L: {upper: .inf}}\n")
    said = check_refusal(run_lagid("submit", job), 2)
    assert said == f"lagid: {job}: /parameters/L/upper: found inf; need a finite number"


NOISE = (
    "sweep",
    "noise",
    "--model",
    "fopdt",
    "--true",
    "K=2",
    "--true",
    "T=1",
    "--true",
    "L=0.5",
    "--true",
    "y0=0",
    "--input",
    "u=sin(t)",
    "--samples",
    100,
    "--sample-time",
    0.1,
)


def test_a_noise_sweep_is_submitted_with_the_settings_that_were_given(server: str) -> None:
    words = (
        *NOISE,
        "--sigma",
        "0:0.2:0.1",
        "--replicates",
        2,
        "--methods",
        "improved",
        "--set",
        "algorithm.population=12",
        "--set",
        "parameters.L.upper=1",
    )
    done = run_lagid(*words, "--json", LAGID_URL=server)
    assert done.code == 0, done.stderr
    job = json.loads(done.stdout)
    assert job["progress"]["runs"] == 6
    request = httpx.get(f"{server}/v1/jobs/{job['id']}", timeout=LIMIT_SECONDS).json()["request"]
    assert request["algorithm"]["population"] == 12
    assert request["parameters"] == {"L": {"upper": 1}}
    assert request["sweep"]["axes"][0]["values"] == [0, 0.1, 0.2]
    again = run_lagid(*words, LAGID_URL=server)
    assert "6 runs, queued" in again.stdout


def test_a_mistake_of_a_noise_sweep_is_one_line(server: str) -> None:
    for words, code, expected in (
        ((*NOISE, "--sigma", "0:1"), 2, "start:stop:step"),
        ((*NOISE, "--sigma", "0.1", "--data", "steps"), 2, "either --data"),
        ((*NOISE, "--sigma", "0.1", "--true", "K"), 2, "NAME=VALUE"),
        ((*NOISE, "--sigma", "0.1", "--true", "Q=1"), 1, "lagid: --true Q: the model has no"),
        ((*NOISE, "--sigma", "-0.1"), 1, "lagid: --sigma: found -0.1; need 0 or"),
        ((*NOISE, "--sigma", "0.1", "--replicates", 0), 1, "--replicates: found 0; need 1"),
        (("runs", "job_none"), 1, "lagid: there is no job job_none"),
        ((*NOISE, "--sigma", "0.1", "--methods", "best"), 1, "--methods: found 'best'"),
    ):
        assert expected in check_refusal(run_lagid(*words, LAGID_URL=server), code)


def test_a_recording_is_checked_without_a_server_and_a_model(tmp_path: Path) -> None:
    rows = [f"{k},{k % 40 // 20},{np.sin(0.1 * k):.9f}" for k in range(600) if not 200 <= k < 400]
    (tmp_path / "gap.csv").write_text("\n".join(["t,u,y", *rows, ""]))
    (tmp_path / "sound.csv").write_bytes(recording())
    told = run_lagid("dataset", "check", "gap.csv", cwd=tmp_path)
    assert told.code == 0
    assert "outage: u and y have no value from 199 to 400 s (200 rows)" in told.stdout
    (finding,) = json.loads(run_lagid("dataset", "check", "gap.csv", "--json", cwd=tmp_path).stdout)
    assert finding["spans"] == [[199.0, 400.0]]
    assert "nothing was found" in run_lagid("dataset", "check", "sound.csv", cwd=tmp_path).stdout
