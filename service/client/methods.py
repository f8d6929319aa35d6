"""How an operation becomes a method of both clients, with its types.

A method is a descriptor: of a client that waits it is a plain function, of the other one to be
awaited. Type checkers learn both forms from ``__get__``, with the parameters of the operation.
"""

from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Iterator
from functools import update_wrapper
from inspect import signature
from types import GenericAlias, MethodType
from typing import Any, Concatenate, Generic, ParamSpec, TypeAlias, TypeVar, get_args, overload

from service.client.calls import RestCall
from service.client.exchange import Exchange
from service.client.rows import Rows

P = ParamSpec("P")
T = TypeVar("T")
Operation: TypeAlias = Callable[Concatenate[Any, P], RestCall[T]]


class Waiting:
    """A client whose methods wait for their answers."""


class Awaited:
    """A client whose methods are awaited, or iterated with ``async for``."""


def finish(work: Coroutine[Any, Any, T]) -> T:
    """Carry out a coroutine that never waits."""
    try:
        work.send(None)
    except StopIteration as end:
        result: T = end.value
        return result
    raise RuntimeError("a step of the synchronous client waited")


def finish_each(items: AsyncGenerator[T, None]) -> Iterator[T]:
    """Iterate over an asynchronous generator that never waits."""
    try:
        while True:
            try:
                item = finish(items.__anext__())
            except StopAsyncIteration:
                return
            yield item
    finally:
        finish(items.aclose())


class _Method(Generic[P, T]):
    """A function of both clients: as it is for one, finished at once for the other."""

    def __init__(self, function: Callable[..., Any], finish: Callable[..., Any], kind: Any) -> None:
        def finish_function(*given: Any, **options: Any) -> Any:
            return finish(function(*given, **options))

        self._awaited = function
        self._waiting = _present(finish_function, function, kind)

    def bind(self, client: Any, owner: type) -> Any:
        """Return the function of a client's class, as its method if there is a client."""
        function = self._waiting if issubclass(owner, Waiting) else self._awaited
        return function if client is None else MethodType(function, client)


def _present(function: Callable[..., T], model: Callable[..., Any], kind: Any) -> Callable[..., T]:
    """Give a function the name, docstring and parameters of another; it returns another `kind`."""
    update_wrapper(function, model)
    function.__annotations__ = {**model.__annotations__, "return": kind}
    vars(function)["__signature__"] = signature(model).replace(return_annotation=kind)
    return function


class Answered(_Method[P, T]):
    """A method with one answer."""

    def __init__(self, function: Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]) -> None:
        super().__init__(function, finish, function.__annotations__["return"])

    @overload
    def __get__(self, client: Waiting, owner: type) -> Callable[P, T]: ...
    @overload
    def __get__(self, client: Awaited, owner: type) -> Callable[P, Coroutine[Any, Any, T]]: ...
    @overload
    def __get__(self, client: None, owner: type) -> Callable[..., Any]: ...
    def __get__(self, client: Any, owner: type) -> Any:
        return self.bind(client, owner)


class Iterated(_Method[P, T]):
    """A method with many answers, one after the other."""

    def __init__(self, function: Callable[Concatenate[Any, P], AsyncIterator[T]]) -> None:
        kind = GenericAlias(Iterator, _get_content(function))
        super().__init__(function, finish_each, kind)

    @overload
    def __get__(self, client: Waiting, owner: type) -> Callable[P, Iterator[T]]: ...
    @overload
    def __get__(self, client: Awaited, owner: type) -> Callable[P, AsyncIterator[T]]: ...
    @overload
    def __get__(self, client: None, owner: type) -> Callable[..., Any]: ...
    def __get__(self, client: Any, owner: type) -> Any:
        return self.bind(client, owner)


def fetch(operation: Operation[P, T]) -> Answered[P, T]:
    """Make a method that returns the answer: text, bytes, or else what JSON holds."""
    kind = _get_content(operation)

    async def ask(client: Exchange, *given: P.args, **options: P.kwargs) -> T:
        return await client._fetch(operation(client, *given, **options), kind)

    return Answered(_present(ask, operation, kind))


def collect(operation: Operation[P, T]) -> Answered[P, Rows[T]]:
    """Make a method that returns the items of a list."""

    async def ask(client: Exchange, *given: P.args, **options: P.kwargs) -> Rows[T]:
        return await client._collect(operation(client, *given, **options))

    return Answered(_present(ask, operation, GenericAlias(Rows, _get_content(operation))))


def iterate(operation: Operation[P, T]) -> Iterated[P, T]:
    """Make a method that iterates over the items of a list, a page at a time."""

    def ask(client: Exchange, *given: P.args, **options: P.kwargs) -> AsyncIterator[T]:
        return client._iterate(operation(client, *given, **options))

    return Iterated(_present(ask, operation, GenericAlias(AsyncIterator, _get_content(operation))))


def fetch_pieces(operation: Operation[P, bytes]) -> Iterated[P, bytes]:
    """Make a method that gives a file piece by piece."""

    def ask(client: Exchange, *given: P.args, **options: P.kwargs) -> AsyncIterator[bytes]:
        return client._download(operation(client, *given, **options))

    return Iterated(_present(ask, operation, AsyncIterator[bytes]))


def _get_content(function: Callable[..., Any]) -> Any:
    """Get the type in the brackets of what a function returns, such as that of an answer."""
    return get_args(function.__annotations__["return"])[0]
