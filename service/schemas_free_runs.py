"""What is sent and told when an identified model runs freely over a recording."""

from pydantic import Field

from service.schemas import Answer, Body
from service.schemas_runs import ExperimentOut


class FreeRunIn(Body):
    """The model of a run over a stored `dataset`, every segment an experiment of its own.

    `channels` say which recorded channel is which signal of the model, where that is another one
    than in the run's job. The first `skip` samples of every output are not judged.
    """

    dataset: str
    channels: dict[str, str] = Field(default={})
    skip: int = Field(default=0, ge=0)


class AgreementOut(Answer):
    """How well one output of one experiment (from 1) is told; null where it does not vary."""

    experiment: int
    output: str
    unit: str
    samples: int
    rms: float
    fit_percent: float | None


class FreeRunOut(Answer):
    """Measured and simulated outputs, and how well they agree.

    `rms` is in `unit`: with several outputs weighted, in standard deviations of each. `starts`
    are initial states that the model does not fix: they belong to a recording, and are found on
    it, alone.
    """

    id: str
    dataset: str
    unit: str
    rms: float
    fit_percent: float | None
    agreement: list[AgreementOut]
    starts: dict[str, float]
    experiments: list[ExperimentOut]
