"""What is sent and told when parameters of a run are profiled."""

from typing import Annotated, Any

from pydantic import Field

from service.schemas import Answer, Body


class ProfileIn(Body):
    """Which free parameters, and at about how many values of each."""

    parameters: list[Annotated[str, Field(max_length=200)]] | None = Field(
        default=None, min_length=1, max_length=64
    )
    points: int = Field(default=21, ge=3, le=101)


class ProfileOut(Answer):
    """The profile likelihood of one parameter.

    `ratio` is n ln(S(v)/S₀) at `values`; an end of `interval95` is null where the ratio stays
    below the threshold up to the bound, or as far as was looked. `others` are the free parameters
    besides, estimated anew at each of `values`.
    """

    name: str
    unit: str
    estimate: float
    interval95: tuple[float | None, float | None]
    values: list[float]
    ratio: list[float | None]
    rms: list[float | None]
    others: dict[str, list[float]]
    evaluations: int


class ProfilesOut(Answer):
    """Profiles of a run, and their figure as Plotly JSON."""

    id: str
    threshold: float
    profiles: list[ProfileOut]
    figure: dict[str, Any]
