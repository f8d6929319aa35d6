"""How an operation becomes a method of both clients, with its types.

An operation returns a call, or steps. Its method is one function for `Client`, which waits, and
another for `AsyncClient`, which is awaited.
"""

from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Iterator
from functools import update_wrapper
from inspect import getattr_static, signature
from types import GenericAlias
from typing import Any, Concatenate, Generic, ParamSpec, TypeAlias, TypeVar, get_args, overload

from service.client.calls import RestCall
from service.client.exchange import Exchange
from service.client.rows import Rows
from service.client.steps import Steps, carry_out, carry_out_awaiting

P = ParamSpec("P")
T = TypeVar("T")
Result = TypeVar("Result")
Promise = TypeVar("Promise")
Function = TypeVar("Function", bound=Callable[..., Any])

Operation: TypeAlias = Callable[Concatenate[Any, P], RestCall[T]]
SteppedOperation: TypeAlias = Callable[Concatenate[Any, P], Steps[T]]


class SyncFace:
    """A client whose methods wait for their answers."""

    def __init_subclass__(cls) -> None:
        _add_functions(cls, "sync")


class AsyncFace:
    """A client whose methods are awaited, or iterated with ``async for``."""

    def __init_subclass__(cls) -> None:
        _add_functions(cls, "awaited")


def _add_functions(face: type, kind: str) -> None:
    """Give the class of a client a function for each operation that it inherits."""
    for name in dir(face):
        method = getattr_static(face, name)
        if isinstance(method, Method):
            function = getattr(method, kind)
            function.__module__, function.__name__ = face.__module__, name
            function.__qualname__ = f"{face.__qualname__}.{name}"
            setattr(face, name, function)


class Method(Generic[P, Result, Promise]):
    """An operation as a function of either client; the class of a client has this function.

    Type checkers learn both forms from ``__get__``, with the parameters of the operation.

    Attributes
    ----------
    sync, awaited : callable
        Functions of the synchronous and of the asynchronous client.
    """

    def __init__(
        self,
        sync: Callable[Concatenate[Any, P], Result],
        awaited: Callable[Concatenate[Any, P], Promise],
    ) -> None:
        self.sync, self.awaited = sync, awaited

    @overload
    def __get__(self, client: SyncFace, face: type) -> Callable[P, Result]: ...
    @overload
    def __get__(self, client: AsyncFace, face: type) -> Callable[P, Promise]: ...
    @overload
    def __get__(
        self, client: None, face: type[SyncFace]
    ) -> Callable[Concatenate[Any, P], Result]: ...
    @overload
    def __get__(
        self, client: None, face: type[AsyncFace]
    ) -> Callable[Concatenate[Any, P], Promise]: ...
    def __get__(self, client: Any, face: type) -> Any:
        return self


def fetch(operation: Operation[P, T]) -> Method[P, T, Coroutine[Any, Any, T]]:
    """Make a method that returns the answer of a call: text, bytes, or else what JSON holds."""
    content = _get_content(operation)
    steps = _follow(operation, lambda client, call: client._fetch(call, content))
    return _make_answer(steps, operation, _get_only, content)


def collect(operation: Operation[P, T]) -> Method[P, Rows[T], Coroutine[Any, Any, Rows[T]]]:
    """Make a method that returns the items of a list."""
    steps, kind = _follow(operation, Exchange._iterate), GenericAlias(Rows, _get_content(operation))
    return _make_answer(steps, operation, Rows, kind)


def iterate(operation: Operation[P, T]) -> Method[P, Iterator[T], AsyncIterator[T]]:
    """Make a method that iterates over the items of a list, a page at a time."""
    steps = _follow(operation, Exchange._iterate)
    return _make_iterator(steps, operation, _get_content(operation))


def fetch_pieces(
    operation: Operation[P, bytes],
) -> Method[P, Iterator[bytes], AsyncIterator[bytes]]:
    """Make a method that gives a file piece by piece."""
    return _make_iterator(_follow(operation, Exchange._download), operation, bytes)


def answer(operation: SteppedOperation[P, T]) -> Method[P, T, Coroutine[Any, Any, T]]:
    """Make a method that returns the only item of an operation."""
    return _make_answer(operation, operation, _get_only, get_args(_get_content(operation))[0])


def give_each(operation: SteppedOperation[P, T]) -> Method[P, Iterator[T], AsyncIterator[T]]:
    """Make a method that iterates over the items of an operation."""
    return _make_iterator(operation, operation, get_args(_get_content(operation))[0])


def _follow(
    operation: Operation[P, T], give: Callable[[Exchange, RestCall[T]], Steps[T]]
) -> SteppedOperation[P, T]:
    """Let an operation go on with the steps that its call needs."""

    def operate(client: Exchange, /, *arguments: P.args, **options: P.kwargs) -> Steps[T]:
        return give(client, operation(client, *arguments, **options))

    return operate


def _make_answer(
    operate: SteppedOperation[P, T],
    model: Callable[..., Any],
    gather: Callable[[Iterable[T]], Result],
    kind: Any,
) -> Method[P, Result, Coroutine[Any, Any, Result]]:
    def wait(client: Any, /, *arguments: P.args, **options: P.kwargs) -> Result:
        return gather(carry_out(_begin(wait, operate, client, *arguments, **options)))

    async def await_all(client: Any, /, *arguments: P.args, **options: P.kwargs) -> Result:
        steps = _begin(await_all, operate, client, *arguments, **options)
        return gather([item async for item in carry_out_awaiting(steps)])

    return Method(copy_appearance(wait, model, kind), copy_appearance(await_all, model, kind))


def _make_iterator(
    operate: SteppedOperation[P, T], model: Callable[..., Any], content: Any
) -> Method[P, Iterator[T], AsyncIterator[T]]:
    def go(client: Any, /, *arguments: P.args, **options: P.kwargs) -> Iterator[T]:
        return carry_out(_begin(go, operate, client, *arguments, **options))

    def go_awaiting(client: Any, /, *arguments: P.args, **options: P.kwargs) -> AsyncIterator[T]:
        return carry_out_awaiting(_begin(go_awaiting, operate, client, *arguments, **options))

    return Method(
        copy_appearance(go, model, GenericAlias(Iterator, content)),
        copy_appearance(go_awaiting, model, GenericAlias(AsyncIterator, content)),
    )


def _begin(
    method: Callable[..., Any],
    operate: SteppedOperation[P, T],
    client: Any,
    /,
    *arguments: P.args,
    **options: P.kwargs,
) -> Steps[T]:
    """Begin an operation; arguments that do not fit are told by the name of the method."""
    try:
        signature(method).bind(client, *arguments, **options)
    except TypeError as error:
        raise TypeError(f"{method.__qualname__}() {error}") from None
    return operate(client, *arguments, **options)


def copy_appearance(function: Function, model: Callable[..., Any], kind: Any) -> Function:
    """Give a function the docstring and parameters of another; it returns another `kind`."""
    update_wrapper(function, model)
    function.__annotations__ = {**model.__annotations__, "return": kind}
    vars(function)["__signature__"] = signature(model).replace(return_annotation=kind)
    return function


def _get_only(items: Iterable[T]) -> T:
    [only] = items
    return only


def _get_content(operation: Callable[..., Any]) -> Any:
    """Get the type in the brackets of what an operation gives, such as that of an answer."""
    return get_args(operation.__annotations__["return"])[0]
