"""A server over a filled data folder, and Chromium to look at its pages."""

import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import (
    Browser,
    BrowserContext,
    ConsoleMessage,
    Error,
    Page,
    ViewportSize,
    expect,
    sync_playwright,
)

from service.api.app import create_app
from service.api.requests.dependencies import Parts
from tests.support.limits import LIMIT_SECONDS
from tests.support.requirements import report_missing
from tests.support.service.filled_folder import FilledFolder, copy_filled
from tests.support.service.web_app import settings_of
from tests.support.service.web_server import serve_in_thread

CHROMIUM = Path("/usr/bin/chromium")
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--host-resolver-rules=MAP *.test 127.0.0.1",  # names that were rebound to this machine
    "--process-per-site",  # one process for all tabs: it keeps compiled scripts
]

VIEWPORT: ViewportSize = {"width": 1280, "height": 900}
REFUSED = re.compile("status of (409|412|422)")
"""Answers to what a user may try; the page explains them."""
LIMIT_MILLISECONDS = 1000 * LIMIT_SECONDS
"""The same of a page that shows something."""


@dataclass(frozen=True)
class Server:
    """A running server and its parts."""

    url: str
    parts: Parts


@dataclass(frozen=True)
class Site(Server):
    """The same, and what its data folder holds."""

    filled: FilledFolder


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """The service over a data folder that was used for a while, only to be looked at."""
    with _serve_filled(tmp_path_factory.mktemp("site")) as served:
        yield served


@pytest.fixture(scope="session")
def listener() -> Iterator[socket.socket]:
    """The port of all own sites, one after the other.

    Compiled scripts are kept by address. Compiling Plotly takes two seconds.
    """
    with socket.create_server(("127.0.0.1", 0)) as bound:
        yield bound


@pytest.fixture
def own_site(tmp_path: Path, listener: socket.socket) -> Iterator[Site]:
    """The same, for a test that changes something."""
    with _serve_filled(tmp_path, listener.dup()) as served:
        yield served


@contextmanager
def _serve_filled(folder: Path, bound: socket.socket | None = None) -> Iterator[Site]:
    filled = copy_filled(folder)
    with serve_folder(folder, bound) as server:
        yield Site(server.url, server.parts, filled)


@contextmanager
def serve_folder(
    folder: Path, bound: socket.socket | None = None, **changes: object
) -> Iterator[Server]:
    """The service over a data folder, at a bound socket, which it closes, or a port of its own."""
    app = create_app(settings_of(folder, poll_seconds=0.05, **changes))
    with serve_in_thread(app, bound) as url:
        yield Server(url, app.state.parts)


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Headless Chromium of the system."""
    if not CHROMIUM.exists():
        report_missing("browser", f"there is no Chromium at {CHROMIUM}")
    expect.set_options(timeout=LIMIT_MILLISECONDS)
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield opened
        opened.close()


@pytest.fixture(scope="session")
def browser_context(browser: Browser, site: Site) -> Iterator[BrowserContext]:
    """What all tabs share: the cache. The pages store nothing in the browser."""
    with browser.new_context(viewport=VIEWPORT) as context:
        context.set_default_timeout(LIMIT_MILLISECONDS)
        context.new_page().goto(f"{site.url}/static/lagid.svg")  # it keeps the process of all tabs
        yield context
        assert context.storage_state() == {"cookies": [], "origins": []}


@pytest.fixture(scope="session")
def tab(browser_context: BrowserContext) -> Page:
    """The tab that tests use one after the other: opening one costs a fifth of a second."""
    return browser_context.new_page()


@pytest.fixture
def page(tab: Page) -> Iterator[Page]:
    """A tab in which nothing may go wrong, blank and of the usual size."""
    with watch_tab(tab):
        yield tab


@pytest.fixture
def scripted_page(browser_context: BrowserContext) -> Iterator[Page]:
    """Such a tab of the test's own, for scripts and listeners, which stay in a tab."""
    with browser_context.new_page() as tab, watch_tab(tab):
        yield tab


@contextmanager
def watch_tab(tab: Page) -> Iterator[None]:
    """Fail the test after an error on the console of the tab; leave the tab as it was.

    Each step is undone, even if another one fails.
    """
    wrong: list[str] = []

    def note(message: ConsoleMessage) -> None:
        # The browser itself reports every refused request; those of the form are meant to be.
        if message.type == "error" and not REFUSED.search(message.text):
            wrong.append(message.text)

    def note_error(error: Error) -> None:
        wrong.append(str(error))

    with ExitStack() as undo:
        undo.callback(tab.set_viewport_size, VIEWPORT)
        undo.callback(tab.emulate_media, media="null", color_scheme="null")
        undo.callback(tab.unroute_all)
        tab.on("console", note)
        undo.callback(tab.remove_listener, "console", note)
        tab.on("pageerror", note_error)
        undo.callback(tab.remove_listener, "pageerror", note_error)
        undo.callback(tab.goto, "about:blank")  # it asks no server any more
        yield
    assert wrong == []
