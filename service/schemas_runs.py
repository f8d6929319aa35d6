"""What is told about runs. The result's names are those of the numerical core."""

from datetime import datetime
from typing import Any, Literal

from pydantic import ConfigDict, Field

from service.schemas import Answer
from service.schemas_datasets import Series

RunState = Literal["queued", "running", "succeeded", "failed", "cancelled"]


class RunOut(Answer):
    """One identification: its cell of the sweep, how far it is, and what it gave.

    The fields of the result document (estimates, fit, islands, warnings …) follow once there is
    one; see the contract in the documentation of the interface.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    id: str
    job: str
    number: int
    cell: dict[str, Any]
    labels: dict[str, Any]
    state: RunState
    valid: bool | None = None
    rms: float | None = None
    rms_unit: str | None = Field(
        default=None, description="told of a single run; σ: of several outputs together"
    )
    evaluations: int = 0
    generations: int = 0
    seconds: float | None = None
    progress: float
    error: str | None = None
    reused_from: str | None = Field(
        default=None, description="the run that was computed before with the same specification"
    )
    created_at: datetime
    started_at: datetime | None = None
    finished_at: datetime | None = None
    parameters: list[dict[str, Any]] = Field(default=[])


class ImprovementOut(Answer):
    """A better champion of one island."""

    generation: int
    evaluations: int
    rms: float
    phase: str
    parameters: list[float]


class HistoryOut(Answer):
    """Improvements of every island; `names` are those of the columns of `parameters`."""

    id: str
    names: list[str]
    islands: list[list[ImprovementOut]]


class ExperimentOut(Answer):
    """Measured and simulated outputs of one experiment."""

    name: str
    measured: list[Series]
    simulated: list[Series]


class ResponseOut(Answer):
    """Measured against simulated, experiment by experiment."""

    id: str
    experiments: list[ExperimentOut]


class CorrelationOut(Answer):
    """A correlation function of residuals with its bands, and the test made of it.

    `input` is null for the autocorrelation. `lags` are in periods of `period` seconds, or, where
    `period` is null, in samples of irregular times. Bands are symmetric about zero.
    """

    experiment: int
    output: str
    test: Literal["whiteness", "independence"]
    input: str | None
    outcome: Literal["passed", "failed", "not tested"]
    reason: str
    samples: int
    lags_tested: int
    inside95: float | None
    inside99: float | None
    statistic: float | None
    degrees: float | None
    p: float | None
    period: float | None
    lags: list[float]
    values: list[float]
    band95: list[float]
    band99: list[float]


class ResidualsOut(Answer):
    """Tests of a run's residuals with their correlation functions.

    `level` is the chance that a true model fails one test or more of all; `passed` is null where
    nothing could be tested; `note` says what could not be read.
    """

    id: str
    data: Literal["estimation", "validation"]
    passed: bool | None
    level: float
    note: str
    tests: list[CorrelationOut]


class MigrantOut(Answer):
    """One line of the migration log."""

    epoch: int
    source: int
    destination: int
    fitness: float


class MigrationsOut(Answer):
    """The migration log of a run."""

    id: str
    migrants: list[MigrantOut]
