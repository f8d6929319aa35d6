"""The path under which the service is reached, such as ``/lagid`` behind a proxy.

It belongs to a request. What is made while the request is answered takes it from here, so that no
page, figure or message is passed it.
"""

from contextvars import ContextVar

_root_path: ContextVar[str] = ContextVar("root_path", default="")


def set_root_path(path: str) -> None:
    """Set the root path for the rest of this request."""
    _root_path.set(path)


def get_root_path() -> str:
    """Return the root path of the request that is answered, without a slash at its end."""
    return _root_path.get()


def to_address(path: str) -> str:
    """Return the address of a path of the service, such as ``/v1/jobs``, for this request."""
    return f"{_root_path.get()}{path}"
