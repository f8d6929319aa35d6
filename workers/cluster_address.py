"""Check the address of a Ray cluster before joining it, and explain why joining failed.

Ray waits a minute and more for an address where nobody listens. For a wrong token it reports only
that it could not connect. Nothing here imports Ray.
"""

import os
import socket
from pathlib import Path

from workers.errors import ClusterUnavailable

CONNECT_SECONDS = 5.0
"""Time limit of a connection to a cluster."""

TOKEN_HINT = (
    "set RAY_AUTH_TOKEN (or RAY_AUTH_TOKEN_PATH) to the cluster's token, "
    "or RAY_AUTH_MODE=disabled if it has none"
)


def check_address(address: str) -> None:
    """Refuse an address of the wrong form, without a listener, or without a token.

    Raises
    ------
    ClusterUnavailable
        The message says in one line what is wrong and what would be right.
    """
    if address == "auto":
        return
    if "://" in address:
        raise ClusterUnavailable(
            f"the Ray address {address!r} is one of Ray Client, which is not supported. Run the "
            "dispatcher inside the cluster, and give the address of its head as host:port."
        )
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 2**16:
        raise ClusterUnavailable(
            f"the Ray address {address!r} is invalid: write host:port of the cluster's head, such "
            "as 10.0.0.5:6379, or auto for the cluster of this machine"
        )
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS).close()
    except OSError as error:
        raise ClusterUnavailable(
            f"no Ray cluster answers at {address} ({error.strerror or error}). Is its head "
            "running, and is this its address?"
        ) from error
    if not has_token():
        raise ClusterUnavailable(
            f"there is no token for the Ray cluster at {address}: {TOKEN_HINT}"
        )


def has_token() -> bool:
    """Whether Ray will find a token, or is configured to need none."""
    if os.environ.get("RAY_AUTH_MODE", "token").lower() != "token":
        return True
    if os.environ.get("RAY_AUTH_TOKEN"):
        return True
    path = os.environ.get("RAY_AUTH_TOKEN_PATH")
    return (Path(path) if path else Path.home() / ".ray" / "auth_token").is_file()


def explain_failure(address: str | None, error: BaseException) -> str:
    """Explain in one line why Ray could not be started (`address` None) or joined."""
    text = " ".join(str(error).split())
    if address is None:
        return f"Ray could not be started: {text}"
    if isinstance(error, ConnectionError):
        return (
            f"the Ray cluster at {address} answers, but refuses the connection. Most likely its "
            f"token is a different one: {TOKEN_HINT}"
        )
    return f"the Ray cluster at {address} could not be joined: {text}"
