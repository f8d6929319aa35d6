"""Answers about the trend of a batch."""

from typing import Literal

from pydantic import Field

from service.core.bodies.wire import Answer, Finite
from sysid.trends.trend import OutlierRule


class SpanOut(Answer):
    """Range of the measured values of an output."""

    output: str = Field(description="output of the model")
    channel: str = Field(description="recorded channel")
    unit: str = Field(description="unit of the range")
    lower: float = Field(description="least measured value, in `unit`")
    upper: float = Field(description="largest measured value, in `unit`")


class DriftOut(Answer):
    """Difference between an estimate and a reference."""

    kind: Literal["run", "trend"] = Field(
        description="against the reference run, or against the prediction of its job's trend"
    )
    expected: float = Field(description="value of the reference, in the quantity's unit")
    difference: float = Field(description="estimate minus reference, in the quantity's unit")
    z: float = Field(description="in standard errors of the difference")
    limit: float = Field(
        description="magnitude of z beyond which the estimate is flagged as drifted"
    )
    drifted: bool = Field(description="whether |z| exceeds the limit")


class PointOut(Answer):
    """Estimate of one quantity at one label.

    `stderr` includes the scatter between runs of one label, if that exceeds their own errors.
    """

    x: float = Field(description="value of the label")
    value: float | None = Field(description="estimate, in the quantity's unit; null without one")
    stderr: Finite = Field(description="standard error, in the quantity's unit")
    runs: list[str] = Field(description="identifiers of the runs at this label")
    status: str = Field(description="status of the estimate")
    is_used: bool = Field(
        description="whether the laws are fitted to it; an outlier leaves them by default"
    )
    studentised: Finite = Field(default=None, description="deleted residual")
    p_value: float | None = Field(
        default=None, description="Bonferroni-corrected p-value of the outlier test"
    )
    is_outlier: bool = Field(default=False, description="whether the outlier test flags it")
    drifts: list[DriftOut] = Field(default=[], description="differences from references")


class CoefficientOut(Answer):
    """One coefficient of a law."""

    name: str = Field(description="name of the coefficient in the formula")
    value: float = Field(description="value, in the units of the law")
    stderr: float = Field(description="standard error of the value")


class LawOut(Answer):
    """Fitted law."""

    law: Literal["line", "power"] = Field(description="kind of the law")
    formula: str = Field(description="formula with its values")
    is_chosen: bool = Field(description="whether it has the smaller AICc")
    coefficients: list[CoefficientOut] = Field(description="coefficients of the formula")
    chi_squared: float = Field(description="weighted sum of squares χ²")
    degrees: int = Field(description="degrees of freedom ν")
    birge: float = Field(description="Birge ratio √(χ²/ν). If above 1, errors are multiplied by it")
    aic: float = Field(description="Akaike's information criterion")
    aicc: Finite = Field(description="null with too few points")


class LawPointOut(Answer):
    """Value of a law at one x with its 95 % interval."""

    x: float = Field(description="value of the label")
    value: Finite = Field(description="value of the law, in the quantity's unit")
    stderr: Finite = Field(description="standard error, in the quantity's unit")
    lower: Finite = Field(description="lower end of the 95 % interval, in the quantity's unit")
    upper: Finite = Field(description="upper end of the 95 % interval, in the quantity's unit")
    is_outside: bool = Field(description="whether x is outside the measured range")


class QuantityOut(Answer):
    """Trend of a parameter or an onset delay over x."""

    name: str = Field(description="name of the parameter or delay")
    unit: str = Field(description="unit of the estimates")
    kind: Literal["parameter", "onset delay"] = Field(description="kind of the quantity")
    points: list[PointOut] = Field(description="estimate at each label")
    between_runs: float | None = Field(
        description="scatter of runs of one label, in stated errors. Null without such runs"
    )
    laws: list[LawOut] = Field(description="fitted laws")
    reason: str = Field(default="", description="why there is no law")
    band: list[LawPointOut] = Field(default=[], description="confidence band of the chosen law")
    predictions: list[LawPointOut] = Field(
        default=[], description="with intervals for a new estimate"
    )
    notes: list[str] = Field(default=[], description="what limits the trend")


class BatchLabelOut(Answer):
    """All runs of one label."""

    x: float = Field(description="value of the label")
    runs: list[str] = Field(description="identifiers of the runs")
    evaluations: int = Field(description="simulations of these runs")
    spans: list[SpanOut] = Field(description="measured range of each output")
    flags: list[str] = Field(description="what speaks against these runs, in a few words each")
    warnings: list[str] = Field(description="warnings of these runs")


class TrendOut(Answer):
    """Trend of a job's batch over one of its labels."""

    job: str = Field(description="identifier of the job")
    x: str = Field(description="name of the label")
    outliers: OutlierRule = Field(description="whether the laws leave outliers out")
    reference: str | None = Field(default=None, description="run that the batch is compared with")
    reference_x: float | None = Field(
        default=None, description="label of the reference; null if it has none"
    )
    reference_names: list[str] = Field(default=[], description="names under which it was accepted")
    labels: list[BatchLabelOut] = Field(description="runs of each label, in the order of x")
    quantities: list[QuantityOut] = Field(description="trend of each quantity")
    missing: int = Field(default=0, description="runs without a result")
    failed: int = Field(default=0, description="how many of these failed")
    unended: int = Field(default=0, description="how many of these have not ended")
    notes: list[str] = Field(default=[], description="what limits the trends")
