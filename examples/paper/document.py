"""Parts of a report as plain values: tables, figures and text."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, log10

from plotly.graph_objects import Figure


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
    figure: Figure
    caption: str


@dataclass(frozen=True, slots=True)
class Check:
    """A statement that the study checks, and whether it holds."""

    text: str
    holds: bool


@dataclass(frozen=True, slots=True)
class Section:
    """One part of the study, and the jobs that it is from."""

    title: str
    text: str
    tables: Sequence[ReportTable] = ()
    plots: Sequence[Plot] = ()
    checks: Sequence[Check] = ()
    jobs: Sequence[str] = ()


def format_number(value: float, digits: int) -> str:
    """Format a number with so many significant digits."""
    return f"{value:.{_count_decimals(value, digits)}f}".replace("-", "−")


def format_estimate(value: float, stderr: float) -> str:
    """Format an estimate and its standard error to the error's second significant digit."""
    decimals = _count_decimals(stderr, 2)
    return f"{value:.{decimals}f} ± {stderr:.{decimals}f}"


def _count_decimals(value: float, digits: int) -> int:
    if value == 0:
        return 0
    rounded = float(f"{abs(value):.{digits - 1}e}")  # 0.0996 to two digits is 0.10, not 0.100
    return max(digits - 1 - floor(log10(rounded)), 0)


def to_markdown(section: Section) -> str:
    """Write text, tables and checks of a section for the terminal."""
    blocks = [f"## {section.title}", section.text]
    for table in section.tables:
        blocks += [f"**{table.title}**", _table_markdown(table), table.note]
    blocks.append("\n".join(f"- {describe_check(c)}: {c.text}" for c in section.checks))
    return "\n\n".join(filter(None, blocks)) + "\n"


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
