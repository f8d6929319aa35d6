"""The pages in Chromium below the path of a proxy: forms, figures and events work there too."""

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from fastapi import FastAPI
from playwright.sync_api import Page, expect

from service.api.app import create_app
from tests.support.service.filled_folder import FilledFolder, copy_filled
from tests.support.service.web_app import settings_of
from tests.support.service.web_server import serve_in_thread

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture(scope="module")
def filled_folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FilledFolder]:
    folder = tmp_path_factory.mktemp("prefix")
    return folder, copy_filled(folder)


@pytest.fixture(scope="module")
def address(filled_folder: tuple[Path, FilledFolder]) -> Iterator[str]:
    """A server with the service below a path, and nothing beside it: all else is not found."""
    inner = create_app(settings_of(filled_folder[0], poll_seconds=0.05))

    @asynccontextmanager
    async def run(_: FastAPI) -> AsyncIterator[None]:
        async with inner.router.lifespan_context(inner):
            yield

    outer = FastAPI(lifespan=run, openapi_url=None)
    outer.mount("/tools/lagid", inner)
    with serve_in_thread(outer) as url:
        try:
            yield f"{url}/tools/lagid"
        finally:
            inner.state.parts.stopping.set()


def test_pages_work_below_the_path_of_a_proxy(
    address: str, filled_folder: tuple[Path, FilledFolder], scripted_page: Page
) -> None:
    page = scripted_page
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{address}/jobs/{filled_folder[1].finished}")
    page.locator('[data-figure="history"]').scroll_into_view_if_needed()
    page.wait_for_selector('[data-figure="history"] .main-svg')
    page.get_by_role("link", name="Clone").click()
    models = page.locator('select[name="model"] option')
    expect(models.filter(has_text="tube").first).to_be_attached()
    page.get_by_role("button", name="Identify").click()
    page.wait_for_url(f"{address}/jobs/job_*")
    expect(page.locator(".chip").first).to_have_text("queued")
    page.get_by_role("button", name="Cancel").click()  # its event refreshes the page
    expect(page.locator(".chip").first).to_have_text("cancelled")
    assert [url for url in asked if not url.startswith((address, "data:", "blob:"))] == []


def test_items_are_found_edited_and_deleted_below_the_path(
    address: str, filled_folder: tuple[Path, FilledFolder], scripted_page: Page
) -> None:
    page = scripted_page
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{address}/jobs/{filled_folder[1].failed}")
    page.get_by_role("button", name="Edit").first.click()
    dialog = page.get_by_role("dialog", name="Edit the job")
    dialog.get_by_label("Tags").fill("suspect")
    dialog.get_by_role("button", name="Save").click()
    expect(page.locator(".annotations .tag")).to_have_text("suspect")
    page.goto(f"{address}/")
    page.get_by_text("Filter", exact=True).first.click()
    form = page.get_by_role("search")
    form.get_by_label("Tag").fill("suspect")
    form.get_by_role("button", name="Filter").click()
    expect(page.locator("table.jobs tbody tr")).to_have_count(1)
    page.locator("table.jobs tbody a.name").click()
    page.wait_for_load_state("networkidle")  # no figure of what is deleted is on its way
    page.get_by_role("button", name="Delete").first.click()
    dialog = page.get_by_role("dialog", name="Delete the job")
    dialog.get_by_role("button", name="Delete").click()
    expect(page).to_have_url(f"{address}/")
    assert [url for url in asked if not url.startswith((address, "data:", "blob:"))] == []
