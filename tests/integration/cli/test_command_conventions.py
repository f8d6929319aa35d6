"""Standard input, JSON, files that exist, and lists, with a server and without."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import Any

import pytest

import lagid
from service.api.app import create_app
from service.client.client import Client
from tests.support.checkout import ROOT
from tests.support.service.commands import CommandResult, check_refusal, run_lagid
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import recording, settings_of
from tests.support.service.web_server import serve_in_thread

pytestmark = pytest.mark.slow  # some identify

MODEL = """
name: own
form: differential
inputs: {u: V}
states: {x: m}
parameters: {K: {lower: 0, upper: 5}, T: {lower: 0.1, upper: 5}, L: {lower: 0, upper: 2, unit: s}}
equations: {x: (K*u(t - L) - x)/T}
outputs: {y: x}
initial: {x: 0}
"""
FAST = {"population": 20, "generations": 20, "islands": 1}


@pytest.fixture(scope="module")
def server_job(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """A server with a recording `steps` and one finished job: its address, and the job."""
    app = create_app(settings_of(tmp_path_factory.mktemp("served")))
    with serve_in_thread(app) as url, Client(url) as client:
        data = client.add_dataset(recording(), "steps")["id"]
        job, _ = identify_job(
            app.state.parts, {"model": "fopdt", "datasets": [data], "algorithm": FAST}
        )
        yield url, job


@pytest.fixture
def ask(server_job: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> "Ask":
    return Ask(server_job[0], tmp_path, monkeypatch)


class Terminal(TextIOWrapper):
    """Standard input of somebody who answers."""

    def isatty(self) -> bool:
        return True


class Ask:
    """Runs commands in an empty folder, with the server and with a standard input."""

    def __init__(self, url: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._url, self._folder, self._monkeypatch = url, folder, monkeypatch

    def __call__(
        self,
        *words: object,
        stdin: bytes | str = b"",
        kind: type[TextIOWrapper] = TextIOWrapper,
    ) -> CommandResult:
        content = stdin if isinstance(stdin, bytes) else stdin.encode()
        self._monkeypatch.setattr(sys, "stdin", kind(BytesIO(content)))
        return run_lagid(*words, cwd=self._folder, LAGID_URL=self._url)

    def read_json(self, *words: object, stdin: bytes | str = b"") -> Any:
        done = self(*words, "--json", stdin=stdin)
        assert done.code == 0, done.stderr
        return json.loads(done.stdout)


def test_documents_and_recordings_come_from_standard_input(ask: Ask) -> None:
    moved = recording().replace(b"\n0.1,", b"\n0.10,", 1)
    stored = ask.read_json("dataset", "add", "-", "--name", "piped", stdin=moved)
    assert stored["name"] == "piped"
    assert ask.read_json("models", "check", "-", stdin=MODEL)["valid"] is True
    added = ask.read_json("models", "add", "-", stdin=MODEL)
    assert (added["name"], added["version"]) == ("own", 1)
    job = ask.read_json("submit", "-", stdin="model: own\ndatasets: [piped]\nseed: 7\n")
    assert job["state"] == "queued"
    derived = ask.read_json("dataset", "derive", "piped", "-", stdin="- trim: {stop: 20}\n")
    assert derived["samples"] < stored["samples"]


def test_a_mistake_in_standard_input_is_told_as_one_of_a_file(ask: Ask) -> None:
    line = check_refusal(ask("submit", "-", stdin="model: fopdt\ndatasets: [steps]\nsed: 1\n"))
    assert line.startswith("lagid: standard input: /sed: unknown field")
    line = check_refusal(ask("models", "add", "-", stdin="- a\n"))
    assert line == "lagid: standard input does not hold a model (name, equations, …)"
    line = check_refusal(ask("identify", "-", "--model", "fopdt"))
    assert re.match("lagid: standard input.* is empty", line)


def test_identify_reads_csv_and_mcap_from_standard_input(ask: Ask, tmp_path: Path) -> None:
    settings = (f"algorithm.{name}={value}" for name, value in FAST.items())
    options = [word for setting in settings for word in ("--set", setting)]
    words = ("identify", "-", "--model", "fopdt", *options)
    found = ask.read_json(*words, stdin=recording())
    assert ask("dataset", "download", "steps", "-o", "steps.mcap").code == 0
    again = ask.read_json(*words, stdin=(tmp_path / "steps.mcap").read_bytes())
    assert again["parameters"] == found["parameters"]
    line = check_refusal(ask(*words, "--channels", "u=volts", stdin=recording()), 2)
    assert line.startswith("lagid: --channels u: there is no channel 'volts'")
    quiet = ask(*words, "--quiet", "--output", "found.json", stdin=recording())
    assert quiet.stderr == ""
    assert quiet.stdout.startswith("verdict: ")
    assert "standard error" in quiet.stdout
    written = json.loads((tmp_path / "found.json").read_text())
    assert written["parameters"] == found["parameters"]


def test_a_dataset_is_shown_by_name_and_by_id(ask: Ask) -> None:
    stored = ask.read_json("dataset", "show", "steps")
    assert ask.read_json("dataset", "show", stored["id"]) == stored
    shown = ask("dataset", "show", "steps").stdout
    assert f"{stored['id']}  steps: {stored['samples']} samples" in shown
    for channel in stored["channels"]:
        assert f"{channel['name']} " in shown
    line = check_refusal(ask("dataset", "show", "step"))
    assert line == "lagid: there is no dataset 'step'; did you mean 'steps'?"
    assert "no dataset" in check_refusal(ask("dataset", "show", "ds_none"))


def test_a_dataset_is_downloaded_and_no_file_is_overwritten(ask: Ask, tmp_path: Path) -> None:
    assert ask("dataset", "download", "steps", "--format", "csv").stdout == "steps.csv\n"
    text = (tmp_path / "steps.csv").read_text()
    assert text == ask("dataset", "download", "steps", "--format", "csv", "-o", "-").stdout
    assert ask("dataset", "download", "steps", "-o", "by-name.csv").code == 0
    assert (tmp_path / "by-name.csv").read_text() == text
    assert text.splitlines()[0].startswith("t")
    (tmp_path / "steps.csv").write_text("mine")
    line = check_refusal(ask("dataset", "download", "steps", "--format", "csv"))
    assert line == (
        "lagid: steps.csv exists, and nothing was written. Add --force, or name another by --output"
    )
    assert (tmp_path / "steps.csv").read_text() == "mine"
    assert ask("dataset", "download", "steps", "--format", "csv", "--force").code == 0
    assert (tmp_path / "steps.csv").read_text() == text
    assert not list(tmp_path.glob("*.part"))


def test_a_download_that_fails_leaves_the_file_as_it_was(ask: Ask, tmp_path: Path) -> None:
    (tmp_path / "place").write_text("a file")
    line = check_refusal(ask("dataset", "download", "steps", "-o", "place/steps.mcap"), 2)
    assert "--output place/steps.mcap: there is no folder place" in line
    (tmp_path / "steps.mcap").write_text("old")
    assert "dataset" in check_refusal(ask("dataset", "download", "none", "-o", "steps.mcap", "-f"))
    assert (tmp_path / "steps.mcap").read_text() == "old"


def test_a_report_is_not_overwritten_without_asking(
    ask: Ask, server_job: tuple[str, str], tmp_path: Path
) -> None:
    assert ask("report", server_job[1]).code == 0
    page = (tmp_path / "report.html").read_text()
    assert "report.html exists" in check_refusal(ask("report", server_job[1]))
    (tmp_path / "report.html").write_text("another")
    assert ask("report", server_job[1], "--force").code == 0
    assert len((tmp_path / "report.html").read_text()) == len(page)


def test_an_answer_on_a_terminal_decides(
    ask: Ask, server_job: tuple[str, str], tmp_path: Path
) -> None:
    (tmp_path / "report.html").write_text("mine")
    refused = ask("report", server_job[1], stdin="n\n", kind=Terminal)
    assert refused.code == 1
    assert "report.html exists. Overwrite it? [y/N]" in refused.stderr
    assert (tmp_path / "report.html").read_text() == "mine"
    assert ask("report", server_job[1], stdin="y\n", kind=Terminal).code == 0
    assert (tmp_path / "report.html").read_text() != "mine"


def test_control_of_a_job_answers_in_json(ask: Ask) -> None:
    job = ask.read_json("submit", "-", stdin="model: fopdt\ndatasets: [steps]\nseed: 99\n")
    assert ask.read_json("cancel", job["id"])["state"] == "cancelled"
    assert ask.read_json("resume", job["id"])["state"] == "queued"
    assert ask.read_json("cancel", job["id"])["state"] == "cancelled"


def test_an_export_in_json_is_the_document(ask: Ask, server_job: tuple[str, str]) -> None:
    (run,) = ask.read_json("runs", server_job[1])
    document = ask.read_json("export", run["id"])
    assert document == json.loads(ask("export", run["id"]).stdout)
    line = check_refusal(ask("export", run["id"], "--format", "c", "--json"), 2)
    assert line == "lagid: --json prints the JSON document; leave out --format c"


def test_lists_are_bounded_and_tell_how_many_more_there_are(ask: Ask) -> None:
    body = "model: fopdt\ndatasets: [steps]\nsweep: {axes: [{path: /seed, range: [0, 60]}]}\n"
    job = ask.read_json("submit", "-", stdin=body)
    printed = ask("runs", job["id"]).stdout.splitlines()
    assert len(printed) == 1 + 50 + 1
    assert printed[-1] == "… and 10 more; --limit 0 lists all"
    assert len(ask("runs", job["id"], "--limit", 0).stdout.splitlines()) == 1 + 60
    assert len(ask.read_json("runs", job["id"])) == 60
    few = ask("runs", job["id"], "-n", 2, "--json")
    assert [run["number"] for run in json.loads(few.stdout)] == [0, 1]
    assert few.stderr == "… and 58 more; --limit 0 lists all\n"
    jobs, datasets = ask.read_json("jobs"), ask.read_json("datasets")
    assert f"… and {len(jobs) - 1} more" in ask("jobs", "--limit", 1).stdout
    assert f"… and {len(datasets) - 1} more" in ask("datasets", "--limit", 1).stdout
    assert "more; --limit 0" in ask("models", "list", "--limit", 3).stdout
    assert "more; --limit 0" in run_lagid("models", "list", "--limit", 3, LAGID_URL="").stdout


def test_the_database_answers_in_json(tmp_path: Path) -> None:
    def read_answer(*words: str) -> Any:
        done = run_lagid("db", *words, "--json", "--data-dir", tmp_path)
        assert done.code == 0, done.stderr
        return json.loads(done.stdout)

    revision = read_answer("upgrade")["revision"]
    assert revision
    nothing = {"database": [], "read": 0, "damaged": [], "lost": []}
    nothing |= {"without_row": 0, "deleted": 0, "freed_bytes": 0}
    assert read_answer("check") == nothing
    assert read_answer("downgrade", "base", "--yes") == {"revision": "base"}


def test_a_follower_that_is_quiet_prints_the_result_only(
    ask: Ask, server_job: tuple[str, str]
) -> None:
    loud, quiet = ask("watch", server_job[1]), ask("watch", server_job[1], "--quiet")
    assert "succeeded" in loud.stderr
    assert quiet.stderr == ""
    (run,) = ask.read_json("runs", server_job[1])
    assert run["id"] in quiet.stdout
    assert "note: " not in quiet.stdout
    assert ("note: " in loud.stdout) == bool(run["warnings"])


def test_the_console_script_runs_the_command_line() -> None:
    program = "import sys; sys.argv = ['lagid', '-V']; import lagid; lagid.main()"
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == f"lagid {lagid.__version__}\n"
