"""What pages tell of findings: explanations as a table, each sentence once, and what was tested."""

import re
from dataclasses import replace
from typing import Any

import pytest

from service.pages.render import template_environment
from service.pages.result_filters import describe_soundness, tabulate_explanations
from service.pages.trend_views import FlagCount
from sysid.core.findings import Finding, Move, note
from sysid.residuals.residual_tests import ResidualTests
from sysid.results.identification import Identification
from sysid.results.parts import OrderFit, compare_fits
from sysid.results.verdict import Verdict
from tests.support.storage.run_results import conclude

CHANGE = Finding(
    "change of a parameter",
    "constancy",
    "caution",
    "L changes at about 98 s",
    "L changes at about 98 s.",
    "Identify both parts, or set hold: {u: zero}.",
    467.25,
    (Move("L", 2.21, 0.01, -8.0), Move("K", 2.01, 0.05, 0.2)),
    ("L",),
)
ORDER = Finding(
    "order",
    "structure",
    "caution",
    "the data prefer sopdt",
    "the data prefer sopdt.",
    gain=30.0,
    moves=(Move("T", 4.0, None, -9.0),),
    parameters=("T",),
)


def find(*findings: Finding, **fields: Any) -> Identification:
    found = conclude(K=(2.0, 0.05), T=(6.1, 0.2), L=(2.75, 0.07)).identification
    verdict = Verdict("limited", "trustworthy but for L: L changes") if findings else found.verdict
    return replace(found, findings=findings, verdict=verdict, **fields)


def test_each_explanation_tells_what_a_moved_parameter_would_be() -> None:
    table = tabulate_explanations(find(CHANGE, ORDER))
    assert table is not None
    assert table.headings == ["T [s]", "L [s]"]  # no explanation moves K
    texts = [[row.brief, row.gain, *(cell.text for cell in row.cells)] for row in table.rows]
    assert texts == [
        ["the model holds", "", "6.10 ± 0.20", "2.750 ± 0.070"],
        ["L changes at about 98 s", "467.2", "–", "2.210 ± 0.010"],
        ["the data prefer sopdt", "30.0", "4.00000", "–"],
    ]
    assert [[cell.is_notable for cell in row.cells] for row in table.rows] == [
        [False, False],
        [False, True],
        [True, False],
    ]


def test_a_value_out_of_bounds_is_not_told() -> None:
    found = find(CHANGE)
    lag = next(one for one in found.parameters if one.name == "L")
    table = tabulate_explanations(
        find(replace(CHANGE, moves=(Move("L", lag.lower - 1.0, 0.1, -40.0),)))
    )
    assert table is not None
    assert [cell.text for cell in table.rows[1].cells] == ["–"]


@pytest.mark.parametrize(
    "findings", [(), (note("ridge", "identifiability", "T and L are alike"),)], ids=["none", "note"]
)
def test_without_a_move_there_is_no_table(findings: tuple[Finding, ...]) -> None:
    assert tabulate_explanations(find(*findings)) is None


def render(found: Identification) -> str:
    parts: Any = template_environment().get_template("parts.html").module
    view = {
        "result": found,
        "fit_estimation": 90.0,
        "fit_validation": None,
        "best_rms": 0.5,
        "unit": "m",
    }
    shown = (
        parts.verdict_card(view),
        parts.explanations(found),
        parts.estimates_table(found.parameters),
        parts.notes(found),
    )
    return re.sub(r"\s+", " ", " ".join(map(str, shown)))


def test_each_sentence_stands_once_on_a_page() -> None:
    remark = note("ridge", "identifiability", "T and L are alike.")
    estimates = [
        replace(one, status="dependent", reason="it is 2.21 s if L changes")
        if one.name == "L"
        else replace(one, reason="its interval is cut" if one.name == "K" else "")
        for one in find().parameters
    ]
    text = render(find(CHANGE, remark, parameters=tuple(estimates)))
    for sentence in ("Identify both parts", "T and L are alike.", "K: its interval is cut"):
        assert text.count(sentence) == 1
    assert "it is 2.21 s if" not in text  # the finding tells it
    assert "“u between samples: held (zero)”" in text
    assert '<span class="status dependent">dependent</span>' in text


@pytest.mark.parametrize(
    ("passed", "explained", "told"),
    [
        (True, True, "the residuals pass their tests"),
        (None, False, "residuals were not tested"),
        (False, True, "no explanation of that moves an estimate"),
        (False, False, "fail a test, but weakly"),
    ],
)
def test_a_sound_result_says_what_was_tested(
    passed: bool | None, explained: bool, told: str
) -> None:
    tests = ResidualTests("estimation", passed, ())
    found = find(residual_tests=tests, explained=explained)
    assert told in describe_soundness(found)
    assert describe_soundness(found) in render(found)
    assert describe_soundness(found).endswith("the data determine every parameter.")
    poor = [replace(one, status="at bound") for one in found.parameters]
    assert "every parameter" not in describe_soundness(replace(found, parameters=tuple(poor)))


def test_orders_reassure_nobody_beside_another_doubt() -> None:
    first = OrderFit("fopdt", 1, 1.55, 0.01, {"L": 1.55}, 0.027, -1264.0)
    second = OrderFit("sopdt", 2, 1.33, 0.01, {"L": 1.33}, 0.019, -1200.0)
    orders = compare_fits("fopdt", "L", "s", "white", (first, second), 300)
    parts: Any = template_environment().get_template("parts.html").module
    for findings, is_shown in (((), True), ((ORDER,), True), ((CHANGE,), False)):
        text = str(parts.evidence(find(*findings, order_comparison=orders)))
        assert ('<table class="orders ' in text) is is_shown
        assert ("strong evidence against" in text) is is_shown
        assert ('data-label="BIC − lowest BIC">64.0</td>' in text) is is_shown
        assert "1.55" not in text  # the estimates have it


def test_a_batch_without_flags_says_how_many_notes_it_has() -> None:
    parts: Any = template_environment().get_template("parts.html").module
    job = {
        "is_open": False,
        "outcome": None,
        "error": None,
        "progress": {"runs": 3, "finished": 3, "failed": 0},
    }
    for told, text in (
        (FlagCount(0, 5), "no flags</span>, 5 notes"),
        (FlagCount(0, 1), "no flags</span>, 1 note"),
        (FlagCount(0, 0), "no flags</span> <small>"),
        (FlagCount(1, 5), "1 flag</span> <small>"),
    ):
        assert text in str(parts.job_result(job, told))
