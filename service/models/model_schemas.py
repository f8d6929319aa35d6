"""Wire types of models."""

from typing import Annotated, Any

from pydantic import ConfigDict, Field

from service.core.bodies.wire import Answer, DescribedBy, FaultOut, Finite, Page


class ModelParameterOut(Answer):
    """Parameter of a model."""

    lower: Finite = Field(description="lower bound, in `unit`; null: follows the data")
    upper: Finite = Field(description="upper bound, in `unit`; null: follows the data")
    bounds: str | None = Field(default=None, description="what its bounds follow from")
    unit: str = Field(description="unit of its values")
    scale: str = Field(description="scale on which the search moves")
    fixed: Finite = Field(default=None, description="value at which it is held, in `unit`")
    tied: str | None = Field(default=None, description="expression that gives its value")
    physical: str | None = Field(
        default=None, description="bounds that are limits of the quantity: lower, upper or both"
    )


class ModelDocumentOut(Answer):
    """A model document; its fields are explained in the documentation of models."""

    model_config = ConfigDict(extra="allow")

    name: str | None = Field(default=None, description="name of the model")
    title: str | None = Field(default=None, description="what it describes, in a few words")


class EquationOut(Answer):
    """An equation as a reader writes it."""

    text: str = Field(description="the equation as text, such as `dx/dt = (u - x)/T`")
    mathml: str = Field(description="the same as a `<math>` element, which a browser shows")


class ModelOut(Answer):
    """A model: built in (`version` 0) or stored by a user."""

    name: str = Field(description="name of the model")
    version: int = Field(description="version, from 1; 0 for a built-in model")
    builtin: bool = Field(description="whether it belongs to lagid")
    title: str = Field(description="what it describes, in a few words")
    form: str = Field(description="form of the equations")
    inputs: dict[str, str] = Field(description="unit of each input")
    outputs: dict[str, str] = Field(description="unit of each output")
    parameters: dict[str, ModelParameterOut] = Field(description="parameters by name")
    note: str | None = Field(default=None, description="note of a user")
    tags: list[str] = Field(default=[], description="tags of users")
    document: Annotated[Any, DescribedBy(ModelDocumentOut | None)] = Field(
        default=None, description="document of the model; null in lists"
    )
    equations: list[EquationOut] = Field(
        default=[], description="equations, intermediate names, outputs; empty in lists"
    )


class ModelPage(Page[ModelOut]):
    """Models: on the first page the built-in ones, then those of users."""


class CheckOut(Answer):
    """Result of a check: whether a model document is valid, and every error in it."""

    valid: bool = Field(description="whether the document is a model")
    errors: list[FaultOut] = Field(description="every fault of the document")
    warnings: list[FaultOut] = Field(
        default=[], description="what is declared in a valid document but used nowhere"
    )
    normal_form: Annotated[Any, DescribedBy(ModelDocumentOut | None)] = Field(
        default=None, description="document with every default; null if it has faults"
    )
    equations: list[EquationOut] = Field(
        default=[], description="equations, intermediate names, outputs; empty if it has faults"
    )
