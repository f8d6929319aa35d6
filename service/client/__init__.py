"""HTTP client of the service. It loads neither NumPy nor Ray, and httpx only with a client."""

from typing import TYPE_CHECKING, Any

from service.client.calls import (
    ClientError,
    NotFinite,
    ProblemError,
    ServerUnreachable,
    WaitTimeout,
)

if TYPE_CHECKING:
    from service.client.async_client import AsyncClient
    from service.client.client import Client

__all__ = [
    "AsyncClient",
    "Client",
    "ClientError",
    "NotFinite",
    "ProblemError",
    "ServerUnreachable",
    "WaitTimeout",
]


def __getattr__(name: str) -> Any:
    if name == "Client":
        from service.client.client import Client

        return Client
    if name == "AsyncClient":
        from service.client.async_client import AsyncClient

        return AsyncClient
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
