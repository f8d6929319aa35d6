"""Find the root path of a request, for a service behind a proxy."""

from starlette.types import ASGIApp, Receive, Scope, Send

from service.core.root_path import set_root_path


def get_service_path(scope: Scope) -> str:
    """Return the path of a request below the root path."""
    path: str = scope["path"]
    rest = path.removeprefix(scope.get("root_path", ""))
    return rest if rest.startswith("/") else path if rest else "/"


class RootPath:
    """Middleware that finds the path under which a proxy publishes the service.

    The server knows it (``uvicorn --root-path``), or `default` names it (``LAGID_ROOT_PATH``). A
    proxy may send the path with or without it; afterwards ``scope["path"]`` has it.
    """

    def __init__(self, app: ASGIApp, default: str) -> None:
        self._app, self._default = app, default

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Set the root path and pass the request on."""
        if scope["type"] == "http":
            root = (scope.get("root_path") or self._default).rstrip("/")
            scope["root_path"] = root
            scope["path"] = root + get_service_path(scope)
            set_root_path(root)
        await self._app(scope, receive, send)
