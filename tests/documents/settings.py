"""The table of all settings, from the settings: ``python -m tests.documents.settings``."""

from collections.abc import Sequence
from typing import Any

from service.core.settings import Settings
from tests.support.checkout import ROOT

PAGE = ROOT / "docs" / "settings.md"
BEGIN, END = "<!-- begin: make docs -->\n", "<!-- end -->\n"
UNITS = ((2**30, "GiB"), (2**20, "MiB"))


def write_page() -> str:
    """Write the page with the table of today."""
    rows = [
        f"| `LAGID_{name.upper()}` | {format_default(name, field.default)} "
        f"| {' '.join((field.description or '').split())} |\n"
        for name, field in Settings.model_fields.items()
    ]
    return replace_table(
        PAGE.read_text(), ["| variable | default | meaning |\n|---|---|---|\n", *rows]
    )


def replace_table(page: str, lines: Sequence[str]) -> str:
    """Replace the lines between the two marks of a page."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return "".join([before, BEGIN, *lines, END, after])


def format_default(name: str, value: Any) -> str:
    """Write a default as a user would set it; bytes with their unit."""
    if value in (None, (), ""):
        return "none"
    if isinstance(value, tuple):
        return f"`{','.join(value)}`"
    if name.endswith("_bytes"):
        size, unit = next((value // size, unit) for size, unit in UNITS if value % size == 0)
        return f"{value} ({size} {unit})"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"{value:g}" if isinstance(value, float) else f"`{value}`"


if __name__ == "__main__":
    PAGE.write_text(write_page())
