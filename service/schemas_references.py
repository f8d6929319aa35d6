"""What is told about accepted references."""

from datetime import datetime
from typing import Any

from pydantic import Field

from service.schemas import Answer, Body


class ReferenceIn(Body):
    """Accept a run as the reference of a name; `by` and `note` are kept with it."""

    run: str = Field(max_length=100)
    by: str | None = Field(default=None, max_length=200)
    note: str | None = Field(default=None, max_length=2000)


class AcceptedOut(Answer):
    """One acceptance."""

    run: str
    by: str | None = None
    note: str | None = None
    at: datetime


class ReferenceOut(Answer):
    """A reference: the run in use, what it gave, and what was accepted before it."""

    name: str
    run: str
    job: str
    by: str | None = None
    note: str | None = None
    at: datetime
    labels: dict[str, Any] = Field(default={})
    estimates: dict[str, dict[str, float | None]] = Field(default={})
    history: list[AcceptedOut] = Field(default=[], description="the 1,000 before, latest first")
