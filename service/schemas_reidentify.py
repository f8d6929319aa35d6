"""The body of a batch re-identification, as clients send it."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from service.schemas import Body
from service.schemas_jobs import (
    AlgorithmIn,
    JobIn,
    LossIn,
    ParameterIn,
    PlaceIn,
    Seed,
    ValidationIn,
    model_reference,
)


class ExperimentsIn(Body):
    """What was measured at one value of the label: `datasets` are fitted together, as one run."""

    x: PlaceIn
    datasets: list[str] = Field(min_length=1, max_length=1000)


class ReidentifyIn(Body):
    """Identify a model anew for several values of a label, such as the lengths of a tube.

    One run for each entry of `batch`, in the order of x; entries of one x are runs of their own
    and are pooled. `reference` is a run (run_…) or the name of an accepted reference, which the
    batch is compared with. `warm_start`: every run begins at the reference, or each at the result
    of the one before; the reference by default where there is one.

    `look_at` are the parameters of the trend, `predict` the values of x to predict at. The other
    fields are those of a job.
    """

    name: str | None = Field(default=None, max_length=200)
    model: Annotated[Any, AfterValidator(model_reference)]
    label: str = Field(min_length=1, max_length=64)
    batch: list[ExperimentsIn] = Field(min_length=1, max_length=5000)
    reference: str | None = Field(default=None, min_length=1, max_length=200)
    warm_start: Literal["reference", "previous", "none"] | None = None
    look_at: list[str] = Field(default=[], max_length=100)
    predict: list[PlaceIn] = Field(default=[], max_length=100)
    channels: dict[str, str] = Field(default={})
    hold: dict[str, Literal["zero", "first", "band-limited"]] = Field(default={})
    validation: ValidationIn | None = None
    parameters: dict[str, ParameterIn] = Field(default={})
    prediction: Literal["simulation", "one-step"] = "simulation"
    loss: LossIn = LossIn()
    weights: dict[str, float] | None = None
    skip: int = Field(default=0, ge=0)
    algorithm: AlgorithmIn = AlgorithmIn()
    seed: Seed = 1
    priority: int = Field(default=0, ge=-100, le=100)
    reuse: bool = True

    @property
    def shared(self) -> dict[str, Any]:
        """The fields that the job has as well, as they were given."""
        names = (set(type(self).model_fields) & set(JobIn.model_fields)) - {"warm_start"}
        return self.model_dump(include=names, exclude_unset=True)
