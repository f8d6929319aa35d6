"""docs/notebooks.md: every snippet runs, one after the other."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest

from sysid import Identification
from sysid.control.linear_form import IdentifiedModel
from tests.documents.tutorials import run_cell
from tests.support.checkout import ROOT

PAGE = (ROOT / "docs/notebooks.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
README = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S)
TRUTH = {"K": 0.8, "T": 40.0, "L": 12.0, "y0": 20.0, "x(0)": 0.0}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the file of the page, an oven behind its heater, made as the page says."""
    monkeypatch.chdir(tmp_path)
    [lines] = [snippet for snippet in SNIPPETS if "to_csv" in snippet]
    names: dict[str, Any] = {}
    run_cell(lines, names)
    assert names["truth"] == TRUTH
    return tmp_path


def test_four_lines_give_the_answer_and_its_plot(folder: Path) -> None:
    [lines] = [one for one in README if "read_recording" in one]
    assert lines.strip() in SNIPPETS[0]
    assert len([line for line in lines.splitlines() if line]) == 4
    names: dict[str, Any] = {}
    _, figure = run_cell(lines, names)
    assert isinstance(figure, go.Figure)
    for name in ("K", "T", "L"):
        estimate = names["found"][name]
        assert abs(estimate.value - TRUTH[name]) < 4 * estimate.stderr


def test_every_snippet_of_the_page_runs(folder: Path) -> None:
    names: dict[str, Any] = {}
    for snippet in SNIPPETS:
        run_cell(snippet, names)
    assert names["same"].inputs[0].unit == "%"
    assert names["table"].loc["y0", "status"] == "fixed"
    saved = Identification.load("found.json")
    assert saved.parameter_values == names["found"].parameter_values
    assert isinstance(names["model"], IdentifiedModel)
    answers = [names[name].channel("y").values for name in ("answer", "again")]
    assert np.allclose(*answers, rtol=0, atol=1e-6)


def test_the_text_of_a_result_on_the_page_is_the_one_that_is_printed(folder: Path) -> None:
    names: dict[str, Any] = {}
    run_cell(SNIPPETS[0], names)
    [shown] = re.findall(r"```\n(Identification of.*?)```", PAGE, re.DOTALL)
    printed = repr(names["found"])
    number = r"\d+(?:\.\d+)?(?:e[+-]\d+)?"
    words = [re.sub(number, "#", text).split() for text in (shown, printed)]
    assert words[0] == words[1]
    numbers = [[float(one) for one in re.findall(number, text)] for text in (shown, printed)]
    assert numbers[0] == pytest.approx(numbers[1], rel=0.02, abs=1e-3)
