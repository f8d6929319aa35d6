"""Shared parts of the benchmark programs: figures with bars, a table, JSON, `--check`."""

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class Row:
    """One figure and the bar it is held against.

    `relation` says on which side of `bar` the value should lie; `bar` None: shown only.
    """

    name: str
    value: float
    unit: str
    bar: float | None = None
    relation: Literal["<=", ">="] = "<="

    @property
    def holds(self) -> bool:
        """Whether the value lies on the right side of the bar."""
        if self.bar is None:
            return True
        return self.value <= self.bar if self.relation == "<=" else self.value >= self.bar


@dataclass(frozen=True)
class Skipped:
    """Something that could not be measured here, and why."""

    name: str
    reason: str


def parser(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options of every benchmark: --quick, --json FILE, --check."""
    arguments = argparse.ArgumentParser(description=description)
    arguments.add_argument("--quick", action="store_true", help="fewer repetitions")
    arguments.add_argument(
        "--json", type=Path, metavar="FILE", help="write the figures as JSON, the table as FILE.md"
    )
    arguments.add_argument("--check", action="store_true", help="exit 1 if a bar is missed")
    return arguments


def markdown(title: str, rows: list[Row], skipped: list[Skipped]) -> str:
    """The figures as a table, those with a bar first."""
    lines = [
        f"## {title}",
        "",
        "| figure | measured | unit | to reach | holds |",
        "|---|--:|---|--:|---|",
    ]
    for row in sorted(rows, key=lambda row: row.bar is None):
        bar = "" if row.bar is None else f"{row.relation} {row.bar:g}"
        verdict = "" if row.bar is None else ("yes" if row.holds else "**no**")
        lines.append(f"| {row.name} | {row.value:.5g} | {row.unit} | {bar} | {verdict} |")
    lines += [f"| {skip.name} | skipped | | | {skip.reason} |" for skip in skipped]
    return "\n".join(lines) + "\n"


def report(
    title: str, rows: list[Row], skipped: list[Skipped], options: argparse.Namespace
) -> None:
    """Print a Markdown table, write it and the JSON, exit as `--check` says (1 miss, 2 skipped)."""
    text = markdown(title, rows, skipped)
    print(f"\n{text}", end="")
    if options.json:
        figures = [{**asdict(row), "holds": row.holds} for row in rows if row.bar is not None]
        options.json.write_text(json.dumps(figures, indent=1) + "\n")
        options.json.with_suffix(".md").write_text(text)
    if options.check and not all(row.holds for row in rows):
        sys.exit(1)
    if options.check and skipped:
        sys.exit(2)
