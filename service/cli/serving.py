"""`lagid serve` and `lagid dispatcher`."""

import errno
import signal
import socket
import threading
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.common import out
from service.errors import Misconfigured

if TYPE_CHECKING:
    from fastapi import FastAPI

    from service.settings import Settings
    from service.supervision import Supervisor

CLOSE_S = 3  # what an open answer may take once the process is asked to end

Host = Annotated[str | None, typer.Option(help="Address to listen on.")]
Port = Annotated[int | None, typer.Option(min=0, max=65535, help="Port; 0 for any free one.")]
DataDir = Annotated[Path | None, typer.Option(help="Folder of database, objects and logs.")]
Cpus = Annotated[int | None, typer.Option(min=1, help="Cores for the workers.")]


def serve(
    host: Host = None,
    port: Port = None,
    data_dir: DataDir = None,
    cpus: Cpus = None,
    with_dispatcher: Annotated[
        bool,
        typer.Option("--dispatcher/--no-dispatcher", help="Keep a dispatcher running beside it."),
    ] = True,
) -> None:
    """Serve REST and pages, with a dispatcher beside (defaults from LAGID_… variables)."""
    settings = settings_of(host=host, port=port, data_dir=data_dir, cpus=cpus)
    settings.check_exposure()
    settings.prepare_folder()
    with listening(settings.host, settings.port) as listener:
        from service.supervision import supervised_dispatcher

        _end_on_signals()
        child: AbstractContextManager[Supervisor | None] = nullcontext()
        if with_dispatcher:
            child = supervised_dispatcher(settings)
        with child as supervisor:  # the dispatcher starts beside all that follows
            _try_storage(settings)
            from service.app import create_app

            bound = listener.getsockname()[1]
            folder = settings.data_dir.absolute()
            out.print(f"lagid serves http://{settings.host}:{bound}/ (data in {folder}); "
                      "Ctrl-C ends it", soft_wrap=True)  # fmt: skip
            _run(create_app(settings), listener, supervisor)


def dispatcher(data_dir: DataDir = None, cpus: Cpus = None) -> None:
    """Claim jobs and have them computed, until told to end (`serve` starts one by itself)."""
    settings = settings_of(data_dir=data_dir, cpus=cpus)
    settings.prepare_folder()
    from service.dispatcher_process import run

    raise typer.Exit(run(settings))


def settings_of(**given: Any) -> "Settings":
    """Settings of the environment, with the options that were given.

    Raises
    ------
    Misconfigured
        If one cannot be used; the message names its variable.
    """
    from pydantic import ValidationError

    from service.sentences import detail_of
    from service.settings import Settings

    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        name = "_".join(str(part) for part in first["loc"]).upper()
        raise Misconfigured(f"LAGID_{name}: {detail_of(first, ())}") from None


def listening(host: str, port: int) -> socket.socket:
    """A socket that listens there.

    Raises
    ------
    Misconfigured
        If the port is in use, not allowed, or the host has no such address.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind, protocol)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(128)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise Misconfigured(
                f"port {port} of {host} is in use; choose another with --port, or --port 0"
            ) from None
        raise Misconfigured(f"cannot listen on {host}:{port}: {error.strerror}") from None
    return listener


def _run(app: "FastAPI", listener: socket.socket, supervisor: "Supervisor | None") -> None:
    import uvicorn

    class Server(uvicorn.Server):
        """Tells open event streams and the dispatcher at once that the process is to end."""

        def handle_exit(self, sig: int, frame: FrameType | None) -> None:
            if supervisor is not None:
                threading.Thread(target=supervisor.stop, name="end").start()
            parts = getattr(app.state, "parts", None)
            if parts is not None:
                parts.stopping.set()
            super().handle_exit(sig, frame)

    config = uvicorn.Config(
        app, log_level="warning", access_log=False, timeout_graceful_shutdown=CLOSE_S
    )
    Server(config).run(sockets=[listener])


def _try_storage(settings: "Settings") -> None:
    """Open database and objects once, so that what cannot be opened is told in one line.

    Raises
    ------
    Misconfigured, StorageError
        If one cannot be opened.
    """
    from sqlalchemy.exc import SQLAlchemyError

    from service.opening import open_storage

    try:
        database, _ = open_storage(settings)
    except SQLAlchemyError as error:
        reason = str(error).splitlines()[0]
        raise Misconfigured(
            f"the database cannot be opened: {reason}; is its server running, and is "
            "LAGID_DATABASE_URL right?"
        ) from None
    database.dispose()


def _end_on_signals() -> None:
    """End by an exception, so that what is open is closed; uvicorn raises the signal again."""

    def end(_signal: int, _frame: FrameType | None) -> None:
        raise SystemExit(0)

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)
