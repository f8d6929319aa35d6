"""What every wire type shares. Wire types import no core type, so that clients stay light."""

from typing import Annotated, Any, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, Field

Item = TypeVar("Item")

Pointer = Annotated[str, Field(pattern=r"^(/[^/]+)+$", examples=["/noise/sigma"])]
"""A JSON pointer into a job body."""


class Body(BaseModel):
    """A request body: a field that is not known is an error, NaN and infinity are too."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Answer(BaseModel):
    """A response body."""

    model_config = ConfigDict(frozen=True)


class Page(Answer, Generic[Item]):
    """A part of a long list; `next` is the cursor of the following part, None at the end."""

    items: list[Item]
    next: str | None = None


class FieldProblem(Answer):
    """One thing wrong with a request."""

    pointer: str
    detail: str
    column: int | None = None


class ProblemDocument(Answer):
    """An RFC 9457 problem document."""

    type: str
    title: str
    status: int
    detail: str
    instance: str | None = None
    errors: list[FieldProblem] = Field(default=[])


Json = dict[str, Any]
