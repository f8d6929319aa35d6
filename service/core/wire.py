"""What every wire type shares. The client imports no wire type, so that it stays light."""

from collections.abc import Iterable
from typing import Annotated, Any, Generic, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError

from service.core.documents import to_finite

Item = TypeVar("Item")

Pointer = Annotated[str, Field(pattern=r"^(/[^/]+)+$", examples=["/noise/sigma"])]
"""A JSON pointer into a job body."""


MAX_DEPTH = 50
"""Levels of lists and objects within one another in a body; a model document has five."""


def check_depth(value: Any) -> Any:
    """The value itself; what is nested too deeply cannot be copied or written again."""
    level, depth = [value], 0
    while level := [
        inner for one in level if isinstance(one, dict | list) for inner in _iterate_children(one)
    ]:
        depth += 1
        if depth > MAX_DEPTH:
            raise PydanticCustomError(
                "nesting",
                "need lists and objects at most {most} levels within one another",
                {"most": MAX_DEPTH},
            )
    return value


def _iterate_children(value: dict[Any, Any] | list[Any]) -> Iterable[Any]:
    return value.values() if isinstance(value, dict) else value


class Body(BaseModel):
    """A request body: a field that is not known is an error, NaN and infinity are too."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Answer(BaseModel):
    """A response body; it is read from a mapping, or from a row or value by its attributes."""

    model_config = ConfigDict(frozen=True, from_attributes=True)

    @classmethod
    def from_source(cls, source: object, **fields: Any) -> Self:
        """The answer with a row's or value's attributes; `fields` are what it says otherwise."""
        found = {
            name: getattr(source, name)
            for name in cls.model_fields
            if name not in fields and hasattr(source, name)
        }
        return cls.model_validate(found | fields)


Finite = Annotated[float | None, BeforeValidator(to_finite)]
"""A number of an answer; null where there is none, or none that is finite."""


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


Seed = Annotated[int, Field(ge=0, lt=2**63)]
Sigma = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class NoiseIn(Body):
    """Noise added to the measured outputs before fitting, for sensitivity studies."""

    sigma: Sigma = 0.0
    seed: Seed = 0
