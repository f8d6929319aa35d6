"""The body of the noise sweep, as clients send it."""

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from service.schemas import Body
from service.schemas_datasets import MAX_SIMULATED_SAMPLES, InputIn, SampleTime
from service.schemas_jobs import IdentificationIn, Sigma

MOST_REPLICATES = 1_000_000
"""Seeds of replicate r are `seed` times this plus r, so that no two sweeps share one by chance."""

Method = Literal["simple", "improved-paper", "improved"]


def _distinct(found: list[Any]) -> list[Any]:
    seen: set[Any] = set()
    for one in found:
        if one in seen:
            raise PydanticCustomError("distinct", "{one} is there twice", {"one": str(one)})
        seen.add(one)
    return found


class TruthIn(Body):
    """What the record without noise is simulated from, as ``POST /v1/datasets:simulate`` does."""

    parameters: dict[str, float]
    inputs: dict[str, InputIn] = Field(default={})
    samples: int = Field(ge=2, le=MAX_SIMULATED_SAMPLES)
    sample_time: SampleTime


class NoiseSweepIn(IdentificationIn):
    """Identification under noise: σ × replicates × methods in one job.

    The record is simulated from `truth`, or it is that of `datasets`. Replicate r takes noise and
    search from the seeds `seed` · 10⁶ + r, at every σ and for every method, so that another grid
    or more replicates leave the other runs as they are; those are not computed again.

    `relative`: σ is in standard deviations of the output. The other fields are those of a job.
    """

    truth: TruthIn | None = None
    datasets: list[str] | None = Field(default=None, min_length=1, max_length=1000)
    sigma: Annotated[
        list[Sigma], Field(min_length=1, max_length=100_000), AfterValidator(_distinct)
    ]
    relative: bool = False
    replicates: int = Field(default=20, ge=1, lt=MOST_REPLICATES)
    methods: Annotated[list[Method], AfterValidator(_distinct)] = Field(
        default=["simple", "improved"], min_length=1
    )
    seed: int = Field(default=1, ge=0, lt=2**32)

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.truth is None) == (self.datasets is None):
            raise PydanticCustomError(
                "one_of",
                "give either 'truth' (true parameters and an input, to simulate) or 'datasets'",
            )
        return self

    @property
    def shared(self) -> dict[str, Any]:
        """The fields that the job has as well, as they were given."""
        return self.given()
