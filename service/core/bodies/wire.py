"""Base classes and fields of all wire types. The client imports none of them."""

from typing import Annotated, Any, Generic, Self, TypeVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    JsonValue,
    TypeAdapter,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from service.core.bodies.user_documents import to_finite
from sysid.core.settings import SEED

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


class DescribedBy:
    """Annotation of a document that is sent as it was stored; its schema is that of a wire type.

    Validation would cost time in every list, and refuse what an earlier version has stored.
    """

    def __init__(self, kind: Any) -> None:
        self._kind = kind

    def __get_pydantic_json_schema__(
        self, _schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        return handler(TypeAdapter(self._kind).core_schema)


Cell = dict[str, JsonValue]
"""Values of the axes of a sweep, by the pointers of the fields."""
Labels = dict[str, float | int | str | bool | None]
"""Labels of a cell by name."""


class FigureOut(Answer):
    """A figure of Plotly."""

    data: list[dict[str, Any]] = Field(description="traces, as Plotly defines them")
    layout: dict[str, Any] = Field(description="layout, as Plotly defines it")


Finite = Annotated[float | None, BeforeValidator(to_finite)]
"""A number of a response; null if there is none or it is not finite."""


class Page(Answer, Generic[Item]):
    """A part of a long list; `next` is the cursor of the following part, None at the end."""

    items: list[Item] = Field(description="items of this page, in the order of the list")
    next: str | None = Field(
        default=None, description="cursor of the following page; null on the last one"
    )


class FaultOut(Answer):
    """One fault of a request."""

    pointer: str = Field(
        description="JSON pointer into the body; `?name`: in the query; `{name}`: in the path"
    )
    detail: str = Field(description="what was wrong, what was found, and what would be right")
    column: int | None = Field(
        default=None, description="column inside the text of the field, from 1; for equations"
    )
    option: str | None = Field(
        default=None,
        description="option that the detail advises at its end, such as `segments`; for files",
    )


Seed = Annotated[int, Field(ge=SEED.least, lt=SEED.below)]
Sigma = Annotated[float, Field(ge=0, allow_inf_nan=False)]
