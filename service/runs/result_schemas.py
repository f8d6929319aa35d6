"""Parts of a result document, as `service.runs.result` writes them.

A stored document is sent as it is. These types describe it, and tests hold it against them.
"""

from typing import Literal

from pydantic import Field

from service.core.wire import Answer, Finite
from sysid.results.verdict import Severity, Trust


class EstimateOut(Answer):
    """Estimate of one parameter."""

    name: str = Field(description="name of the parameter")
    unit: str = Field(description="unit of its values")
    value: Finite = Field(description="estimate, in `unit`")
    lower: Finite = Field(description="lower bound of the search, in `unit`")
    upper: Finite = Field(description="upper bound of the search, in `unit`")
    stderr: Finite = Field(description="standard error, in `unit`; null: see `reason`")
    interval95: list[Finite] | None = Field(description="both ends of the 95 % interval, in `unit`")
    status: str = Field(description="identified, or why the value is not to be relied on")
    reason: str = Field(description="why there is no standard error; empty with one")


class FitOut(Answer):
    """Fit, 100 (1 - ‖y - ŷ‖ / ‖y - ȳ‖) %."""

    estimation: Finite = Field(description="fit to the estimation data, %")
    validation: Finite = Field(description="fit to the validation data, %; null without them")


class OutputAgreementOut(Answer):
    """Agreement of one output of one record."""

    experiment: int = Field(description="record, from 0")
    output: str = Field(description="output of the model")
    unit: str = Field(description="unit of the RMS")
    samples: int = Field(description="scored samples")
    rms: Finite = Field(description="RMS error, in `unit`")
    fit_percent: Finite = Field(description="fit, %; null if the output does not vary")
    span: list[Finite] = Field(
        default=[], description="least and largest measured value, in `unit`"
    )


class AgreementsOut(Answer):
    """Agreement with both kinds of data."""

    estimation: list[OutputAgreementOut] = Field(description="with the estimation data")
    validation: list[OutputAgreementOut] = Field(description="with the validation data")


class IslandOut(Answer):
    """Champion of one island before and after its refinement."""

    champion_rms: Finite = Field(description="RMS error of the search, in the unit of `rms`")
    refined_rms: Finite = Field(
        description="RMS error after least squares, in the unit of `rms`; null without"
    )
    evaluations: int = Field(description="simulations of the island")
    parameters: list[Finite] = Field(description="values of the free parameters, in their units")


class CombinationOut(Answer):
    """Combination of parameters that the data determine, while they do not each of them."""

    members: list[str] = Field(description="names of the parameters")
    expression: str = Field(description="the combination")
    value: Finite = Field(
        description="estimate of the combination; its unit follows from its parameters"
    )
    stderr: Finite = Field(description="standard error of the combination, in the same unit")
    is_local: bool = Field(default=False, description="whether it holds near the estimate only")


class IdentifiabilityOut(Answer):
    """What the data can tell apart, by the sensitivities at the estimate."""

    condition: Finite = Field(description="condition of the scaled sensitivities")
    groups: list[CombinationOut] = Field(description="combinations that are determined")
    singular_values: list[Finite] = Field(
        default=[], description="singular values of the scaled sensitivities"
    )


class CriteriaOut(Answer):
    """Information criteria; smaller is better, on the same samples."""

    aic: Finite = Field(description="Akaike's criterion; null where the residuals vanish")
    aicc: Finite = Field(default=None, description="the same, corrected for few samples")
    bic: Finite = Field(description="Schwarz's criterion; null where the residuals vanish")
    samples: int = Field(description="scored samples")
    parameters: int = Field(description="free parameters")


class MatrixOut(Answer):
    """Matrix of a correlation or covariance; rows and columns are `names`."""

    names: list[str] = Field(description="parameters of the rows and columns")
    matrix: list[list[Finite]] = Field(description="rows of the matrix")


class ResidualTestOut(Answer):
    """One test of the residuals; numbers are null if it was not made."""

    experiment: int = Field(description="record, from 0")
    output: str = Field(description="output whose residuals are tested")
    test: Literal["whiteness", "independence"] = Field(
        description="whiteness: with their own past; independence: with an input"
    )
    input: str | None = Field(description="input of the test; null for whiteness")
    outcome: Literal["passed", "failed", "not tested"] = Field(description="outcome of the test")
    reason: str = Field(description="why it was not tested, or what failed")
    samples: int = Field(description="residuals of the test")
    lags_tested: int = Field(description="lags of the statistic")
    inside95: Finite = Field(description="share of the values within the 95 % band")
    inside99: Finite = Field(description="share of the values within the 99 % band")
    statistic: Finite = Field(description="test statistic, χ² distributed if the model is true")
    degrees: Finite = Field(description="degrees of freedom of the statistic")
    p: Finite = Field(description="probability of such a statistic if the model is true")


class ResidualVerdictOut(Answer):
    """Outcome of the residual tests; all fields are missing if none were made."""

    data: str | None = Field(default=None, description="data of the residuals")
    level: float | None = Field(
        default=None, description="probability that a true model fails at least one test"
    )
    passed: bool | None = Field(default=None, description="whether all tests passed")
    tests: list[ResidualTestOut] = Field(default=[], description="each test")


class OnsetDelayOut(Answer):
    """Delay between the start of an input's change and that of an output's."""

    experiment: int = Field(description="record, from 0")
    input: str = Field(description="input of the model")
    output: str = Field(description="output of the model")
    delay: Finite = Field(description="median over the events, s; null: see `reason`")
    unit: str = Field(description="unit of delay and spread: s")
    spread: Finite = Field(description="standard deviation over the events, s")
    events: int = Field(description="clear events")
    threshold: Finite = Field(description="share of the change at which an output moves")
    reason: str = Field(description="why there is no delay; empty with one")


class InputHoldOut(Answer):
    """How an input is read between its samples."""

    input: str = Field(description="input of the model")
    chosen: str = Field(description="how it was read")
    reason: str | None = Field(description="reason of a choice by the values; null if given")
    other: str | None = Field(description="the other reading; null if it has no effect")
    estimates_other: dict[str, Finite] | None = Field(
        description="estimates with the other reading, in their units"
    )
    rms_other: Finite = Field(description="RMS error with the other reading, in the unit of `rms`")


class KnownBeforeOut(Answer):
    """Time before the start of each record for which its inputs are recorded."""

    estimation: list[float] = Field(description="of each estimation record, s")
    validation: list[float] = Field(description="of each validation record, s")


class MinimumOut(Answer):
    """A minimum of the loss."""

    parameters: dict[str, Finite] = Field(
        description="values of the free parameters, in their units"
    )
    rms: Finite = Field(description="RMS error, in the unit of `rms`")
    likelihood_ratio: Finite = Field(description="n ln(Σe²/Σe²₀) to the best minimum")
    count: int = Field(description="least-squares fits that ended in it")
    independent: int = Field(description="how many of them began at random points")
    is_compatible: bool = Field(description="whether the data do not rule it out")
    recorded_from: Finite = Field(
        default=None, description="compared from this time of each record on, s; null: all of it"
    )


class SearchOut(Answer):
    """Evidence of the search."""

    settled: bool = Field(description="whether the search settled")
    because: str | None = Field(description="what shows it: starts or residuals")
    independent_starts: int = Field(description="local searches from random points")
    agreeing_starts: int = Field(description="how many of them ended in the best minimum")
    minima: list[MinimumOut] = Field(description="minima, the lowest first")


class PosteriorParameterOut(Answer):
    """Posterior distribution of one parameter."""

    name: str = Field(description="name of the parameter")
    unit: str = Field(description="unit of its values")
    median: float = Field(description="median, in `unit`")
    interval95: list[float] = Field(description="2.5 and 97.5 % quantiles, in `unit`")
    effective_samples: Finite = Field(description="number of independent samples")


class PosteriorOut(Answer):
    """Samples of the posterior, or the reason why there are none."""

    converged: bool = Field(description="whether the chain has converged")
    reason: str = Field(description="why it has not; empty if it has")
    walkers: int = Field(description="walkers of the chain")
    steps: int = Field(description="steps of each walker")
    acceptance: Finite = Field(description="share of the proposed moves that were accepted")
    evaluations: int = Field(description="simulations of the chain")
    parameters: list[PosteriorParameterOut] = Field(description="free parameters")
    correlation: MatrixOut = Field(description="correlation of the samples")
    samples: list[list[float]] | None = Field(
        default=None, description="at most 1,000 samples, in the parameters' units; not in lists"
    )


class OrderFitOut(Answer):
    """A process of one order, fitted to the same samples."""

    model: str = Field(description="its name in the catalogue")
    order: int = Field(description="number of poles")
    delay: Finite = Field(description="dead time, in the comparison's `unit`")
    delay_stderr: Finite = Field(
        description="standard error of the dead time, in the same unit; null without"
    )
    values: dict[str, Finite] = Field(description="all parameters of that model, in their units")
    rms: Finite = Field(description="RMS error, in the unit of `rms`")
    bic: Finite = Field(description="Schwarz's criterion; smaller is better")
    is_open: bool = Field(
        description="whether its BIC is within 6 of the lowest: no strong evidence against it"
    )


class OrderComparisonOut(Answer):
    """A process with dead time, with one order less and one more."""

    model: str = Field(description="the catalogue's name of the model's own order")
    preferred_model: str | None = Field(
        description="the one order that is open; null if there are several"
    )
    delay: str = Field(description="the parameter that is the dead time")
    unit: str = Field(description="unit of the dead times")
    delay_range: list[float] = Field(
        description="smallest and largest dead time of the open orders, in `unit`"
    )
    noise_model: str = Field(description="noise model of the criteria: white or ar1")
    fits: list[OrderFitOut] = Field(description="the orders, the lowest first")


class ReasonOut(Answer):
    """One finding about a result."""

    severity: Severity = Field(
        description="serious: do not rely on the estimates; caution: they hold under a condition; "
        "note: worth knowing"
    )
    brief: str = Field(
        description="a few words, as they follow “trustworthy, but” or “not trustworthy:”"
    )
    text: str = Field(description="what was found, and what helps")


class VerdictOut(Answer):
    """Whether the estimates can be relied on."""

    trust: Trust = Field(
        description="limited: the estimates hold under the condition that the text names"
    )
    text: str = Field(description="the verdict in words")
    reasons: list[ReasonOut] = Field(description="what speaks against it, the most severe first")


class SelectedTermOut(Answer):
    """A term in the order of its selection."""

    term: str = Field(description="the term")
    err: float = Field(description="share of the output's sum of squares that it explains")
    cumulated: float = Field(description="share explained with all terms so far")
    coefficient: float = Field(
        description="coefficient before the search; its unit follows from the term"
    )
