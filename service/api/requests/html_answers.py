"""Answer with HTML pages, also for errors; a policy limits what the browser may load."""

from collections.abc import Mapping, Sequence

from fastapi import Request
from fastapi.responses import HTMLResponse

from service.api.requests.request_root_path import get_service_path
from service.core.errors import FieldError
from service.pages.render import render_template

PROGRAM_PATHS = ("/v1/", "/static/", "/pages/", "/healthz", "/readyz", "/metrics", "/openapi.json")
"""Paths, or their prefixes, that programs and scripts request."""
PROTECTIVE_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Headers of every answer: no guessed media type, and no use inside pages of other origins."""
PRIVATE_HEADERS = {"Cache-Control": "private, no-cache"}
"""Headers of every answer where keys are asked for: no cache gives it to another caller."""
# Scripts and data come from this server only. Plotly styles its own elements, hence the inline
# styles. It writes pictures for download through blob: and data: addresses.
PAGE_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data: blob:; connect-src 'self'; form-action 'self'; base-uri 'none'; "
        "frame-ancestors 'none'"
    ),
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class HtmlPage(HTMLResponse):
    """An HTML page with its content security policy."""

    def __init__(
        self, content: str, status: int = 200, headers: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(content, status, headers={**PAGE_HEADERS, **(headers or {})})


def wants_html(request: Request) -> bool:
    """Whether a browser requests a page; an error is then shown as a page."""
    accepted = request.headers.get("accept", "")
    path = get_service_path(request.scope)
    is_page = request.method in ("GET", "HEAD") and not path.startswith(PROGRAM_PATHS)
    return is_page and "text/html" in accepted


def error_page(
    status: int, title: str, detail: str, errors: Sequence[FieldError], headers: Mapping[str, str]
) -> HtmlPage:
    """Render an error as a page, in the words of the problem document."""
    lines = [str(error).removeprefix("?") for error in errors] or [detail]
    return HtmlPage(
        render_template("error.html", status=status, title=title, lines=lines), status, headers
    )
