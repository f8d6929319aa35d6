"""Parts of a report as plain values: tables, figures and text."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class ReportTable:
    """Rows of text under headings; the first column names the rows."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Plot:
    """A figure, and a caption that compares it with the paper's."""

    title: str
    figure: Mapping[str, Any]
    caption: str


@dataclass(frozen=True, slots=True)
class Check:
    """A statement that the study checks, and whether it holds."""

    text: str
    holds: bool


@dataclass(frozen=True, slots=True)
class Section:
    """One part of the study."""

    title: str
    text: str = ""
    tables: Sequence[ReportTable] = ()
    plots: Sequence[Plot] = ()
    checks: Sequence[Check] = ()
    links: Sequence[str] = field(default=())


def to_markdown(section: Section) -> str:
    """Write the tables and checks of a section for the terminal; figures are in the report."""
    blocks = [f"## {section.title}"]
    if section.text:
        blocks.append(section.text)
    for table in section.tables:
        blocks += [f"**{table.title}**", _table_markdown(table)]
        if table.note:
            blocks.append(table.note)
    if section.checks:
        blocks.append(
            "\n".join(f"- {describe_check(check)}: {check.text}" for check in section.checks)
        )
    return "\n\n".join(blocks) + "\n"


def describe_check(check: Check) -> str:
    """Describe the outcome of a check."""
    return "holds" if check.holds else "does NOT hold"


def _table_markdown(table: ReportTable) -> str:
    cells = [list(table.headings), *[list(row) for row in table.rows]]
    cells = [[cell.replace("|", "\\|") for cell in row] for row in cells]
    widths = [max(3, *(len(row[n]) for row in cells)) for n in range(len(table.headings))]
    marks = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    lines = [cells[0], marks, *cells[1:]]
    return "\n".join(f"| {' | '.join(_align_cells(line, widths))} |" for line in lines)


def _align_cells(line: Sequence[str], widths: Sequence[int]) -> list[str]:
    first, *rest = zip(line, widths, strict=True)
    return [first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in rest)]
