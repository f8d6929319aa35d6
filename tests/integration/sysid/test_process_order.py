"""A process is compared with one order more and one less, and told if its dead time depends on it.

Records come from exact responses of first-order parts to held inputs.
"""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from sysid.core.findings import Finding
from sysid.core.settings import GeneticAlgorithm, Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.judgement.process_order import find_other_orders
from sysid.results.identification import Identification
from sysid.results.parts import OrderComparison, OrderFit, compare_fits
from sysid.results.summary import describe_order
from sysid.uncertainty.estimates import Estimate

PERIOD, COUNT, FINE = 0.2, 300, 50
QUICK = GeneticAlgorithm(generations=60)
OWN = {
    "name": "vessel",
    "form": "differential",
    "inputs": {"flow": "l/s"},
    "states": {"level": "m"},
    "parameters": {
        "g": {"lower": 0, "upper": 10, "unit": "m·s/l"},
        "a": {"lower": 0.05, "upper": 10, "unit": "1/s"},
        "lag": {"lower": 0, "upper": 5, "unit": "s"},
    },
    "equations": {"level": "a*(g*flow(t - lag) - level)"},
    "outputs": {"h": "level"},
    "initial": {"level": "measured"},
}


def respond(u: FloatArray, delay: float, parts: tuple[float, ...], integrates: bool) -> FloatArray:
    """Respond to a held input: dead time, first-order parts, and an integrator if there is one."""
    grid = np.arange((u.size - 1) * FINE + 1) * PERIOD / FINE
    x = 2.0 * u[np.clip(np.floor((grid - delay) / PERIOD + 1e-9).astype(int), 0, u.size - 1)]
    for part in parts:
        pole, y, out = np.exp(-PERIOD / FINE / part), 0.0, np.zeros(x.size)
        for k, value in enumerate(x.tolist()):
            out[k] = y
            y = pole * y + (1.0 - pole) * value
        x = out
    if integrates:
        x = np.cumsum(np.append(0.0, x[:-1])) * PERIOD / FINE
    return x[::FINE]


@cache
def make_record(
    *parts: float,
    noise: float = 0.02,
    names: tuple[str, str] = ("u", "y"),
    integrates: bool = False,
    offset: float = 0.0,
) -> Record:
    random = np.random.default_rng(4)
    u = np.repeat(random.uniform(-1.0, 1.0, COUNT), random.integers(6, 25, COUNT))[:COUNT]
    u[:10] = 0.0
    y = offset + respond(u, 1.33, parts, integrates) + noise * random.standard_normal(COUNT)
    times = np.arange(COUNT) * PERIOD
    return Record(Channel(names[0], times, u), Channel(names[1], times, y))


def compare(found: Identification) -> OrderComparison:
    assert found.order_comparison is not None
    return found.order_comparison


def find_order_warnings(found: Identification) -> list[str]:
    return [one.sentences for one in found.findings if one.explanation == "order"]


@pytest.fixture(scope="module")
def missing() -> Identification:
    """A first order, fitted to two parts."""
    return identify("fopdt", make_record(1.5, 0.3), QUICK)


def test_a_missing_time_constant_is_told_with_the_dead_time_of_the_other_order(
    missing: Identification,
) -> None:
    found = compare(missing)
    first, second = found.fits
    assert (found.model, found.preferred_model, found.noise_model) == ("fopdt", "sopdt", "white")
    assert (first.order, second.order) == (1, 2)
    assert missing["L"].value > 1.5
    assert abs(missing["L"].value - 1.33) > 10 * missing["L"].stderr  # type: ignore[operator]
    assert second.delay_stderr is not None
    assert abs(second.delay - 1.33) < 3 * second.delay_stderr
    assert found.delay_range == (second.delay, second.delay)
    assert missing["L"].status == "dependent"
    value = f"{second.delay:.4f} ± {second.delay_stderr:.4f} s"
    assert f"it is {value} if the data prefer sopdt" in missing["L"].reason
    assert missing.verdict.trust != "trustworthy"
    assert "the data prefer sopdt" in missing.verdict.text
    assert second.values["r"] * second.values["T1"] == pytest.approx(0.3, abs=0.05)
    [warning] = find_order_warnings(missing)
    assert warning.startswith("the data prefer sopdt (order 2) to fopdt (order 1): its BIC is ")
    assert f"L is {value} with sopdt instead of " in warning
    assert warning.endswith(" Use the model sopdt.")
    assert "the data prefer sopdt" in repr(missing)


def test_a_missing_time_constant_leaves_the_gain_identified(missing: Identification) -> None:
    assert missing["K"].value == pytest.approx(2.0, abs=3 * (missing["K"].stderr or 0.0))
    assert missing["K"].status == "identified"


def test_the_order_and_noise_of_the_plant_are_preferred_and_nothing_is_warned() -> None:
    for model, parts, others in (
        ("fopdt", (1.5,), ["sopdt"]),
        ("sopdt", (1.5, 0.6), ["fopdt", "topdt"]),
    ):
        found = identify(model, make_record(*parts, offset=20.0), QUICK)
        compared = compare(found)
        assert compared.model == compared.preferred_model == model
        assert [fit.model for fit in compared.fits if fit is not compared.own_fit] == others
        assert compared.own_fit.delay == pytest.approx(found["L"].value, abs=0.01)
        assert find_order_warnings(found) == []
        assert found["L"].status == "identified"


def test_the_own_order_is_fitted_to_the_same_samples_with_the_same_assumptions() -> None:
    second = identify("sopdt", make_record(1.5, 0.3), QUICK)
    [_, own, _] = compare(second).fits
    assert own.rms == pytest.approx(second.rms, rel=1e-6)
    assert own.delay == pytest.approx(second["L"].value, rel=1e-4)


def test_an_own_model_is_compared_under_its_own_names_and_keeps_what_it_fixes() -> None:
    found = identify(OWN, make_record(1.5, 0.3, names=("flow", "h")), QUICK)
    compared = compare(found)
    assert (compared.model, compared.preferred_model, compared.delay) == ("fopdt", "sopdt", "lag")
    assert all(fit.values["y0"] == 0.0 for fit in compared.fits)  # the model has no offset
    [warning] = find_order_warnings(found)
    assert "s with sopdt instead of 1.5" in warning
    assert "lag is 1.33" in warning
    assert warning.endswith("Give your model as many time constants, or use the model sopdt.")


def test_a_fixed_gain_stays_fixed() -> None:
    found = identify("fopdt", make_record(1.5, 0.3), QUICK, parameters={"K": 2.0})
    assert [fit.values["K"] for fit in compare(found).fits] == [2.0, 2.0]


def test_an_integrator_with_a_slow_drive_is_told_from_one_without() -> None:
    found = identify("ipdt", make_record(0.8, integrates=True), QUICK)
    compared = compare(found)
    assert (compared.model, compared.preferred_model) == ("ipdt", "foipdt")
    assert compared.fits[1].delay == pytest.approx(1.33, abs=0.05)


def test_coloured_noise_is_not_taken_for_a_missing_part() -> None:
    record = make_record(1.5, noise=0.0)
    noise = np.random.default_rng(7).standard_normal(COUNT) * 0.03
    for k, (before, _) in enumerate(pairwise(noise), 1):
        noise[k] += 0.8 * before
    [y] = record.outputs
    noisy = Record(record.inputs, Channel("y", y.times, y.values + noise))
    compared = compare(identify("fopdt", noisy, QUICK))
    assert (compared.noise_model, compared.preferred_model) == ("ar1", "fopdt")


def test_what_cannot_be_compared_is_not() -> None:
    record = make_record(1.5, 0.3)
    assert identify("fopdt", record, QUICK, compare_orders=False).order_comparison is None
    for changes in (
        {"loss": Loss("soft-l1")},
        {"prediction": "one-step"},
        {"parameters": {"L": 1.33}},
        {"settings": GeneticAlgorithm(method="simple", generations=20)},
    ):
        options = {"settings": QUICK, **changes}
        assert identify("fopdt", record, **options).order_comparison is None, changes  # type: ignore[arg-type]
    without_noise = identify("fopdt", make_record(1.5, noise=0.0), QUICK)
    assert without_noise.order_comparison is None  # what is left is of the integration


def test_orders_are_not_compared_where_the_dead_time_is_at_its_bound() -> None:
    """Of a first order the bound is exceeded by L, and of the preferred second order as well."""
    limited = identify(
        "fopdt", make_record(1.5), QUICK, parameters={"L": {"lower": 0, "upper": 0.5}}
    )
    assert limited["L"].status == "at bound"
    assert limited.order_comparison is None
    assert find_order_warnings(limited) == []
    (bound,) = (one for one in limited.findings if one.explanation == "bound")
    assert bound.severity == "serious"
    assert "not noise, which the bound may cause" in bound.text
    assert "L lies at its bound" in limited.verdict.text
    near = identify(  # L of the first order lies inside, that of the second at the bound
        "fopdt", make_record(1.5, 0.3), QUICK, parameters={"L": {"lower": 1.45, "upper": 5}}
    )
    assert near.order_comparison is None
    assert find_order_warnings(near) == []
    # What is missing is found without the fit of another order.
    assert near["L"].status == "dependent"
    assert near["L"].reason.endswith("if a time constant is missing")


def write_fits(*bics: float) -> OrderComparison:
    fits = tuple(
        OrderFit(model, order, delay, 0.01, {}, 0.02, bic)
        for (model, order, delay), bic in zip(
            [("fopdt", 1, 1.57), ("sopdt", 2, 1.4), ("topdt", 3, 1.3)], bics, strict=True
        )
    )
    return compare_fits("sopdt", "L", "s", "white", fits, 300)


LAG = Estimate("L", "s", 1.4, 0.0, 5.0, 0.01, (1.38, 1.42), "identified")


def list_findings(*bics: float, model: str = "sopdt") -> list[Finding]:
    return list(find_other_orders(write_fits(*bics), model, [LAG]))


def test_orders_within_six_of_the_lowest_criterion_are_open() -> None:
    open_orders = write_fits(16.1, 10.0, 16.0)
    assert [fit.model for fit in open_orders.open_fits] == ["sopdt", "topdt"]
    assert open_orders.preferred_model is None
    assert open_orders.delay_range == (1.3, 1.4)
    assert write_fits(16.1, 10.0, 16.1).preferred_model == "sopdt"
    assert write_fits(10.0, 16.1, 30.0).preferred_model == "fopdt"
    assert describe_order(write_fits(16.1, 10.0, 16.1)) == (
        "order: the data prefer sopdt to fopdt and topdt"
    )
    assert describe_order(write_fits(15.0, 10.0, 16.1)) == (
        "order: the data do not tell fopdt and sopdt apart; L is 1.570 ± 0.010 s with fopdt"
    )


def test_an_order_that_is_as_likely_and_moves_the_lag_makes_it_dependent() -> None:
    [found] = list_findings(16.1, 10.0, 10.0)
    assert (found.severity, found.parameters, found.status) == ("caution", ("L",), "dependent")
    assert found.brief == "the data do not tell sopdt and topdt apart"
    assert "L is 1.300 ± 0.010 s with topdt instead of 1.4 s." in found.text
    assert found.advice == ""
    [move] = found.moves
    assert (move.parameter, move.value, move.stderrs) == ("L", 1.3, pytest.approx(-10.0))


@pytest.mark.parametrize("other", [10.1, 16.0])
def test_an_open_order_moves_the_lag_though_it_is_less_likely_than_the_model(other: float) -> None:
    [found] = list_findings(16.1, 10.0, other)
    assert (found.severity, found.parameters, found.advice) == ("caution", ("L",), "")
    assert [move.value for move in found.moves] == [1.3]
    [found] = list_findings(other, 10.0, 16.1)
    assert found.severity == "caution"
    assert [move.value for move in found.moves] == [1.57]


def test_a_preferred_order_has_its_gain_and_its_lag() -> None:
    [found] = list_findings(10.0, 16.5, 30.0)
    assert found.gain == pytest.approx(6.5)
    assert found.brief == "the data prefer fopdt"
    assert found.moves[0].value == 1.57


@pytest.mark.parametrize("leaves_noise", [True, False])
def test_a_higher_order_is_advised_if_only_noise_is_left_by_it(leaves_noise: bool) -> None:
    third = replace(write_fits(30.0, 16.5, 10.0).fits[2], leaves_noise=leaves_noise)
    orders = write_fits(30.0, 16.5, 10.0)
    orders = replace(orders, fits=(*orders.fits[:2], third))
    [found] = find_other_orders(orders, "sopdt", [LAG])
    assert found.advice == ("Use the model topdt." if leaves_noise else "")
    [other] = find_other_orders(orders, "vessel", [LAG])
    words = "Give your model as many time constants, or use the model topdt."
    assert other.advice == (words if leaves_noise else "")
    [untold] = find_other_orders(orders, "sopdt", [replace(LAG, status="ambiguous")])
    assert untold.advice == ""


def test_the_model_s_own_order_is_no_finding() -> None:
    assert list_findings(16.1, 10.0, 16.1) == []
    assert list(find_other_orders(None, "sopdt", [LAG])) == []


def test_a_preferred_order_that_moves_nothing_is_a_note() -> None:
    fits = [
        OrderFit("fopdt", 1, 1.41, 0.01, {}, 0.02, 10.0),
        OrderFit("sopdt", 2, 1.4, 0.01, {}, 0.02, 30.0),
    ]
    [found] = find_other_orders(compare_fits("sopdt", "L", "s", "white", fits, 300), "sopdt", [LAG])
    assert (found.severity, found.parameters, found.moves) == ("note", (), ())


def test_an_order_that_explains_no_more_than_by_chance_is_not_open() -> None:
    """With 200 samples one parameter more costs 5.3, so the odds alone never rule it out."""
    first = OrderFit("fopdt", 1, 1.41, 0.01, {"T": 1.0}, 0.02, 10.0)
    for gain, is_open in ((0.0, False), (3.8, False), (3.9, True)):
        bic = 10.0 + np.log(200.0) - gain
        second = OrderFit("sopdt", 2, 1.3, 0.01, {"T": 1.0, "r": 0.1}, 0.02, bic)
        comparison = compare_fits("fopdt", "L", "s", "white", (first, second), 200)
        assert [fit.is_open for fit in comparison.fits] == [True, is_open]


def test_a_noisy_record_beside_a_quiet_one_does_not_blur_the_comparison() -> None:
    model, settings = "fopdt", QUICK
    quiet, noisy = make_record(1.5, 0.3), make_record(1.5, 0.3, noise=0.6)
    alone = compare(identify(model, quiet, settings))
    both = compare(identify(model, [quiet, noisy], settings))
    assert (alone.preferred_model, both.preferred_model) == ("sopdt", "sopdt")
    errors = [one.open_fits[0].delay_stderr for one in (alone, both)]
    assert errors[1] < 1.2 * errors[0]
