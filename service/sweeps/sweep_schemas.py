"""Bodies of noise sweeps and batch re-identifications, and summaries of many runs."""

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from service.core.bodies.derived_bodies import take_setting
from service.core.bodies.wire import Answer, Body, Cell, Sigma
from service.datasets.dataset_schemas import MAX_SIMULATED_SAMPLES, InputIn, SampleTime
from service.jobs.job_schemas import IdentificationIn, TrendX, ValidationIn
from sysid.core.settings import SearchMethod
from sysid.data.noise import Noise, NoisePlace
from sysid.identification.options import RunOptions

MAX_REPLICATES = 1_000_000
"""The seed of replicate r is `seed` times this plus r, so that sweeps share no seed by chance."""


def _check_distinct(values: list[Any]) -> list[Any]:
    seen: set[Any] = set()
    for value in values:
        if value in seen:
            raise PydanticCustomError("distinct", "{one} is given twice", {"one": str(value)})
        seen.add(value)
    return values


class TruthIn(Body):
    """Parameters and inputs of the noise-free record, as in ``POST /v1/datasets:simulate``."""

    parameters: dict[str, float] = Field(
        description="true values by name, in the units of the model"
    )
    inputs: dict[str, InputIn] = Field(default={}, description="waveform of each input")
    samples: int = Field(ge=2, le=MAX_SIMULATED_SAMPLES, description="number of samples")
    sample_time: SampleTime = Field(description="sampling period, s")


class NoiseSweepIn(IdentificationIn):
    """Identification under noise: σ × replicates × methods in one job.

    The record is simulated from `truth`, or taken from `datasets`. Replicate r seeds noise and
    search with `seed` · 10⁶ + r, at every σ and for every method. Another grid or more replicates
    therefore leave the other runs unchanged, and these are not computed again.

    With `relative`, σ is in standard deviations of the output. At the `place` plant, σ is the noise
    of each sample of a recursion, as φ of the paper, or else per √s; the record is simulated from
    `truth`. The other fields are those of a job.
    """

    truth: TruthIn | None = Field(default=None, description="record to simulate, without noise")
    datasets: list[str] | None = Field(
        default=None,
        min_length=1,
        max_length=1000,
        description="stored datasets instead, by name or id",
    )
    sigma: Annotated[
        list[Sigma], Field(min_length=1, max_length=100_000), AfterValidator(_check_distinct)
    ] = Field(description="noise levels, in the output's unit")
    relative: bool = Field(
        default=False, description="whether `sigma` is in standard deviations of the output"
    )
    place: NoisePlace = take_setting(Noise, "place")
    replicates: int = Field(
        default=20, ge=1, lt=MAX_REPLICATES, description="runs for each level and method"
    )
    methods: Annotated[list[SearchMethod], AfterValidator(_check_distinct)] = Field(
        default=["simple", "improved"], min_length=1, description="methods to compare"
    )
    seed: int = Field(
        default=1, ge=0, lt=2**32, description="seed from which those of all runs follow"
    )

    @model_validator(mode="after")
    def _check_one_source(self) -> Self:
        if (self.truth is None) == (self.datasets is None):
            raise PydanticCustomError(
                "one_of",
                "give either 'truth' (true parameters and inputs to simulate) or 'datasets'",
            )
        if self.place == "plant" and self.truth is None:
            raise PydanticCustomError(
                "one_of", "noise inside the plant needs 'truth', from which it is simulated"
            )
        return self

    @property
    def job_fields(self) -> dict[str, Any]:
        """The fields shared with a job, as far as they were set."""
        return self.dump_set_fields()


class BatchEntryIn(Body):
    """Measurements at one value of the label. The `datasets` are fitted together as one run."""

    x: TrendX = Field(description="value of the label")
    datasets: list[str] = Field(
        min_length=1, max_length=1000, description="datasets by name or id, fitted together"
    )


class ReidentifyIn(IdentificationIn):
    """Repeated identification of a model for several values of a label, such as tube lengths.

    Each entry of `batch` is one run, in the order of x. Entries with the same x are separate runs
    and are pooled. `reference` is a run (run_…) or the name of an accepted reference to compare the
    batch with. `warm_start` selects where runs begin: at the reference (the default if there is
    one), or at the previous result.

    `trend_parameters` are the parameters of the trend; empty: all free ones. `predict` lists values
    of x to predict at. The other fields are those of a job.
    """

    label: str = Field(
        min_length=1, max_length=64, description="name of the label, such as length_m"
    )
    batch: list[BatchEntryIn] = Field(
        min_length=1, max_length=5000, description="measurements of each value of the label"
    )
    reference: str | None = Field(
        default=None,
        min_length=1,
        max_length=200,
        description="run, or name of an accepted reference, to compare with",
    )
    warm_start: Literal["reference", "previous", "none"] | None = Field(
        default=None, description="where each run begins"
    )
    trend_parameters: list[str] = Field(
        default=[], max_length=100, description="parameters of the trend; empty: all free ones"
    )
    predict: list[TrendX] = Field(
        default=[], max_length=100, description="values of the label to predict at"
    )
    validation: ValidationIn | None = Field(
        default=None, description="data that are compared, but not fitted"
    )
    seed: int = take_setting(RunOptions, "seed")

    @property
    def job_fields(self) -> dict[str, Any]:
        """The fields shared with a job, as far as they were set."""
        return self.dump_set_fields("validation", "seed")


class ParameterSummaryOut(Answer):
    """Summary of one parameter over the runs of a group, in its unit."""

    name: str = Field(description="name of the parameter")
    unit: str = Field(description="unit of its values")
    value: list[float] = Field(description="quantiles of the estimates")
    stderr: float | None = Field(
        description="median standard error: the Cramér–Rao bound where runs reach the optimum"
    )
    reference: float | None = Field(default=None, description="value that errors refer to")
    error: list[float] | None = Field(
        default=None, description="quantiles of estimate minus reference"
    )
    cramer_rao_bound: float | None = Field(
        default=None, description="least standard deviation under the added noise"
    )


class GroupOut(Answer):
    """Summary of the runs with the same values of the grouping keys."""

    key: Cell = Field(description="values of the grouping axes and labels")
    runs: int = Field(description="runs of the group")
    succeeded: int = Field(description="runs that succeeded")
    failed: int = Field(description="runs that failed")
    success_rate: float = Field(description="fraction of finished runs that gave a valid model")
    sigma: float | None = Field(
        default=None, description="of the added noise, if all runs have the same"
    )
    evaluations: float | None = Field(description="mean")
    seconds: float | None = Field(description="mean compute time")
    rms: list[float] | None = Field(description="quantiles, in the output's unit")
    rms_noise_free: list[float] | None = Field(
        default=None, description="quantiles of the RMS against the records without added noise"
    )
    rms_cramer_rao_bound: float | None = Field(
        default=None, description="RMS of estimates at the Cramér–Rao bound: σ√(r/n)"
    )
    fit_percent: dict[str, list[float] | None] = Field(
        description="quantiles of the fit, %, by data"
    )
    parameters: list[ParameterSummaryOut] = Field(description="summary of each parameter")


class ErrorReferenceOut(Answer):
    """Reference values for the errors of the runs with these axis values.

    `kind` is ``truth`` (parameters of the simulation) or ``estimate``. An estimate is that of
    `run`, the best valid run at the least noise `sigma`.
    """

    cell: Cell = Field(description="axis values of these runs")
    kind: Literal["truth", "estimate"] | None = Field(description="origin of the values")
    run: str | None = Field(description="run of the estimate; null for the truth")
    sigma: float | None = Field(description="noise level of that run")
    parameters: dict[str, float] = Field(description="reference values by name, in their units")
    note: str = Field(description="why there are none, or what they mean")


class SummaryOut(Answer):
    """Aggregates over the runs of a job.

    References and Cramér–Rao bounds are added when a job with noise has ended.
    """

    job: str = Field(description="identifier of the job")
    by: list[str] = Field(description="grouping axes and labels")
    quantiles: list[float] = Field(description="probabilities of all quantiles")
    groups: list[GroupOut] = Field(description="summary of each group")
    runs: int = Field(default=0, description="runs of the job")
    reused: int = Field(default=0, description="runs taken over from earlier runs")
    rms_unit: str | None = Field(
        default=None, description="unit of each RMS; σ for several weighted outputs"
    )
    references: list[ErrorReferenceOut] = Field(
        default=[], description="reference values of the errors"
    )
    notes: list[str] = Field(default=[], description="what the numbers mean")
