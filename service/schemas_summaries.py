"""What is told about many runs at once."""

from typing import Any, Literal

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
    reference: float | None = Field(default=None, description="what errors are told against")
    error: list[float] | None = Field(
        default=None, description="quantiles of estimate minus reference"
    )
    floor: float | None = Field(
        default=None, description="Cramér–Rao floor: least standard deviation under the added noise"
    )


class GroupOut(Answer):
    """The runs that share the values of the grouping keys."""

    key: dict[str, Any]
    runs: int
    succeeded: int
    failed: int
    success_rate: float = Field(description="runs that succeeded with a valid model, of those over")
    sigma: float | None = Field(
        default=None, description="of the noise added, where all have the same"
    )
    evaluations: float | None = Field(description="mean")
    seconds: float | None = Field(description="mean compute time")
    rms: list[float] | None = Field(description="quantiles, in the output's unit")
    rms_noise_free: list[float] | None = Field(
        default=None, description="quantiles of the RMS against the records before noise was added"
    )
    rms_floor: float | None = Field(
        default=None, description="that of estimates at the Cramér–Rao floor: σ√(r/n)"
    )
    fit_percent: dict[str, list[float] | None]
    parameters: list[ParameterSummaryOut]


class ReferenceOut(Answer):
    """What the errors of the runs with these values of the axes are told against.

    `kind` is ``truth`` (the data were simulated from these values) or ``estimate``: that of `run`,
    the best valid run with the least noise, `sigma`.
    """

    cell: dict[str, Any]
    kind: Literal["truth", "estimate"] | None
    run: str | None
    sigma: float | None
    parameters: dict[str, float]
    note: str


class SummaryOut(Answer):
    """Aggregates over the runs of a job.

    References and floors are there once a job with noise has ended.
    """

    job: str
    by: list[str]
    quantiles: list[float]
    groups: list[GroupOut]
    runs: int = 0
    reused: int = Field(default=0, description="runs taken over from ones computed before")
    rms_unit: str | None = Field(
        default=None, description="of each RMS; σ: of several outputs together"
    )
    references: list[ReferenceOut] = Field(default=[])
    notes: list[str] = Field(default=[], description="what the numbers mean")
