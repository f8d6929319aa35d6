"""Wire types of edits and deletions of stored items."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from service.core.bodies.wire import Answer, Body

MAX_TAGS = 50

ItemKindName = Literal["job", "run", "dataset", "model", "reference"]


def _check_text(value: str) -> str:
    if not value.isprintable() or value != value.strip():
        raise PydanticCustomError("text", "need printable characters without outer blanks")
    return value


PlainText = AfterValidator(_check_text)
Tag = Annotated[str, Field(min_length=1, max_length=64), PlainText]


class EditIn(Body):
    """Changes of name, note and tags; what is left out stays as it is.

    `tags` replaces all tags. A note of null is removed. Models have the name of their document, and
    runs have none.
    """

    name: Annotated[str, Field(min_length=1, max_length=200), PlainText] = Field(
        default="", description="new name"
    )
    note: str | None = Field(default=None, max_length=10_000, description="note; null removes it")
    tags: list[Tag] = Field(default=[], max_length=MAX_TAGS, description="all tags")


class ItemOut(Answer):
    """A stored item: its kind, its identifier (of a reference its name), and its name."""

    kind: ItemKindName = Field(description="kind of the item")
    id: str = Field(description="identifier; of a reference its name")
    name: str = Field(description="name of the item")


class DeletedOut(Answer):
    """Everything that was deleted, the requested item first."""

    deleted: list[ItemOut] = Field(description="all items, the requested one first")
