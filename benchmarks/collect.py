"""Collect the results of benchmark programs in one table: figures with bars first.

``python -m benchmarks.collect FOLDER PROGRAM…`` reads ``PROGRAM.json`` and ``PROGRAM.md``, which
the programs write with ``--json``. It writes ``bench.json`` and ``bench.md``. It exits 1 if a
program has written nothing.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

TARGET = "bench"


def read_figures(folder: Path, program: str) -> list[dict[str, Any]]:
    """The figures with bars of one program, named by it; none if it wrote nothing."""
    path = folder / f"{program}.json"
    if not path.exists():
        return []
    rows = json.loads(path.read_text())
    return [{**row, "name": f"{program}: {row['name']}"} for row in rows]


def format_line(figure: dict[str, Any]) -> str:
    """One figure as a line of the table."""
    bar, verdict = f"{figure['relation']} {figure['bar']:g}", "yes" if figure["holds"] else "**no**"
    return f"| {figure['name']} | {figure['value']:.5g} | {figure['unit']} | {bar} | {verdict} |"


def main() -> int:
    """Write both files; the exit code."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("folder", type=Path)
    arguments.add_argument("programs", nargs="+")
    options = arguments.parse_args()
    folder: Path = options.folder
    rows = [row for program in options.programs for row in read_figures(folder, program)]
    (folder / f"{TARGET}.json").write_text(json.dumps(rows, indent=1) + "\n")
    lines = [
        "# Benchmarks",
        "",
        "| figure | measured | unit | to reach | holds |",
        "|---|--:|---|--:|---|",
        *map(format_line, rows),
    ]
    silent = [program for program in options.programs if not (folder / f"{program}.md").exists()]
    lines += [f"| {program} | did not finish | | | **no** |" for program in silent]
    parts = [
        (folder / f"{program}.md").read_text()
        for program in options.programs
        if program not in silent
    ]
    (folder / f"{TARGET}.md").write_text("\n".join([*lines, "", *parts]))
    held = sum(row["holds"] for row in rows)
    print(f"{held} of {len(rows)} bars hold; see {folder / TARGET}.md and .json")
    return 1 if silent else 0


if __name__ == "__main__":
    sys.exit(main())
