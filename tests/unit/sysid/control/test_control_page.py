"""docs/control.md: its Python runs, its document is one, its fields and defaults are those."""

import re

import pytest
import yaml

from service.control.control_schemas import ControlIn, RunSimulationIn
from tests.support.checkout import ROOT

PAGE = (ROOT / "docs/control.md").read_text(encoding="utf-8")


def test_the_python_of_the_page_runs(capsys: pytest.CaptureFixture[str]) -> None:
    [snippet] = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(snippet, "docs/control.md", "exec"), {})
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("K 0.5, T_i 1 s, IAE 1.1")
    assert second == "phase margin 61.4 degrees"


def test_the_document_of_the_page_is_one() -> None:
    [document] = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    body = RunSimulationIn.model_validate(yaml.safe_load(document))
    assert body.control is not None
    assert body.control.integral_time == 1.0


def test_every_field_of_the_controller_is_on_the_page() -> None:
    told = set(re.findall(r"`(\w+)`", PAGE)) | {"input", "output", "reference"}
    assert set(ControlIn.model_fields) <= told
