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
from service.cli.tables import print_trend
from service.client.calls import ProblemError
from service.client.client import Client
from tests.identified import identified
from tests.integration.rest.test_client import Through
from tests.rest import parts_of, recording, store_csv

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


class Served(NamedTuple):
    client: Client
    data: str
    job: str
    runs: list[str]


@pytest.fixture(scope="module")
def served(server: TestClient) -> Served:
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
    job, runs = identified(parts_of(server), body)
    return Served(Client("http://testserver", transport=Through(server)), data, job, runs)


@pytest.fixture(autouse=True)
def connected(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(common, "connect_client", lambda *_: Again(served.client))


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


def test_one_run_is_shown_with_estimates_units_intervals_and_fit(served: Served) -> None:
    told = lagid("runs", served.runs[1])
    assert told.exit_code == 0, told.output
    run = served.client.run(served.runs[1])
    assert run["rms_unit"] == "m"
    assert f"run 2 of {served.job}: succeeded" in told.output
    assert "length_m = 20" in told.output
    assert served.data not in told.output
    for one in run["parameters"]:
        (line,) = (row for row in told.output.splitlines() if row.startswith(f"{one['name']} "))
        assert "±" in line
        assert f" {one['unit']} " in line
        assert f"{one['interval95'][0]:.6g} to {one['interval95'][1]:.6g}" in line
        assert one["status"] in line
    assert f"RMS {run['rms']:.6g} m, fit {run['fit_percent']['estimation']:.2f} %" in told.output
    for warning in run["warnings"]:
        assert f"note: {warning}" in told.output
    as_json = lagid("runs", served.runs[1], "--json")
    assert f'"id": "{served.runs[1]}"' in as_json.output


def test_a_batch_is_listed_by_its_labels_with_units_in_the_headings(served: Served) -> None:
    told = lagid("runs", served.job)
    assert told.exit_code == 0, told.output
    heading, *rows = told.output.splitlines()
    assert heading.split()[:3] == ["run", "state", "length_m"]
    for text in ("RMS [m]", "K [m/V]", "T [s]", "L [s]"):
        assert text in heading
    assert [row.split()[2] for row in rows[:2]] == ["5", "20"]
    assert served.data not in told.output


def test_runs_of_a_job_are_chosen_and_sorted_as_by_rest(served: Served) -> None:
    def list_numbers(*options: str) -> list[int]:
        told = lagid("runs", served.job, *options, "--json")
        assert told.exit_code == 0, told.output
        return [run["number"] for run in json.loads(told.stdout)]

    served.client.edit_run(served.runs[1], {"tags": ["suspect"]})
    assert list_numbers("--tag", "suspect") == [1]
    assert list_numbers("--label", "length_m=5") == [0]
    assert list_numbers("--state", "failed") == []
    assert list_numbers("--state", "succeeded", "--order", "number", "--descending") == [1, 0]
    assert list_numbers("--tag", "suspect", "--label", "length_m=5") == []
    told = lagid("runs", served.job, "--state", "succeeded", "--limit", "1")
    assert told.output.splitlines()[-1] == "… and 1 more; --limit 0 lists all"
    wrong = lagid("runs", served.job, "--order", "length")
    assert (wrong.exit_code, wrong.output[:15]) == (1, "lagid: --order:")
    assert lagid("runs", served.runs[0], "--tag", "suspect").exit_code == 2


def test_the_list_of_jobs_has_the_counts_of_a_batch_and_no_rms_of_it(served: Served) -> None:
    best = served.client.job(served.job)["progress"]["best_rms"]
    told = lagid("jobs").output
    assert "2/2: 2 succeeded, 0 failed" in told
    assert f"{best:.6g}" not in told


def test_the_list_of_jobs_has_the_rms_of_a_single_run_with_its_unit(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = served.client.job(served.job)
    single = {**job, "progress": {**job["progress"], "runs": 1, "finished": 1}}
    waiting = {**single, "progress": {**single["progress"], "finished": 0, "best_rms": None}}
    monkeypatch.setattr(served.client, "jobs", lambda *_, **__: [single, waiting])
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
    place = {"x": 5.0, "runs": [], "evaluations": 1, "spans": [], "warnings": []}
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


def test_a_job_that_is_watched_from_a_pipe_tells_its_state(served: Served) -> None:
    told = lagid("watch", served.job)
    assert told.exit_code == 0, told.output
    assert f"{served.job} succeeded, 2/2 runs\n" in told.stderr


def test_a_result_that_was_computed_before_is_said_to_be(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = served.runs[0]
    taken = {**served.client.run(before), "reused_from": "run_before"}
    monkeypatch.setattr(served.client, "run", lambda _: taken)
    assert (
        "note: this run was computed before; the result of run_before"
        in lagid("runs", before).stdout
    )


def test_a_dataset_is_derived_by_its_name(served: Served, tmp_path: Path) -> None:
    steps = tmp_path / "steps.yaml"
    steps.write_text("- trim: {start: 1, stop: 20}\n")
    told = lagid("dataset", "derive", "steps", str(steps), "--json")
    assert told.exit_code == 0, told.output
    stored = json.loads(told.stdout)
    assert served.client.lineage(stored["id"])["edges"][0]["parent"] == served.data
    steps.write_text("- detrend: {channels: [y]}\n")
    assert "note: subtracted from y: " in lagid("dataset", "derive", "steps", str(steps)).output
    with pytest.raises(ProblemError, match=r"no dataset 'step'.*did you mean 'steps'"):
        served.client.derive("step", [{"detrend": {}}])


def test_a_free_run_over_a_part_reads_what_was_recorded_before_it(
    served: Served, tmp_path: Path
) -> None:
    """The input jumps at 7 s, the output at 7.5 s: a part from 7.3 s on begins between them."""
    steps = tmp_path / "steps.yaml"
    steps.write_text("- trim: {start: 7.25}\n")
    told = lagid("dataset", "derive", "steps", str(steps))
    assert "known for 7.3 s before, channels u, y" in told.stdout
    part = told.stdout.split()[0]
    alone = served.client.derive("steps", [{"trim": {"start": 7.25, "history": False}}])["id"]
    with_past, without = (
        served.client.validate_run(served.runs[0], one)["rms"] for one in (part, alone)
    )
    assert with_past < 0.02
    assert without > 2 * with_past
    assert served.client.run(served.runs[0])["known_before"] == {
        "estimation": [0.0],
        "validation": [pytest.approx(24.0)],
    }


def test_jobs_are_listed_by_state(served: Served) -> None:
    assert served.job in lagid("jobs", "--state", "succeeded").stdout
    assert served.job in lagid("jobs", "--state", "running", "--state", "succeeded").stdout
    none = lagid("jobs", "--state", "running")
    assert none.exit_code == 0
    assert served.job not in none.stdout
    assert "no jobs are running" in none.stdout
    wrong = lagid("jobs", "--state", "runing")
    assert wrong.exit_code == 2
    assert "running" in wrong.stderr


def test_bytes_that_are_stored_under_another_name_are_warned_of(served: Served) -> None:
    again = served.client.add_dataset(recording(), "other")
    assert again["id"] == served.data
    assert again["name"] == "steps"
    (warning,) = again["warnings"]
    assert "already stored as 'steps'" in warning
    assert served.client.add_dataset(recording(), "steps")["warnings"] == []
    assert served.client.dataset(served.data)["warnings"] == []
