"""Run the tests of its part against each mutant, one at a time, and print the kill rates.

Each worker has a copy of the checkout. The tests of a part have to pass there before the first
mutant. A mutant is killed if a test fails or the tests take longer than the limit. Compiled code
of mutants goes to a folder that is removed at the end.
"""

import argparse
import contextlib
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from sysid.core.code_cache import find_cache_folder
from tests.mutants.lists import Mutant, MutantList, check_lists, read_lists
from tests.support.checkout import ROOT

LIMIT_SECONDS = 400.0
COMPILED = ".compiled"
"""Folder of compiled code in a copy."""
KILL_RATE = 0.9
"""Of all mutants that are not equivalent; strict packages need all."""

Verdict = Literal["killed", "timeout", "survived", "invalid"]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Verdict on a mutant; `detail`: the test that failed, or the end of pytest's output."""

    package: str
    mutant: Mutant
    verdict: Verdict
    seconds: float
    detail: str


def copy_checkout(target: Path) -> None:
    """Copy the files that git tracks, and new ones that it does not ignore."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)


def copy_compiled_code(target: Path) -> None:
    """Copy what this user has compiled. It is found by its sources, so mutants never find it."""
    with contextlib.suppress(OSError):
        shutil.copytree(find_cache_folder(), target)


def run_tests(root: Path, tests: tuple[str, ...], limit: float) -> tuple[int | None, str]:
    """Run tests of a copy until the first failure; the exit code is None after the limit."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(root),
        "PYTHONDONTWRITEBYTECODE": "1",  # a file that changes twice in a second keeps its time
        "LAGID_CACHE_DIR": str(root / COMPILED),
        "LAGID_DATA": os.environ.get("LAGID_DATA", str(ROOT.parent / "shared" / "data")),
    }
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=line", "-p", "no:cacheprovider"]
    child = subprocess.Popen(
        [*command, "-m", "not night", *tests],
        cwd=root,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = child.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        os.killpg(child.pid, signal.SIGKILL)
        child.communicate()
        return None, f"over {limit:.0f} s"
    return child.returncode, output


def judge(root: Path, package: str, mutant: Mutant, limit: float) -> Outcome:
    """Apply a mutant to a copy, run the tests of its part and take it back."""
    start = time.monotonic()
    before = mutant.apply(root)
    try:
        code, output = run_tests(root, mutant.tests, limit)
    finally:
        (root / mutant.file).write_text(before, encoding="utf-8")
    lines = [line for line in output.splitlines() if line.startswith(("FAILED", "ERROR"))]
    detail = (lines or output.splitlines()[-1:] or [""])[0]
    verdict: Verdict = "timeout" if code is None else "survived" if code == 0 else "killed"
    if code is not None and code > 2:  # pytest itself: no tests, wrong usage
        verdict = "invalid"
    return Outcome(package, mutant, verdict, time.monotonic() - start, detail[:300])


@contextmanager
def make_copies(count: int) -> Iterator[queue.SimpleQueue[Path]]:
    """Make copies of the checkout for the workers; they are removed at the end."""
    copies: queue.SimpleQueue[Path] = queue.SimpleQueue()
    with TemporaryDirectory(prefix="lagid-mutants-") as folder:
        for number in range(count):
            copy_checkout(Path(folder) / str(number))
            copy_compiled_code(Path(folder) / str(number) / COMPILED)
            copies.put(Path(folder) / str(number))
        yield copies


def run_mutants(lists: list[MutantList], workers: int, limit: float) -> list[Outcome]:
    """Judge all mutants and print each verdict as it comes."""
    with make_copies(workers) as copies, ThreadPoolExecutor(workers) as pool:

        def check(tests: tuple[str, ...]) -> None:
            with borrow(copies) as copy:
                code, output = run_tests(copy, tests, 5 * limit)
            if code != 0:
                raise SystemExit(f"these tests fail without a mutant: {tests}\n{output[-3000:]}")

        def judge_one(package: str, mutant: Mutant) -> Outcome:
            with borrow(copies) as copy:
                outcome = judge(copy, package, mutant, limit)
            seconds = f"{outcome.seconds:6.1f} s"
            print(f"{mutant.id:>5} {outcome.verdict:<9}{seconds}  {outcome.detail}", flush=True)
            return outcome

        chosen = [(part.package, mutant) for part in lists for mutant in part.mutants]
        list(pool.map(check, dict.fromkeys(mutant.tests for _, mutant in chosen)))
        return list(pool.map(judge_one, *zip(*chosen, strict=True)))


@contextmanager
def borrow(copies: queue.SimpleQueue[Path]) -> Iterator[Path]:
    """Take a free copy and give it back."""
    copy = copies.get()
    try:
        yield copy
    finally:
        copies.put(copy)


def format_table(lists: list[MutantList], outcomes: list[Outcome]) -> tuple[str, bool]:
    """Format the kill rates by package and the survivors; also whether the bars hold."""
    lines = [
        "| package | mutants | killed | timeout | survived | equivalent | kill rate |",
        "|---|--:|--:|--:|--:|--:|--:|",
    ]
    holds, sums = True, Counter[str]()
    for part in lists:
        mine = [outcome for outcome in outcomes if outcome.package == part.package]
        counts = Counter(o.verdict for o in mine)
        counts["equivalent"] = sum(
            o.verdict == "survived" and bool(o.mutant.equivalent) for o in mine
        )
        counts["survived"] -= counts["equivalent"]
        counts["mutants"] = len(mine)
        rate = _rate(counts)
        holds = holds and not (part.strict and rate < 1.0) and not counts["invalid"]
        sums.update(counts)
        name = f"{part.package} (all)" if part.strict else part.package
        lines.append(_format_row(name, counts))
    lines.append(_format_row("**sum**", sums))
    left = [o for o in outcomes if o.verdict in ("survived", "invalid")]
    lines += ["", *(f"* {_describe(outcome)}" for outcome in left)]
    return "\n".join(lines), holds and _rate(sums) >= KILL_RATE


def _rate(counts: Counter[str]) -> float:
    killed = counts["killed"] + counts["timeout"]
    return killed / max(1, killed + counts["survived"] + counts["invalid"])


def _format_row(name: str, counts: Counter[str]) -> str:
    cells = [counts[k] for k in ("mutants", "killed", "timeout", "survived", "equivalent")]
    return f"| {name} | " + " | ".join(map(str, cells)) + f" | {100 * _rate(counts):.0f} % |"


def _describe(outcome: Outcome) -> str:
    mutant = outcome.mutant
    reason = mutant.equivalent or mutant.survives or outcome.detail
    return f"{mutant.id} {outcome.verdict}: {mutant.file}: {mutant.why} — {reason}"


def main() -> None:
    """Judge the chosen mutants; exit with 1 if a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--package", action="append", help="only these lists (repeatable)")
    parser.add_argument("--id", action="append", help="only these mutants (repeatable)")
    parser.add_argument("-j", type=int, default=1, help="mutants at the same time (default 1)")
    parser.add_argument("--limit", type=float, default=LIMIT_SECONDS, help="seconds for a mutant")
    parser.add_argument("--json", type=Path, help="write the verdicts to this file too")
    options = parser.parse_args()
    lists = read_lists()
    faults = check_lists(lists)
    if faults:
        raise SystemExit("\n".join(faults))
    chosen = [
        MutantList(
            part.package,
            part.strict,
            tuple(m for m in part.mutants if not options.id or m.id in options.id),
        )
        for part in lists
        if not options.package or part.package in options.package
    ]
    chosen = [part for part in chosen if part.mutants]
    outcomes = run_mutants(chosen, options.j, options.limit)
    table, holds = format_table(chosen, outcomes)
    print(f"\n## Mutants\n\n{table}")
    if options.json:
        rows = [
            {"package": o.package, "id": o.mutant.id, "verdict": o.verdict, "seconds": o.seconds}
            for o in outcomes
        ]
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    sys.exit(not holds)


if __name__ == "__main__":
    main()
