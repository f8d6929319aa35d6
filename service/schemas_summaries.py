"""What is told about many runs at once."""

from typing import Any

from pydantic import Field

from service.schemas import Answer


class ParameterSummaryOut(Answer):
    """One parameter over the runs of a group, in its unit."""

    name: str
    unit: str
    value: list[float] = Field(description="quantiles of the estimates")
    stderr: float | None = Field(
        description="median standard error: the Cramér–Rao floor where the runs reach the optimum"
    )


class GroupOut(Answer):
    """The runs that share the values of the grouping keys."""

    key: dict[str, Any]
    runs: int
    succeeded: int
    failed: int
    success_rate: float = Field(description="runs that succeeded with a valid model, of those over")
    evaluations: float | None = Field(description="mean")
    seconds: float | None = Field(description="mean compute time")
    rms: list[float] | None = Field(description="quantiles, in the output's unit")
    fit_percent: dict[str, list[float] | None]
    parameters: list[ParameterSummaryOut]


class SummaryOut(Answer):
    """Aggregates over the runs of a job."""

    job: str
    by: list[str]
    quantiles: list[float]
    groups: list[GroupOut]
