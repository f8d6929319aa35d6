"""`lagid health`: whether a process of the service runs on this machine, for container engines."""

import os
import socket
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.common import AsJson, out, print_json
from service.cli.server_processes import load_settings, open_database
from service.core.errors import Unavailable

if TYPE_CHECKING:
    from service.core.settings import Settings

ANSWER_SECONDS = 5.0
RAY_SOCKET = Path("ray/session_latest/sockets/raylet")
_ANY_ADDRESS = ("0.0.0.0", "::", "")


class Part(StrEnum):
    """A process of the service."""

    WEB = "web"
    DISPATCHER = "dispatcher"
    RAY = "ray"


def check_health(
    part: Annotated[Part, typer.Argument(help="Process that should run here.")],
    host: Annotated[str | None, typer.Option(help="Host of the web process.")] = None,
    port: Annotated[int | None, typer.Option(help="Port of the web process.")] = None,
    as_json: AsJson = False,
) -> None:
    """Check that a process of the service runs on this machine; exit code 1 if not.

    A dispatcher that still starts is alive.
    """
    settings = load_settings(host=host, port=port)
    match part:
        case Part.WEB:
            found = _check_web(settings)
        case Part.DISPATCHER:
            found = _check_dispatcher(settings)
        case Part.RAY:
            found = _check_ray(Path(os.environ.get("RAY_TMPDIR", "/tmp")) / RAY_SOCKET)
    if as_json:
        print_json({"part": part.value, "detail": found})
    else:
        out.print(found, markup=False, soft_wrap=True)


def _check_web(settings: "Settings") -> str:
    import httpx

    host = "127.0.0.1" if settings.host in _ANY_ADDRESS else settings.host
    url = f"http://{f'[{host}]' if ':' in host else host}:{settings.port}/healthz"
    try:
        httpx.get(url, timeout=ANSWER_SECONDS, trust_env=False).raise_for_status()
    except httpx.HTTPError as error:
        raise Unavailable(f"{url} does not answer as it should: {error}") from error
    return f"{url} answers"


def _check_dispatcher(settings: "Settings") -> str:
    """Look for the heartbeat of a dispatcher of this host; each container has its own name."""
    from service.queue.dispatchers import DispatcherRepository, describe_start

    name = socket.gethostname()
    with open_database(settings) as database, database.read_session() as session:
        alive = DispatcherRepository(session).list_alive()
    for one in alive:
        if one.details.get("host") == name:
            return describe_start(one) or f"{one.owner} is ready"
    raise Unavailable(f"no dispatcher of the host {name} has sent a heartbeat within its lease")


def _check_ray(path: Path) -> str:
    with socket.socket(socket.AF_UNIX) as raylet:
        raylet.settimeout(ANSWER_SECONDS)
        try:
            raylet.connect(str(path))
        except OSError as error:
            raise Unavailable(f"Ray does not answer at {path} ({error.strerror})") from error
    return f"Ray answers at {path}"
