"""The table of all runs of a job: complete, and nothing in it is carried out by a spreadsheet."""

import csv
import io
from collections.abc import Sequence

from service.core.states import JobState
from service.queue.leases import LeaseQueue
from service.queue.run_writes import NewRun, RunOutcome, RunWriter, insert_runs
from service.repositories.job_rows import JobRepository
from service.repositories.run_rows import RunRepository
from service.storage.sessions import Database
from service.sweeps import table
from tests.support.storage.job_rows import claim, new_job, new_run

EVIL = '=HYPERLINK("http://x","y")'


def submit(database: Database, n_runs: int, path: str = "/seed") -> str:
    """A queued job with so many values of one axis."""
    values = [str(number) for number in range(n_runs)]
    axes = [{"path": path, "values": values, "labels": None}]
    spec = {"model": "silverbox", "sweep": {"axes": axes}}
    with database.write_session() as session:
        new = new_job(name="many", spec=spec, n_runs=n_runs)
        return JobRepository(session).submit(new).job.id


def end_job_with(
    database: Database, cells: list[NewRun], outcomes: dict[int, dict[str, float] | str]
) -> str:
    """A job whose runs of these numbers have estimates, or failed for a reason."""
    job = submit(database, n_runs=len(cells))
    got = claim(database)
    assert got is not None
    with database.write_session() as session:
        insert_runs(session, got.job, cells)
        runs = RunRepository(session).list_page(job, limit=10_000).items
        RunWriter(session, got.lease).record_outcomes(
            [_outcome(run.id, outcomes[run.number]) for run in runs if run.number in outcomes]
        )
        LeaseQueue(session).finish_job(got.lease, JobState.FAILED, "stopped")
    return job


def _outcome(run: str, told: dict[str, float] | str) -> RunOutcome:
    if isinstance(told, str):
        return RunOutcome(run_id=run, state=JobState.FAILED, error=told)
    parameters = [
        {"name": name, "unit": "1", "value": value, "stderr": None, "status": "fixed"}
        for name, value in told.items()
    ]
    return RunOutcome(
        run_id=run, state=JobState.SUCCEEDED, result={"parameters": parameters}, best_rms=1.0
    )


def list_rows(database: Database, job: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO("".join(table.stream_table(database, job)))))


def test_parameters_that_only_late_runs_have_are_in_the_table(database: Database) -> None:
    cells = [new_run(number=number) for number in range(1200)]
    job = end_job_with(database, cells, {0: {"K": 2.0}, 3: "no", 1199: {"K": 3.0, "late": 0.1}})
    found = list_rows(database, job)
    assert len(found) == 1200
    assert (found[1199]["K"], found[1199]["late"], found[0]["late"]) == ("3.0", "0.1", "")
    assert (found[3]["error"], found[3]["K"]) == ("no", "")


def test_a_table_of_runs_without_estimates_has_no_columns_of_parameters(database: Database) -> None:
    found = list_rows(database, end_job_with(database, [new_run(number=0)], {}))
    assert [one["state"] for one in found] == ["failed"]
    assert list(found[0])[-2:] == ["error", "/seed"]


def test_no_text_of_a_user_is_a_formula_in_a_spreadsheet(database: Database) -> None:
    cells = [new_run(number=0), new_run(number=1)]
    job = end_job_with(database, cells, {0: EVIL, 1: "-2"})
    assert [one["error"] for one in list_rows(database, job)] == [f"'{EVIL}", "-2"]
    for text in ("+1+cmd|' /C calc'!A0", "-2*K", "@SUM(1)", "\t=1", "\r=1", " =1", "\uff1d1"):
        [row] = list_rows(database, end_job_with(database, [new_run(number=0)], {0: text}))
        assert row["error"] == f"'{text}".replace("\r", " ")
    # Where `;` separates, what is behind it is a cell of its own, and so is another line.
    for text, escaped in ((";=1", ";'=1"), ('a; "=1', "a;' \"=1"), ("\n=1", "'\n'=1")):
        [row] = list_rows(database, end_job_with(database, [new_run(number=0)], {0: text}))
        assert row["error"] == escaped


def add_estimates(database: Database, job: str, told: Sequence[tuple[str, str, str]]) -> None:
    """One run after the other, each with one estimate: name, unit and status."""
    got = claim(database)
    assert got is not None
    with database.write_session() as session:
        insert_runs(session, got.job, [new_run(number=number) for number in range(len(told))])
        runs = RunRepository(session).list_page(job).items
        RunWriter(session, got.lease).record_outcomes(
            [
                RunOutcome(
                    run_id=run.id,
                    state=JobState.SUCCEEDED,
                    best_rms=1.0 + run.number,
                    result={
                        "parameters": [
                            {
                                "name": name,
                                "unit": unit,
                                "value": 0.5,
                                "stderr": 0.25,
                                "status": status,
                            }
                        ]
                    },
                )
                for run, (name, unit, status) in zip(runs, told, strict=True)
            ]
        )
        LeaseQueue(session).finish_job(got.lease, JobState.FAILED, "stopped")


def test_headings_have_units_and_estimates_their_status(database: Database) -> None:
    job = submit(database, n_runs=2)
    add_estimates(database, job, [("L", "s", "identified"), ("K", "1", "at bound")])
    first, second = list_rows(database, job)
    assert (first["L [s]"], first["stderr of L [s]"]) == ("0.5", "0.25")
    assert (first["status of L"], second["status of L"]) == ("identified", "")
    assert (second["K"], second["stderr of K"], second["status of K"]) == (
        "0.5",
        "",  # no error of an estimate at its bound
        "at bound",
    )
    assert (first["best_rms [V]"], first["fit_estimation [%]"]) == ("1.0", "")


def test_a_parameter_of_two_units_has_columns_for_each(database: Database) -> None:
    job = submit(database, n_runs=2, path="/model")
    add_estimates(database, job, [("T", "s", "identified"), ("T", "min", "fixed")])
    first, second = list_rows(database, job)
    assert (first["T [s]"], first["T [min]"]) == ("0.5", "")
    assert (second["T [s]"], second["T [min]"]) == ("", "0.5")
    assert [one["status of T"] for one in (first, second)] == ["identified", "fixed"]
