"""Comparison of runs on the same data."""

from typing import Any

from pydantic import Field

from service.schemas import Answer, Body


class CompareIn(Body):
    """Which runs to compare: at least two, of any jobs, fitted to the same data."""

    runs: list[str] = Field(min_length=2, max_length=50)


class ComparedRun(Answer):
    """One candidate. `parameters` counts the free ones; AIC and BIC are smaller where better."""

    run: str
    job: str
    number: int
    model: str
    title: str
    cell: dict[str, Any]
    parameters: int
    samples: int
    rms: float | None
    rms_validation: float | None
    fit_estimation: float | None
    fit_validation: float | None
    aic: float | None
    bic: float | None
    residuals_passed: bool | None
    residuals_data: str | None
    evaluations: int


class ComparedValue(Answer):
    """What one run says of a parameter; `stderr` and `interval95` are null where it has none."""

    run: str
    value: float
    stderr: float | None
    interval95: list[float] | None
    status: str


class ComparedParameter(Answer):
    """A parameter that two runs or more have.

    `differs` if two of its 95 % intervals are apart; null where fewer than two have one.
    """

    name: str
    unit: str
    values: list[ComparedValue]
    differs: bool | None
    note: str


class ComparisonOut(Answer):
    """Runs side by side, the best first; `unit` is that of the RMS.

    `notes` are sentences: which parameters depend on the model, which figures do not compare.
    """

    unit: str
    runs: list[ComparedRun]
    parameters: list[ComparedParameter]
    notes: list[str]
