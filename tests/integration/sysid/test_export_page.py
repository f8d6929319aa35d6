"""docs/export.md: its example runs, and prints the numbers of the page."""

import re
from typing import Any

import pytest

from tests.support.checkout import ROOT

PAGE = (ROOT / "docs/export.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_the_example_prints_the_transfer_function_of_the_page(
    capsys: pytest.CaptureFixture[str],
) -> None:
    example, shown, head = SNIPPETS
    names: dict[str, Any] = {}
    exec(example, names)
    printed = capsys.readouterr().out
    numbers = [re.findall(r"\d+\.\d+", text) for text in (shown, printed.partition("pairs")[2])]
    assert len(numbers[0]) == 5
    on_page, found = [list(map(float, texts[:5])) for texts in numbers]
    assert on_page == pytest.approx(found, rel=1e-6)
    values = {name: float(value) for name, value in re.findall(r"(\w+)=([\d.]+)", head)}
    assert values == pytest.approx(
        {name: names["found"][name].value for name in ("K", "T", "L")}, rel=1e-6
    )
