"""The page on noise: its example prints what it says."""

import re
from pathlib import Path

import pytest

PAGE = Path("docs/explanation/noise.md").read_text(encoding="utf-8")


def test_the_example_of_the_page_prints_its_output(capsys: pytest.CaptureFixture[str]) -> None:
    [code] = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    [printed] = re.findall(r"```text\n(.*?)```", PAGE, re.S)
    exec(code, {})
    assert capsys.readouterr().out == printed
