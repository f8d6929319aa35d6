"""Wire types of models."""

from typing import Any

from pydantic import Field

from service.core.wire import Answer, FaultOut


class ModelOut(Answer):
    """A model: built in (`version` 0) or stored by a user."""

    name: str
    version: int
    builtin: bool
    title: str
    form: str
    inputs: dict[str, str]
    outputs: dict[str, str]
    parameters: dict[str, dict[str, Any]]
    note: str | None = None
    tags: list[str] = Field(default=[])
    document: dict[str, Any] | None = None


class CheckOut(Answer):
    """Result of a check: whether a model document is valid, and every error in it."""

    valid: bool
    errors: list[FaultOut]
    normal_form: dict[str, Any] | None = None
