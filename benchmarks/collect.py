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


def figures(folder: Path, program: str) -> list[dict[str, Any]]:
    """The figures with bars of one program, named by it; none if it wrote nothing."""
    path = folder / f"{program}.json"
    if not path.exists():
        return []
    found = json.loads(path.read_text())
    return [{**one, "name": f"{program}: {one['name']}"} for one in found]


def line(one: dict[str, Any]) -> str:
    """One figure as a line of the table."""
    bar, verdict = f"{one['relation']} {one['bar']:g}", "yes" if one["holds"] else "**no**"
    return f"| {one['name']} | {one['value']:.5g} | {one['unit']} | {bar} | {verdict} |"


def main() -> int:
    """Write both files; the exit code."""
    made = argparse.ArgumentParser(description=__doc__)
    made.add_argument("folder", type=Path)
    made.add_argument("programs", nargs="+")
    options = made.parse_args()
    folder: Path = options.folder
    found = [one for program in options.programs for one in figures(folder, program)]
    (folder / f"{TARGET}.json").write_text(json.dumps(found, indent=1) + "\n")
    lines = [
        "# Benchmarks",
        "",
        "| figure | measured | unit | to reach | holds |",
        "|---|--:|---|--:|---|",
        *map(line, found),
    ]
    silent = [one for one in options.programs if not (folder / f"{one}.md").exists()]
    lines += [f"| {one} | did not finish | | | **no** |" for one in silent]
    parts = [(folder / f"{one}.md").read_text() for one in options.programs if one not in silent]
    (folder / f"{TARGET}.md").write_text("\n".join([*lines, "", *parts]))
    held = sum(one["holds"] for one in found)
    print(f"{held} of {len(found)} bars hold; see {folder / TARGET}.md and .json")
    return 1 if silent else 0


if __name__ == "__main__":
    sys.exit(main())
