"""A browser at a service that asks for keys: sign in, live pages, keys, sign out."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from service.access.keys import create_key
from service.storage.tables import DEFAULT_PROJECT
from tests.e2e.conftest import LIMIT_MILLISECONDS, Site, serve_folder
from tests.support.service.filled_folder import copy_filled, progress

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture
def guarded_site(tmp_path: Path) -> Iterator[Site]:
    """A filled service that asks for keys."""
    filled = copy_filled(tmp_path)
    with serve_folder(tmp_path, auth="keys") as server:
        yield Site(server.url, server.parts, filled)


@pytest.fixture
def visitor(browser: Browser) -> Iterator[Page]:
    """A tab of a browser without cookies; no script may fail in it."""
    with browser.new_context() as context:
        context.set_default_timeout(LIMIT_MILLISECONDS)
        page = context.new_page()
        wrong: list[str] = []
        page.on("pageerror", lambda error: wrong.append(str(error)))
        yield page
        assert wrong == []


def make_key(site: Site, scope: str) -> str:
    with site.parts.database.write_session() as session:
        return create_key(session, DEFAULT_PROJECT, f"a {scope} key", scope).token  # type: ignore[arg-type]


def test_a_visitor_signs_in_follows_a_job_and_signs_out(guarded_site: Site, visitor: Page) -> None:
    site, filled = guarded_site, guarded_site.filled
    visitor.goto(f"{site.url}/jobs/{filled.running}")
    expect(visitor.get_by_role("heading", name="Sign in")).to_be_visible()
    visitor.get_by_label("API key").fill("lagid_wrong_key")
    visitor.get_by_role("button", name="Sign in").click()
    expect(visitor.get_by_role("alert")).to_contain_text("is unknown, has expired")
    visitor.get_by_label("API key").fill(make_key(site, "write"))
    visitor.get_by_role("button", name="Sign in").click()
    visitor.wait_for_url(f"{site.url}/jobs/{filled.running}")
    (cookie,) = visitor.context.cookies()
    assert (cookie["httpOnly"], cookie["sameSite"], cookie["secure"]) == (True, "Strict", False)
    assert visitor.evaluate("document.cookie") == ""
    visitor.wait_for_selector('[data-figure="history"] .main-svg')
    progress(site.parts.database, filled.lease, filled.running_run, 180)
    expect(visitor.locator('[data-live="head"]')).to_contain_text("generation 180")
    assert visitor.get_by_role("link", name="Keys").count() == 0
    visitor.get_by_role("button", name="Sign out").click()
    visitor.wait_for_url(f"{site.url}/sign-in")
    assert visitor.context.cookies() == []
    visitor.goto(f"{site.url}/datasets")
    expect(visitor.get_by_role("heading", name="Sign in")).to_be_visible()


def test_an_admin_makes_a_key_which_is_shown_once_and_revokes_it(
    guarded_site: Site, visitor: Page, tmp_path: Path
) -> None:
    visitor.goto(f"{guarded_site.url}/keys")
    visitor.get_by_label("API key").fill(make_key(guarded_site, "admin"))
    visitor.get_by_role("button", name="Sign in").click()
    visitor.get_by_label("Name").fill("<b>dashboard</b>")
    visitor.get_by_label("Scope").select_option("read")
    visitor.get_by_label("Days until it ends").fill("30")
    visitor.get_by_role("button", name="Create").click()
    token = visitor.locator("pre.key").inner_text().strip()
    assert token.startswith("lagid_")
    visitor.set_viewport_size({"width": 420, "height": 800})
    visitor.wait_for_function("document.documentElement.scrollWidth <= innerWidth")
    visitor.get_by_text("Menu", exact=True).click()
    visitor.get_by_role("link", name="Keys").click()
    assert token not in visitor.content()
    row = visitor.get_by_role("row").filter(has_text="<b>dashboard</b>")
    expect(row).to_contain_text("valid")
    row.get_by_role("button", name="Revoke").click()
    expect(row).to_contain_text("revoked")
    expect(row.get_by_role("button")).to_have_count(0)
