"""The web application on a port of loopback, in a thread of the tests' process."""

import faulthandler
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from fastapi import FastAPI

from service.api.connections import limit_connections
from sysid.core.awake_clock import read_awake_seconds
from tests.support.limits import LIMIT_SECONDS

REQUESTS_LIMIT_SECONDS = 10
"""How long a stopping server waits for requests that run, and for streams."""


@contextmanager
def serve_in_thread(
    app: FastAPI, bound: socket.socket | None = None, *, most_connections: int = 1000
) -> Iterator[str]:
    """Serve the application for the length of the block, at the address that is given.

    With a bound socket at its port; the server closes that socket. The server has ended when
    the block is left: another one at the same port must not share its connections with this one.
    """
    config = uvicorn.Config(
        app,
        host="127.0.0.1",
        port=0,
        log_level="error",
        ws="none",
        timeout_graceful_shutdown=REQUESTS_LIMIT_SECONDS,
    )
    limit_connections(config, most_connections)
    server = uvicorn.Server(config)
    sockets = None if bound is None else [bound]
    thread = threading.Thread(target=server.run, args=(sockets,), name="server")
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive()
            time.sleep(0.01)
        port = server.servers[0].sockets[0].getsockname()[1]
        yield f"http://127.0.0.1:{port}"
    finally:
        if hasattr(app.state, "parts"):
            app.state.parts.stopping.set()
        server.should_exit = True
        limit = read_awake_seconds() + LIMIT_SECONDS  # a suspended machine stops nothing
        while thread.is_alive() and read_awake_seconds() < limit:
            thread.join(timeout=1.0)
        assert not thread.is_alive(), f"the server did not stop\n{_describe_standing(server)}"


def _describe_standing(server: uvicorn.Server) -> str:
    """Describe what a server waits for: its connections and requests, and all threads."""
    state = server.server_state
    with tempfile.TemporaryFile("w+") as file:
        faulthandler.dump_traceback(file)
        file.seek(0)
        return f"{state.connections}\n{state.tasks}\n{file.read()}"
