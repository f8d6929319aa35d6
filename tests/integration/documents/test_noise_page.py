"""The page on noise: its examples print what it says."""

import re
from pathlib import Path

import pytest

PAGE = Path("docs/explanation/noise.md").read_text(encoding="utf-8")


def test_the_examples_of_the_page_print_their_outputs(capsys: pytest.CaptureFixture[str]) -> None:
    examples = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    names: dict[str, object] = {}
    for code in examples:
        exec(code, names)
    outputs = re.findall(r"```text\n(.*?)```", PAGE, re.S)
    assert len(outputs) == len(examples)
    assert capsys.readouterr().out == "".join(outputs)
