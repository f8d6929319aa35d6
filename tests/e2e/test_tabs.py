"""The tab that tests share is as it was after each test, even after one that failed."""

import ast

import pytest
from playwright.sync_api import BrowserContext, Error, Page

from tests.e2e.conftest import VIEWPORT, watch_tab
from tests.support.checkout import ROOT


def change_tab(tab: Page) -> None:
    tab.set_viewport_size({"width": 400, "height": 300})
    tab.emulate_media(media="print")
    tab.route("**/*", lambda route: route.abort())
    tab.evaluate("console.error('broken')")


@pytest.mark.browser
@pytest.mark.slow
def test_a_tab_is_as_it_was_after_an_error_on_its_console(browser_context: BrowserContext) -> None:
    with browser_context.new_page() as tab:
        with pytest.raises(AssertionError, match="broken"), watch_tab(tab):
            change_tab(tab)
        assert tab.viewport_size == VIEWPORT
        assert not tab.evaluate("matchMedia('print').matches")
        assert tab.url == "about:blank"


@pytest.mark.browser
@pytest.mark.slow
def test_nothing_listens_to_a_tab_that_could_not_be_left(
    browser_context: BrowserContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    with browser_context.new_page() as tab:
        removed: list[str] = []

        def fail(url: str) -> None:
            raise Error(f"no way to {url}")

        monkeypatch.setattr(tab, "goto", fail)
        monkeypatch.setattr(tab, "remove_listener", lambda event, _: removed.append(event))
        with pytest.raises(Error, match="no way"), watch_tab(tab):
            tab.set_viewport_size({"width": 400, "height": 300})
        assert sorted(removed) == ["console", "pageerror"]
        assert tab.viewport_size == VIEWPORT


def test_no_test_listens_to_the_tab_that_tests_share() -> None:
    listening = [
        f"{path.name}: {function.name}"
        for path in sorted((ROOT / "tests" / "e2e").glob("test_*.py"))
        for function in ast.walk(ast.parse(path.read_text()))
        if isinstance(function, ast.FunctionDef)
        and any(one.arg == "page" for one in function.args.args)
        and "page.on(" in ast.unparse(function)
    ]
    assert listening == []
