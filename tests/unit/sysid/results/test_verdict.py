"""The verdict of a result: what speaks against it, the most severe first."""

import math
from dataclasses import replace
from typing import Any

import pytest

from sysid.residuals.residual_tests import ResidualTest
from sysid.results.parts import OrderComparison, OrderFit, SearchEvidence, compare_fits
from sysid.results.verdict import Evidence, judge_result
from sysid.simulation.fit_metrics import ChannelMetrics
from sysid.uncertainty.estimates import Estimate, EstimateStatus


def make_estimate(
    name: str, status: EstimateStatus = "identified", *, value: float = 0.5
) -> Estimate:
    return Estimate(name, "s", value, 0.0, 5.0, 0.01, (0.48, 0.52), status)


def residual_test(kind: Any = "whiteness", *, p: float = 1e-9) -> ResidualTest:
    outcome = "failed" if p < 0.05 else "passed"
    return ResidualTest(0, "y", kind, "u" if kind == "independence" else None, outcome, 900, p=p)


def make_channel(rms: float, line_rms: float, experiment: int = 0) -> ChannelMetrics:
    return ChannelMetrics(experiment, "y", "V", 100, rms, 95.0, line_rms=line_rms)


def read_verdict(**evidence: Any) -> tuple[str, str]:
    usual: dict[str, Any] = {
        "estimates": [make_estimate("K"), make_estimate("T"), make_estimate("L")],
        "fit_percent": 95.0,
        "search": SearchEvidence(True, "starts", 8, 8),
        "tests": [residual_test(p=0.3)],
        "delays": ("L",),
    }
    verdict = judge_result(Evidence(**{**usual, **evidence}))
    return verdict.trust, verdict.text


def test_a_small_fit_beside_much_white_noise_is_trustworthy() -> None:
    assert read_verdict(fit_percent=15.0) == ("trustworthy", "trustworthy")


def test_a_straight_line_through_a_part_or_the_errors_of_the_solver_is_not_serious() -> None:
    quiet = [make_channel(0.1, 2.0), make_channel(0.11, 0.1, 1)]
    text = "trustworthy, but a straight line explains a part of y better"
    assert read_verdict(channels=quiet) == ("limited", text)
    exact = [replace(channel, fit_percent=99.9999) for channel in quiet]
    assert not any(channel.is_worse_than_line for channel in exact)  # so no note says it either
    assert read_verdict(channels=exact) == ("trustworthy", "trustworthy")
    few = [make_channel(0.1, math.nan), make_channel(0.1, 2.0, 1)]
    assert read_verdict(channels=few) == ("trustworthy", "trustworthy")


def test_a_result_that_nothing_speaks_against_is_trustworthy() -> None:
    assert read_verdict() == ("trustworthy", "trustworthy")


@pytest.mark.parametrize(
    ("evidence", "text"),
    [
        ({"valid": False}, "the model is invalid"),
        ({"search": SearchEvidence(False, None, 6, 1)}, "not settled"),
        ({"fit_percent": -3.0}, "the model does not explain the output"),
        ({"fit_percent": math.nan}, "the output is constant"),
        (
            {"fit_percent": 15.0, "tests": [residual_test()]},
            "the model explains little of the output",
        ),
        (
            {"estimates": [make_estimate("L", "not validated")]},
            "the validation data contradict the model",
        ),
        (
            {"estimates": [make_estimate("K", "group"), make_estimate("T", "group")]},
            "the data determine K and T only in combination",
        ),
        ({"channels": [make_channel(0.3, 0.2)]}, "a straight line explains y better"),
        ({"estimates": [make_estimate("K", "unidentifiable")]}, "the data do not determine K"),
        ({"estimates": [make_estimate("K", "prediction-dependent")]}, "K differs one step ahead"),
        (
            {
                "estimates": [make_estimate("K"), make_estimate("L", "at bound")],
                "tests": [residual_test()],
            },
            "L lies at its bound",
        ),
    ],
)
def test_what_is_serious_is_the_verdict(evidence: dict[str, Any], text: str) -> None:
    named = text if text == "not settled" else f"not trustworthy: {text}"
    assert read_verdict(**evidence) == ("not trustworthy", named)


@pytest.mark.parametrize(
    ("evidence", "text"),
    [
        ({"tests": [residual_test()]}, "L depends on the model's order"),
        (
            {"tests": [residual_test()], "delays": ()},
            "each estimate depends on the model's order",
        ),
        ({"tests": [residual_test("independence")]}, "the residuals depend on u"),
        ({"fit_percent_validation": 60.0}, "it fits the validation data worse"),
        (
            {"estimates": [make_estimate("K"), make_estimate("L", "at bound")]},
            "L lies at its bound",
        ),
        (
            {"estimates": [make_estimate("K"), make_estimate("L", "ambiguous")]},
            "another value of L fits as well",
        ),
        (
            {
                "estimates": [
                    make_estimate("K"),
                    make_estimate("a", "group"),
                    make_estimate("b", "group"),
                ]
            },
            "the data determine a and b only in combination",
        ),
        ({"estimates": [make_estimate("K"), make_estimate("L", value=0.015)]}, "L may be 0"),
        (
            {"estimates": [make_estimate("K", "hold-dependent"), make_estimate("T", "group")]},
            "the data determine T only in combination",
        ),
        (
            {"estimates": [make_estimate("K"), make_estimate("L", "hold-dependent")]},
            "L depends on how an input is read between its samples",
        ),
    ],
)
def test_a_condition_follows_trustworthy(evidence: dict[str, Any], text: str) -> None:
    assert read_verdict(**evidence) == ("limited", f"trustworthy, but {text}")


def test_a_note_alone_leaves_a_result_trustworthy() -> None:
    tests = [residual_test(p=0.02)]
    verdict = judge_result(Evidence(estimates=[make_estimate("K")], fit_percent=95.0, tests=tests))
    assert verdict.text == "trustworthy"
    assert [reason.severity for reason in verdict.reasons] == ["note"]


def test_what_only_the_solver_leaves_is_no_missing_dynamics() -> None:
    assert read_verdict(tests=[residual_test()], fit_percent=99.9999)[0] == "trustworthy"


def test_the_most_severe_reason_comes_first_and_all_are_told() -> None:
    verdict = judge_result(
        Evidence(
            estimates=[make_estimate("K"), make_estimate("L", "not settled")],
            search=SearchEvidence(False, None, 0, 0),
            tests=[residual_test()],
            delays=("L",),
        )
    )
    assert verdict.text == "not settled"
    assert [reason.severity for reason in verdict.reasons] == ["serious", "caution"]
    assert "no independent starts" in verdict.reasons[0].text


def test_fixed_parameters_do_not_count_as_determined() -> None:
    fixed = make_estimate("T", "fixed")
    assert (
        read_verdict(estimates=[fixed, make_estimate("K", "unidentifiable")])[0]
        == "not trustworthy"
    )


def make_orders(*bics: float) -> OrderComparison:
    """A comparison of a model of first order with those of second and third order."""
    names, delays = ("fopdt", "sopdt", "topdt"), (1.57, 1.33, 1.31)
    fits = (
        OrderFit(name, place, delay, 0.01, {"L": delay}, 0.02, bic)
        for place, (name, delay, bic) in enumerate(zip(names, delays, bics, strict=False), 1)
    )
    return compare_fits("fopdt", "L", "s", "white", tuple(fits), 300)


def test_an_order_that_the_data_prefer_limits_the_trust_and_names_its_lag() -> None:
    verdict = judge_result(
        Evidence(estimates=[make_estimate("L")], orders=make_orders(-1264.0, -1474.0))
    )
    assert verdict.text == "trustworthy, but L depends on the model's order"
    assert "prefer sopdt, with L = 1.33 s instead of 1.57 s" in verdict.reasons[0].text


def test_a_lag_at_its_bound_stands_alone_without_advice_on_orders() -> None:
    lag = make_estimate("L", "at bound", value=5.0)
    for compared in (None, make_orders(-1264.0, -1474.0), make_orders(-1473.0, -1474.0)):
        verdict = judge_result(
            Evidence(
                estimates=[make_estimate("K"), lag],
                tests=[residual_test()],
                delays=("L",),
                orders=compared,
            )
        )
        assert verdict.text == "not trustworthy: L lies at its bound"
        [reason] = verdict.reasons
        assert "The residuals are not white, which the bound may cause. Widen" in reason.text


def test_orders_that_the_data_do_not_tell_apart_give_a_range_of_the_lag() -> None:
    verdict = judge_result(
        Evidence(estimates=[make_estimate("L")], orders=make_orders(-1473.0, -1474.0))
    )
    assert verdict.text == "trustworthy, but L depends on the model's order"
    assert "do not tell fopdt and sopdt apart. With them L is from 1.33 to 1.57 s" in (
        verdict.reasons[0].text
    )


def test_the_order_that_the_data_prefer_is_not_blamed_for_coloured_residuals() -> None:
    own = make_orders(-1474.0, -1264.0)
    assert read_verdict(orders=own) == ("trustworthy", "trustworthy")
    assert read_verdict(orders=own, tests=[residual_test()]) == (
        "limited",
        "trustworthy, but the residuals are not noise",
    )


def test_names_and_reasons_are_those_of_free_parameters() -> None:
    evidence = Evidence(estimates=[make_estimate("K", "fixed"), make_estimate("T", "at bound")])
    assert evidence.list_names("fixed", "at bound") == ["T"]
    assert evidence.describe_reasons("fixed") == ""
    assert evidence.describe_reasons("at bound").startswith("T = ")
