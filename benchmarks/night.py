"""Run what is too long for the gate, one part after the other: `make night`.

Each part is a program of its own, and its output goes to a log. The seeds are new every night and
printed, so that a failure can be repeated. The table at the end shows what held.
"""

import argparse
import json
import os
import re
import secrets
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tests.support.checkout import ROOT

FOLDER = ROOT / "benchmarks" / "results" / "night"


@dataclass(frozen=True, slots=True)
class Part:
    """A program of the night: arguments of Python, and environment in addition to today's."""

    arguments: list[str]
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class PartResult:
    """How a part ended; `summary`: one line of its log or of its figures."""

    name: str
    holds: bool
    minutes: float
    summary: str


def list_parts(seed: int) -> dict[str, Part]:
    """List the parts of a night whose random seed this is."""

    def program(name: str, *options: str) -> Part:
        target = FOLDER / f"{name.rpartition('.')[2]}.json"
        return Part(["-m", name, "--json", str(target), *options])

    pytest = ["-m", "pytest", "-q", "-n", "2", "--dist", "loadscope"]
    settings = {"LAGID_TEST_PROFILE": "night", "LAGID_NIGHT_SEED": str(seed)}
    return {
        "tests": Part([*pytest], {**settings, "LAGID_REQUIRE_DATA": "1"}),
        # The contract once more, with PostgreSQL and S3 also where the gate takes the light pair.
        "server-storage": Part(
            [*pytest, "tests/contract", "tests/integration/storage"],
            {**settings, "LAGID_TEST_STORAGE": "server"},
        ),
        "mutants": Part(["-m", "tests.mutants", "-j", "2", "--json", str(FOLDER / "mutants.json")]),
        "robustness": program("benchmarks.robustness", "--first-seed", str(1000 * seed)),
        "efficiency": program("benchmarks.efficiency"),
        "traps": program("benchmarks.traps"),
        "judgement": program("benchmarks.judgement", "--workers", "2", "--first", str(100 * seed)),
        "coverage": program("benchmarks.coverage", "--jobs", "2"),
        "noise models": program("benchmarks.noise_models", "--jobs", "2"),
        "torture": program("benchmarks.torture", "--seed", str(seed)),
        "soak": program("benchmarks.soak", "--minutes", "240"),  # of each database
        "fuzz": program("benchmarks.fuzz", "--seed", str(seed)),
        "attacks": program("benchmarks.attacks"),
        "libraries": program("benchmarks.dependencies"),
        "versions of Ray": program("benchmarks.ray_versions"),
        "measured data": program("benchmarks.real_data.all"),
    }


def run_part(name: str, part: Part) -> PartResult:
    """Run a part to its end; what it prints goes to a log of its name."""
    log = FOLDER / f"{name.replace(' ', '_')}.log"
    start = time.monotonic()
    with log.open("w", encoding="utf-8") as output:
        code = subprocess.run(
            [sys.executable, *part.arguments],
            cwd=ROOT,
            env={**os.environ, **part.environment},
            stdout=output,
            stderr=subprocess.STDOUT,
            check=False,
        ).returncode
    minutes = (time.monotonic() - start) / 60
    summary, misses = summarize(part, log)
    return PartResult(name, code == 0 and not misses, minutes, summary)


def summarize(part: Part, log: Path) -> tuple[str, int]:
    """Summarize a part in a line: its figures, or the end of its log; and count its misses."""
    target = Path(part.arguments[part.arguments.index("--json") + 1]) if _has_json(part) else None
    if target is None or not target.exists():
        lines = log.read_text(encoding="utf-8").split("\n")
        ended = [line for line in lines if re.search(r"\d+ (passed|failed)|Error", line)]
        return (ended or [line for line in lines if line] or ["no output"])[-1].strip("= "), 0
    rows = json.loads(target.read_text(encoding="utf-8"))
    if rows and "verdict" in rows[0]:
        counts = Counter(row["verdict"] for row in rows)
        return ", ".join(f"{n} {verdict}" for verdict, n in counts.most_common()), 0
    missed = [row["name"] for row in rows if not row["holds"]]
    text = f"{len(rows) - len(missed)} of {len(rows)} bars hold"
    if missed:
        text += f". Missed: {'; '.join(missed)}"
    return text + _summarize_skipped(target.with_suffix(".md")), len(missed)


def _summarize_skipped(table: Path) -> str:
    """Say what a program could not measure here, and why."""
    lines = table.read_text(encoding="utf-8").splitlines() if table.exists() else []
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if "|" in line]
    left = [f"{row[0]} ({row[-1]})" for row in cells if len(row) == 5 and row[1] == "skipped"]
    return f". Skipped: {'; '.join(left)}" if left else ""


def _has_json(part: Part) -> bool:
    return "--json" in part.arguments


def format_table(results: list[PartResult], seed: int) -> str:
    """Format the results as a table."""
    lines = [
        f"## Night, seed {seed}",
        "",
        "| part | holds | minutes | summary |",
        "|---|---|--:|---|",
    ]
    for result in results:
        holds = "yes" if result.holds else "**no**"
        lines.append(f"| {result.name} | {holds} | {result.minutes:.1f} | {result.summary} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the parts and print the table; exit with 1 if a part does not hold."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1 + secrets.randbelow(100_000))
    parser.add_argument("--only", action="append", help="only this part (repeatable)")
    options = parser.parse_args()
    parts = list_parts(options.seed)
    unknown = set(options.only or ()) - set(parts)
    if unknown:
        parser.error(f"there is no part {', '.join(unknown)}. Parts: {', '.join(parts)}")
    FOLDER.mkdir(parents=True, exist_ok=True)
    for old in FOLDER.glob("*.json"):
        old.unlink()
    results = []
    for name in options.only or parts:
        results.append(run_part(name, parts[name]))
        print(f"{name}: {results[-1].minutes:.1f} min, {results[-1].summary}", flush=True)
    table = format_table(results, options.seed)
    (FOLDER / "night.md").write_text(table, encoding="utf-8")
    print(f"\n{table}")
    sys.exit(not all(result.holds for result in results))


if __name__ == "__main__":
    main()
