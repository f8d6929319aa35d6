"""Answers about the trend of a batch."""

from typing import Literal

from pydantic import Field

from service.core.wire import Answer, Finite


class SpanOut(Answer):
    """Range of the measured values of an output."""

    output: str
    channel: str
    unit: str
    lower: float
    upper: float


class DriftOut(Answer):
    """Difference between an estimate and a reference."""

    kind: Literal["run", "trend"] = Field(
        description="against the reference run, or against the prediction of its job's trend"
    )
    expected: float
    difference: float
    z: float = Field(description="in standard errors of the difference")
    limit: float = Field(
        description="magnitude of z beyond which the estimate is flagged as drifted"
    )
    drifted: bool


class PointOut(Answer):
    """Estimate of one quantity at one label.

    `stderr` includes the scatter between runs of one label, if that exceeds their own errors.
    """

    x: float
    value: float | None
    stderr: Finite
    runs: list[str]
    status: str
    is_used: bool = Field(description="whether the laws are fitted to it")
    studentised: Finite = Field(default=None, description="deleted residual")
    p_value: float | None = Field(
        default=None, description="Bonferroni-corrected p-value of the outlier test"
    )
    is_outlier: bool = False
    drifts: list[DriftOut] = Field(default=[])


class CoefficientOut(Answer):
    """One coefficient of a law."""

    name: str
    value: float
    stderr: float


class LawOut(Answer):
    """Fitted law."""

    law: Literal["line", "power"]
    formula: str
    is_chosen: bool
    coefficients: list[CoefficientOut]
    chi_squared: float
    degrees: int
    birge: float = Field(description="Birge ratio √(χ²/ν). If above 1, errors are multiplied by it")
    aic: float
    aicc: Finite = Field(description="null with too few points")


class LawPointOut(Answer):
    """Value of a law at one x with its 95 % interval."""

    x: float
    value: Finite
    stderr: Finite
    lower: Finite
    upper: Finite
    is_outside: bool = Field(description="whether x is outside the measured range")


class QuantityOut(Answer):
    """Trend of a parameter or an onset delay over x."""

    name: str
    unit: str
    kind: Literal["parameter", "onset delay"]
    points: list[PointOut]
    between_runs: float | None = Field(
        description="scatter of runs of one label, in stated errors. Null without such runs"
    )
    laws: list[LawOut]
    reason: str = Field(default="", description="why there is no law")
    band: list[LawPointOut] = Field(default=[], description="confidence band of the chosen law")
    predictions: list[LawPointOut] = Field(
        default=[], description="with intervals for a new estimate"
    )
    notes: list[str] = Field(default=[])


class BatchLabelOut(Answer):
    """All runs of one label."""

    x: float
    runs: list[str]
    evaluations: int
    spans: list[SpanOut]
    warnings: list[str]


class TrendOut(Answer):
    """Trend of a job's batch over one of its labels."""

    job: str
    x: str
    reference: str | None = Field(default=None, description="run that the batch is compared with")
    reference_x: float | None = None
    reference_names: list[str] = Field(default=[], description="names under which it was accepted")
    labels: list[BatchLabelOut]
    quantities: list[QuantityOut]
    missing: int = Field(default=0, description="runs that failed or have not ended")
    notes: list[str] = Field(default=[])
