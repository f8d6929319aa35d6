"""HTTP client of the service; loads neither NumPy nor Ray."""

from service.client.async_client import AsyncClient
from service.client.calls import ClientError, NotFinite, ProblemError, ServerUnreachable
from service.client.client import Client

__all__ = ["AsyncClient", "Client", "ClientError", "NotFinite", "ProblemError", "ServerUnreachable"]
