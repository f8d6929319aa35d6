"""docs/polynomials.md: its model is identified by its lines of Python."""

import re

import numpy as np

from sysid.data.records import Channel, Record
from sysid.models.document_reader import parse_yaml
from tests.documents.tutorials import run_cell
from tests.support.checkout import ROOT

PAGE = (ROOT / "docs/polynomials.md").read_text(encoding="utf-8")


def test_the_lines_of_the_page_select_the_terms_of_its_model() -> None:
    [document] = re.findall(r"```yaml\n(.*?)```", PAGE, re.S)
    [lines] = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    u = np.random.default_rng(3).uniform(-1, 1, 400)
    y = np.zeros(400)
    for k in range(4, 400):
        y[k] = 0.6 * y[k - 1] + 0.8 * u[k - 1] - 0.3 * y[k - 1] * u[k - 4]
    record = Record((Channel("u", t := 0.1 * np.arange(400), u),), (Channel("y", t, y),))
    printed, _ = run_cell(lines, {"document": parse_yaml(document), "record": record})
    terms = [line.rpartition(" ")[0] for line in printed.splitlines()]
    assert {"y(k-1)", "u(k-1)", "y(k-1)*u(k-1-dk)"} <= set(terms)
