"""Base classes and fields of all wire types. The client imports none of them."""

from typing import Annotated, Any, Generic, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from service.core.documents import to_finite

Item = TypeVar("Item")

Pointer = Annotated[str, Field(pattern=r"^(/[^/]+)+$", examples=["/noise/sigma"])]
"""A JSON pointer into a job body."""


class Body(BaseModel):
    """A request body: unknown fields, NaN and infinity are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Answer(BaseModel):
    """A response body, read from a mapping or from the attributes of a row or value."""

    model_config = ConfigDict(frozen=True, from_attributes=True)

    @classmethod
    def from_source(cls, source: object, **fields: Any) -> Self:
        """Build the response from the attributes of a row or value, replaced by `fields`.

        Raises
        ------
        AttributeError
            If neither has a field of the response.
        """
        attributes = {
            name: getattr(source, name) for name in cls.model_fields if name not in fields
        }
        return cls.model_validate(attributes | fields)


Finite = Annotated[float | None, BeforeValidator(to_finite)]
"""A number of a response; null if there is none or it is not finite."""


class Page(Answer, Generic[Item]):
    """A part of a long list; `next` is the cursor of the following part, None at the end."""

    items: list[Item]
    next: str | None = None


class FaultOut(Answer):
    """One fault of a request; the detail ends with advice about `option`, such as `segments`."""

    pointer: str
    detail: str
    column: int | None = None
    option: str | None = None


Seed = Annotated[int, Field(ge=0, lt=2**63)]
Sigma = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class NoiseIn(Body):
    """Noise added to the measured outputs before fitting, for sensitivity studies."""

    sigma: Sigma = 0.0
    seed: Seed = 0
