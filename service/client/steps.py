"""How both clients carry out an operation: a generator of steps, which is written once.

A step is what a client did, or will have done when it is awaited. The generator gets its result.
"""

from collections.abc import AsyncIterator, Generator, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeAlias, TypeVar

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class AnswerItem(Generic[T]):
    """What an operation gives its caller: one item of many, or its only answer."""

    value: T


Steps: TypeAlias = Generator[AnswerItem[T], Any, None]
"""An operation under way. All that it yields besides items are steps."""


def carry_out(steps: Steps[T]) -> Iterator[T]:
    """Iterate over the items of an operation whose steps are done at once."""
    advance = partial(steps.send, None)
    while True:
        try:
            step: Any = advance()
        except StopIteration:
            return
        try:
            if isinstance(step, AnswerItem):
                yield step.value
                step = None
        except BaseException as error:  # noqa: BLE001 - raised by the operation
            advance = partial(steps.throw, error)
        else:
            advance = partial(steps.send, step)


async def carry_out_awaiting(steps: Steps[T]) -> AsyncIterator[T]:
    """Iterate over the items of an operation whose steps are awaited."""
    advance = partial(steps.send, None)
    while True:
        try:
            step: Any = advance()
        except StopIteration:
            return
        try:
            if isinstance(step, AnswerItem):
                yield step.value
                result = None
            else:
                result = await step
        except BaseException as error:  # noqa: BLE001 - raised by the operation
            advance = partial(steps.throw, error)
        else:
            advance = partial(steps.send, result)
