"""What the commands print of jobs and runs: one run in full, labels of a batch, units."""

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner, Result

from service.cli import common
from service.cli.common import FieldOrigins
from service.cli.main import build_program
from service.cli.printed_tables import print_trend
from service.client.calls import ProblemError
from service.client.client import Client
from sysid.core.text import plain_interval, split_estimate
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import Through, parts_of, recording, store_csv

MODEL: dict[str, Any] = {
    "name": "lagged",
    "form": "differential",
    "inputs": {"u": "V"},
    "states": {"x": "m"},
    "parameters": {
        "K": {"lower": 0, "upper": 5, "unit": "m/V"},
        "T": {"lower": 0.1, "upper": 5, "unit": "s"},
        "L": {"lower": 0, "upper": 2, "unit": "s"},
    },
    "equations": {"x": "(K*u(t - L) - x)/T"},
    "outputs": {"y": "x"},
    "initial": {"x": 0},
}


class ServedRuns(NamedTuple):
    client: Client
    data: str
    job: str
    runs: list[str]


@pytest.fixture(scope="module")
def batch(server: TestClient) -> ServedRuns:
    data = store_csv(server, recording())
    axis = {
        "path": "/datasets",
        "values": [[data], [data]],
        "labels": [{"length_m": 5}, {"length_m": 20}],
    }
    body = {
        "model": MODEL,
        "datasets": [data],
        "sweep": {"axes": [axis]},
        "algorithm": {"population": 20, "generations": 40, "islands": 1},
        "hold": {"u": "zero"},
        "validation": {"fraction": 0.2},
    }
    job, runs = identify_job(parts_of(server), body)
    return ServedRuns(Client("http://testserver", transport=Through(server)), data, job, runs)


@pytest.fixture(autouse=True)
def commands_in_process(batch: ServedRuns, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(common, "connect_client", lambda *_: Again(batch.client))


class Again:
    """A client that several commands use, each in a block of its own."""

    def __init__(self, client: Client) -> None:
        self._client = client

    def __enter__(self) -> Client:
        return self._client

    def __exit__(self, *_: object) -> None:
        """The client stays open."""


def lagid(*words: str) -> Result:
    return CliRunner().invoke(build_program(), list(words))


def test_one_run_is_shown_with_estimates_units_intervals_and_fit(batch: ServedRuns) -> None:
    told = lagid("runs", batch.runs[1])
    assert told.exit_code == 0, told.output
    run = batch.client.run(batch.runs[1])
    assert run["rms_unit"] == "m"
    assert f"run 2 of {batch.job}: succeeded" in told.output
    assert "length_m = 20" in told.output
    assert batch.data not in told.output
    for one in run["parameters"]:
        (line,) = (row for row in told.output.splitlines() if row.startswith(f"{one['name']} "))
        value, error = split_estimate(one["value"], one["stderr"])
        assert line.split()[1] == value
        assert f" {error} " in line
        assert f" {one['unit']} " in line
        assert f" {plain_interval(one['interval95'], one['stderr'])} " in line
        assert one["status"] in line
    assert f"RMS {run['rms']:.6g} m, fit {run['fit_percent']['estimation']:.2f} %" in told.output
    for warning in run["warnings"]:
        assert f"note: {warning}" in told.output
    as_json = lagid("runs", batch.runs[1], "--json")
    assert f'"id": "{batch.runs[1]}"' in as_json.output


def test_a_batch_is_listed_by_its_labels_with_units_in_the_headings(batch: ServedRuns) -> None:
    told = lagid("runs", batch.job)
    assert told.exit_code == 0, told.output
    heading, *rows = told.output.splitlines()
    assert heading.split()[:3] == ["run", "state", "length_m"]
    for text in ("RMS [m]", "K [m/V]", "T [s]", "L [s]"):
        assert text in heading
    assert [row.split()[2] for row in rows[:2]] == ["5", "20"]
    assert batch.data not in told.output


def test_runs_of_a_job_are_chosen_and_sorted_as_by_rest(batch: ServedRuns) -> None:
    def list_numbers(*options: str) -> list[int]:
        told = lagid("runs", batch.job, *options, "--json")
        assert told.exit_code == 0, told.output
        return [run["number"] for run in json.loads(told.stdout)]

    batch.client.edit_run(batch.runs[1], {"tags": ["suspect"]})
    assert list_numbers("--tag", "suspect") == [1]
    assert list_numbers("--label", "length_m=5") == [0]
    assert list_numbers("--state", "failed") == []
    assert list_numbers("--state", "succeeded", "--order", "number", "--descending") == [1, 0]
    assert list_numbers("--tag", "suspect", "--label", "length_m=5") == []
    told = lagid("runs", batch.job, "--state", "succeeded", "--limit", "1")
    assert told.output.splitlines()[-1] == "… and 1 more; --limit 0 lists all"
    wrong = lagid("runs", batch.job, "--order", "length")
    assert (wrong.exit_code, wrong.output[:15]) == (1, "lagid: --order:")
    assert lagid("runs", batch.runs[0], "--tag", "suspect").exit_code == 2


def test_the_list_of_jobs_has_the_counts_of_a_batch_and_no_rms_of_it(batch: ServedRuns) -> None:
    best = batch.client.job(batch.job)["progress"]["best_rms"]
    told = lagid("jobs").output
    assert "2/2: 2 succeeded, 0 failed" in told
    assert f"{best:.6g}" not in told


def test_the_list_of_jobs_has_the_rms_of_a_single_run_with_its_unit(
    batch: ServedRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = batch.client.job(batch.job)
    single = {**job, "progress": {**job["progress"], "runs": 1, "finished": 1}}
    waiting = {**single, "progress": {**single["progress"], "finished": 0, "best_rms": None}}
    monkeypatch.setattr(batch.client, "jobs", lambda *_, **__: [single, waiting])
    _, first, second = lagid("jobs").output.splitlines()
    assert f"{job['progress']['best_rms']:.6g}  m " in first
    assert "1/1 " in first
    assert re.search(r"0/1 +– +– ", second)


def test_a_unit_in_a_heading_is_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    point = {
        "x": 5.0,
        "value": 1.0,
        "stderr": 0.1,
        "status": "identified",
        "is_outlier": False,
        "drifts": [],
    }
    one = {
        "name": "T",
        "unit": "s",
        "kind": "parameter",
        "points": [point],
        "laws": [],
        "reason": "",
        "predictions": [],
        "notes": [],
    }
    place = {"x": 5.0, "runs": [], "evaluations": 1, "spans": [], "flags": [], "warnings": []}
    print_trend(
        {
            "x": "length_m",
            "reference": None,
            "reference_x": None,
            "reference_names": [],
            "labels": [place],
            "quantities": [one],
            "missing": 6,
            "failed": 1,
            "unended": 2,
            "notes": ["use loss: {noise_model: ar1}"],
        },
        FieldOrigins(),
    )
    told = capsys.readouterr().out
    assert "T [s]" in told
    assert "note: use --set loss.noise_model=ar1" in told
    assert "1 failed, 2 have not ended, 3 were cancelled or deleted" in told


def test_a_job_that_is_watched_from_a_pipe_tells_its_state(batch: ServedRuns) -> None:
    told = lagid("watch", batch.job)
    assert told.exit_code == 0, told.output
    assert f"{batch.job} succeeded, 2/2 runs\n" in told.stderr


def test_a_result_that_was_computed_before_is_said_to_be(
    batch: ServedRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = batch.runs[0]
    taken = {**batch.client.run(before), "reused_from": "run_before"}
    monkeypatch.setattr(batch.client, "run", lambda _: taken)
    assert (
        "note: this run was computed before; the result of run_before"
        in lagid("runs", before).stdout
    )


def test_a_dataset_is_derived_by_its_name(batch: ServedRuns, tmp_path: Path) -> None:
    steps = tmp_path / "steps.yaml"
    steps.write_text("- trim: {start: 1, stop: 20}\n")
    told = lagid("dataset", "derive", "steps", str(steps), "--json")
    assert told.exit_code == 0, told.output
    stored = json.loads(told.stdout)
    assert batch.client.lineage(stored["id"])["edges"][0]["parent"] == batch.data
    steps.write_text("- detrend: {channels: [y]}\n")
    assert "note: subtracted from y: " in lagid("dataset", "derive", "steps", str(steps)).output
    with pytest.raises(ProblemError, match=r"no dataset 'step'.*did you mean 'steps'"):
        batch.client.derive("step", [{"detrend": {}}])


def test_a_free_run_over_a_part_reads_what_was_recorded_before_it(
    batch: ServedRuns, tmp_path: Path
) -> None:
    """The input jumps at 7 s, the output at 7.5 s: a part from 7.3 s on begins between them."""
    steps = tmp_path / "steps.yaml"
    steps.write_text("- trim: {start: 7.25}\n")
    told = lagid("dataset", "derive", "steps", str(steps))
    assert "known for 7.3 s before, channels u, y" in told.stdout
    part = told.stdout.split()[0]
    alone = batch.client.derive("steps", [{"trim": {"start": 7.25, "history": False}}])["id"]
    with_past, without = (
        batch.client.validate_run(batch.runs[0], one)["rms"] for one in (part, alone)
    )
    assert with_past < 0.02
    assert without > 2 * with_past
    assert batch.client.run(batch.runs[0])["known_before"] == {
        "estimation": [0.0],
        "validation": [pytest.approx(24.0)],
    }


def test_jobs_are_listed_by_state(batch: ServedRuns) -> None:
    assert batch.job in lagid("jobs", "--state", "succeeded").stdout
    assert batch.job in lagid("jobs", "--state", "running", "--state", "succeeded").stdout
    none = lagid("jobs", "--state", "running")
    assert none.exit_code == 0
    assert batch.job not in none.stdout
    assert "no jobs are running" in none.stdout
    wrong = lagid("jobs", "--state", "runing")
    assert wrong.exit_code == 2
    assert "running" in wrong.stderr


def test_bytes_that_are_stored_under_another_name_are_warned_of(batch: ServedRuns) -> None:
    again = batch.client.add_dataset(recording(), "other")
    assert again["id"] == batch.data
    assert again["name"] == "steps"
    (warning,) = again["warnings"]
    assert "already stored as 'steps'" in warning
    assert batch.client.add_dataset(recording(), "steps")["warnings"] == []
    assert batch.client.dataset(batch.data)["warnings"] == []
