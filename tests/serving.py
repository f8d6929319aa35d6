"""The web application on a port of loopback, in a thread of the tests' process."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from fastapi import FastAPI

STOP_LIMIT_SECONDS = 20.0


@contextmanager
def serve_in_thread(app: FastAPI) -> Iterator[str]:
    """Serve the application for the length of the block, at the address that is given."""
    config = uvicorn.Config(app, host="127.0.0.1", port=0, log_level="error", ws="none")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, name="server")
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
        thread.join(timeout=STOP_LIMIT_SECONDS)
