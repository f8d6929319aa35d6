"""The body of a batch re-identification, as clients send it."""

from typing import Any, Literal

from pydantic import Field

from service.schemas import Body
from service.schemas_jobs import IdentificationIn, PlaceIn, Seed, ValidationIn


class ExperimentsIn(Body):
    """What was measured at one value of the label: `datasets` are fitted together, as one run."""

    x: PlaceIn
    datasets: list[str] = Field(min_length=1, max_length=1000)


class ReidentifyIn(IdentificationIn):
    """Identify a model anew for several values of a label, such as the lengths of a tube.

    One run for each entry of `batch`, in the order of x; entries of one x are runs of their own
    and are pooled. `reference` is a run (run_…) or the name of an accepted reference, which the
    batch is compared with. `warm_start`: every run begins at the reference, or each at the result
    of the one before; the reference by default where there is one.

    `look_at` are the parameters of the trend, `predict` the values of x to predict at. The other
    fields are those of a job.
    """

    label: str = Field(min_length=1, max_length=64)
    batch: list[ExperimentsIn] = Field(min_length=1, max_length=5000)
    reference: str | None = Field(default=None, min_length=1, max_length=200)
    warm_start: Literal["reference", "previous", "none"] | None = None
    look_at: list[str] = Field(default=[], max_length=100)
    predict: list[PlaceIn] = Field(default=[], max_length=100)
    validation: ValidationIn | None = None
    seed: Seed = 1

    @property
    def shared(self) -> dict[str, Any]:
        """The fields that the job has as well, as they were given."""
        return self.given("validation", "seed")
