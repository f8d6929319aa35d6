"""Lines of a job that is watched from a log, and the end of a job of many runs."""

from typing import Any

from service.cli.many_runs import MOST_KINDS, print_many
from service.cli.watching import EVERY_S, Lines


def job(state: str, finished: int = 0, **progress: Any) -> dict[str, Any]:
    known = {"runs": 40, "finished": finished, "generation": 0, "best_rms": None, **progress}
    return {"id": "job_1", "state": state, "progress": known}


def test_a_line_is_told_at_a_change_of_state_and_every_ten_seconds_at_most():
    told: list[str] = []
    now = [0.0]
    lines = Lines(told.append, "m", lambda: now[0])
    lines.show(job("queued"))
    lines.show(job("queued"))
    lines.show(job("running"))
    for tick in range(1, 300):  # 30 s, a look every 0.1 s, something new at each
        now[0] = tick / 10
        lines.show(job("running", tick // 10, best_rms=1 / tick))
    lines.show(job("succeeded", 40, best_rms=0.25))
    assert [text.split(",")[0].split()[1] for text in told] == [
        "queued", "running", "running", "running", "succeeded",
    ]  # fmt: skip
    assert told[-1] == "job_1 succeeded, 40/40 runs, best RMS 0.25 m"


def test_nothing_new_is_not_told_again():
    told: list[str] = []
    now = [0.0]
    lines = Lines(told.append, None, lambda: now[0])
    for tick in range(10):
        now[0] = tick * EVERY_S
        lines.show(job("queued"))
    assert told == ["job_1 queued, 0/40 runs"]


class Summarised:
    """A client that knows a summary."""

    def __init__(self, groups: list[dict[str, Any]]) -> None:
        self._groups = groups

    def summary(self, _: str) -> dict[str, Any]:
        return {"groups": self._groups, "quantiles": [0.05, 0.25, 0.5, 0.75, 0.95],
                "by": ["/noise/sigma"], "rms_unit": "m"}  # fmt: skip


def group(sigma: float) -> dict[str, Any]:
    value = {"name": "T", "unit": "s", "value": [1.0, 2.0, 3.0, 4.0, 5.0]}
    return {"key": {"/noise/sigma": sigma}, "runs": 400, "success_rate": 0.5,
            "rms": [0.1, 0.2, 0.3, 0.4, 0.5], "parameters": [value]}  # fmt: skip


def test_many_runs_end_in_a_summary_whose_length_does_not_grow_with_them(capsys):
    warnings = [f"parameter T is at {number}.5" for number in range(800)]
    kinds = [f"kind {chr(97 + number)}" for number in range(2 * MOST_KINDS)]
    runs = [
        {"state": "succeeded" if number % 2 else "failed", "warnings": [text, *kinds]}
        for number, text in enumerate(warnings)
    ]
    print_many(Summarised([group(0.1), group(0.2)]), {"id": "job_1"}, runs)  # type: ignore[arg-type]
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 20
    assert "800 runs" in lines[0]
    assert "400 failed" in lines[0]
    assert "RMS [m]" in lines[1]
    assert "T [s]" in lines[1]
    assert "3, 1 to 5" in lines[2]
    assert any("800 ×" in line for line in lines)
    assert lines[-1].startswith("… and ")
