"""Lines of a job that is watched from a log, and the end of a job of many runs."""

from typing import Any

import pytest

from service.cli.printed_tables import MAX_WARNING_KINDS, print_reuse_note, print_run_summary
from service.cli.watch import LOG_INTERVAL_SECONDS, ProgressLog, RunsProgress


def job(state: str, finished: int = 0, **progress: Any) -> dict[str, Any]:
    known = {
        "runs": 40,
        "finished": finished,
        "generation": 0,
        "best_rms": None,
        "failed": 0,
        "reused": 0,
        "seconds_left": None,
        **progress,
    }
    return {"id": "job_1", "name": "many", "state": state, "progress": known}


def run(number: int, state: str = "succeeded", rms: float | None = 0.25) -> dict[str, Any]:
    return {
        "number": number,
        "state": state,
        "rms": rms,
        "labels": {"length_m": 5},
        "cell": {"/noise/sigma": 0.1, "/datasets": ["ds_1"]},
    }


class Log:
    """Lines of a job at times that the test sets; `asked` counts looks at the last run."""

    def __init__(self, unit: str | None = None, newest: dict[str, Any] | None = None) -> None:
        self.told: list[str] = []
        self.now = 0.0
        self.asked = 0
        self._run = newest
        self._lines = ProgressLog(
            self.told.append, RunsProgress(self._newest, unit, lambda: self.now)
        )

    def _newest(self) -> dict[str, Any] | None:
        self.asked += 1
        return self._run

    def show(self, now: float, seen: dict[str, Any]) -> None:
        self.now = now
        self._lines.log_progress(seen)


def test_a_line_is_told_at_a_change_of_state_and_every_ten_seconds_at_most():
    log = Log("m")
    log.show(0, job("queued"))
    log.show(0, job("queued"))
    log.show(0, job("running"))
    for tick in range(1, 300):  # 30 s, a look every 0.1 s, something new at each
        log.show(tick / 10, job("running", tick // 10, best_rms=1 / tick))
    log.show(30, job("succeeded", 40, best_rms=0.25))
    assert [text.split(",")[0].split()[1] for text in log.told] == [
        "queued",
        "running",
        "running",
        "running",
        "succeeded",
    ]
    assert log.told[-1] == "job_1 succeeded, 40/40 runs"


def test_a_line_about_many_runs_has_counts_pace_what_is_left_and_the_last_run():
    log = Log("m", run(11))
    log.show(0, job("queued"))
    log.show(100, job("running"))
    log.show(110, job("running", 12, failed=2, reused=3, seconds_left=23.4, best_rms=1e-9))
    assert log.told[-1] == (
        "job_1 running, 12/40 runs, 2 failed, 3 reused, 1.2 runs/s, 23.4 s left, "
        "last run 12 (5, 0.1): RMS 0.25 m"
    )
    log.show(115, job("succeeded", 40, failed=2, best_rms=1e-9))
    assert log.told[-1] == "job_1 succeeded, 40/40 runs, 2 failed"


def test_a_last_run_that_failed_has_no_rms():
    log = Log("m", run(4, "failed", None))
    log.show(0, job("running", 5, failed=1))
    assert log.told == ["job_1 running, 5/40 runs, 1 failed, last run 5 (5, 0.1): failed"]


def test_the_last_run_is_not_asked_for_at_every_look():
    log = Log(None, run(0))
    many = RunsProgress(log._newest, None, lambda: log.now)
    for tick in range(100):  # 10 s, ten runs a second
        log.now = tick / 10
        many.describe_progress(job("running", tick))
    assert log.asked <= 11
    many.describe_progress(job("running", 99))
    assert log.asked <= 11


def test_a_job_that_began_anew_has_no_pace_below_zero():
    log = Log()
    log.show(0, job("running", 30))
    log.show(10, job("running", 12))
    assert log.told[-1] == "job_1 running, 12/40 runs"


def test_one_run_is_told_with_its_rms():
    log = Log("m")
    log.show(0, job("running", 0, runs=1, generation=12, best_rms=0.5))
    assert log.told == ["job_1 running, 0/1 runs, generation 12, RMS 0.5 m"]


def test_nothing_new_is_not_told_again():
    log = Log()
    for tick in range(10):
        log.show(tick * LOG_INTERVAL_SECONDS, job("queued"))
    assert log.told == ["job_1 queued, 0/40 runs"]


@pytest.mark.parametrize(
    ("runs", "reused", "said"),
    [
        (
            1,
            1,
            "note: this run was computed before; the result of run_0 is shown. To compute "
            "again: reuse: false in the job",
        ),
        (
            40,
            3,
            "note: 3 of 40 runs were computed before; their results are shown. To compute "
            "again: reuse: false in the job",
        ),
        (40, 0, ""),
    ],
)
def test_a_result_that_was_taken_over_is_said_to_be(capsys, runs: int, reused: int, said: str):
    ended = job("succeeded", runs, runs=runs, reused=reused)
    print_reuse_note(ended, [{"reused_from": "run_0"}], "reuse: false in the job")
    assert capsys.readouterr().out.strip() == said


class Summarised:
    """A client that knows a summary."""

    def __init__(self, groups: list[dict[str, Any]]) -> None:
        self._groups = groups

    def summary(self, _: str) -> dict[str, Any]:
        return {
            "groups": self._groups,
            "quantiles": [0.05, 0.25, 0.5, 0.75, 0.95],
            "by": ["/noise/sigma"],
            "rms_unit": "m",
        }


def group(sigma: float) -> dict[str, Any]:
    value = {"name": "T", "unit": "s", "value": [1.0, 2.0, 3.0, 4.0, 5.0]}
    return {
        "key": {"/noise/sigma": sigma},
        "runs": 400,
        "success_rate": 0.5,
        "rms": [0.1, 0.2, 0.3, 0.4, 0.5],
        "parameters": [value],
    }


def test_many_runs_end_in_a_summary_whose_length_does_not_grow_with_them(capsys):
    warnings = [f"parameter T is at {number}.5" for number in range(800)]
    kinds = [f"kind {chr(97 + number)}" for number in range(2 * MAX_WARNING_KINDS)]
    runs = [
        {"state": "succeeded" if number % 2 else "failed", "warnings": [text, *kinds]}
        for number, text in enumerate(warnings)
    ]
    print_run_summary(Summarised([group(0.1), group(0.2)]), {"id": "job_1"}, runs)  # type: ignore[arg-type]
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 20
    assert "800 runs" in lines[0]
    assert "400 failed" in lines[0]
    assert "RMS [m]" in lines[1]
    assert "T [s]" in lines[1]
    assert "3, 1 to 5" in lines[2]
    assert any("800 ×" in line for line in lines)
    assert lines[-1].startswith("… and ")
