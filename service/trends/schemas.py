"""What is told about the trend of a batch."""

from typing import Literal

from pydantic import Field

from service.core.wire import Answer, Finite


class SpanOut(Answer):
    """From the least to the largest measured value of an output."""

    output: str
    channel: str
    unit: str
    lower: float
    upper: float


class DriftOut(Answer):
    """How far an estimate is from what a reference says."""

    kind: Literal["run", "trend"] = Field(
        description="against the reference run, or against what the trend of its job predicts"
    )
    expected: float
    difference: float
    z: float = Field(description="in standard errors of the difference")
    limit: float = Field(description="size of z from which on it is told as drifted")
    drifted: bool


class PointOut(Answer):
    """What the runs of one label say of one quantity.

    `stderr` holds what runs of one label differ by, where that is more than they state.
    """

    x: float
    value: float | None
    stderr: Finite
    runs: list[str]
    status: str
    is_used: bool = Field(description="whether the laws go through it")
    studentised: Finite = Field(default=None, description="deleted residual")
    p_value: float | None = Field(default=None, description="Bonferroni's, of being no outlier")
    is_outlier: bool = False
    drifts: list[DriftOut] = Field(default=[])


class CoefficientOut(Answer):
    """One coefficient of a law."""

    name: str
    value: float
    stderr: float


class LawOut(Answer):
    """A law that was fitted."""

    law: Literal["line", "power"]
    formula: str
    is_chosen: bool
    coefficients: list[CoefficientOut]
    chi_squared: float
    degrees: int
    birge: float = Field(description="√(χ²/ν); errors are multiplied by it where it is above 1")
    aic: float
    aicc: Finite = Field(description="null with too few points for it")


class LawPointOut(Answer):
    """A law at one x with its 95 % interval."""

    x: float
    value: Finite
    stderr: Finite
    lower: Finite
    upper: Finite
    is_outside: bool = Field(description="whether x is outside the measured range")


class QuantityOut(Answer):
    """A parameter, or the onset delay, over x."""

    name: str
    unit: str
    kind: Literal["parameter", "onset delay"]
    points: list[PointOut]
    between_runs: float | None = Field(
        description="how many stated errors runs of one label differ by; null without such runs"
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
    """The batch of a job over one of its labels."""

    job: str
    x: str
    reference: str | None = Field(default=None, description="run that the batch is compared with")
    reference_x: float | None = None
    reference_names: list[str] = Field(default=[], description="under which it was accepted")
    places: list[BatchLabelOut]
    quantities: list[QuantityOut]
    missing: int = Field(default=0, description="runs that failed or are not over")
    notes: list[str] = Field(default=[])
