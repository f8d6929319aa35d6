"""Answers of the server that come late, or in another order than they were asked for."""

import re

import pytest
from playwright.sync_api import Page, Route, expect

from tests.e2e.conftest import Site
from tests.e2e.test_form import EQUATIONS, opened, write_own

pytestmark = [pytest.mark.browser, pytest.mark.slow]


class Held:
    """Requests of a page that wait until they are let go, first come first."""

    def __init__(self, page: Page, pattern: str) -> None:
        self._page = page
        self._routes: list[Route] = []
        page.route(re.compile(pattern), self._hold)

    def _hold(self, route: Route) -> None:
        self._routes.append(route)

    def wait(self) -> None:
        """Until a request is there."""
        while not self._routes:
            self._page.wait_for_timeout(10)

    def let_go(self) -> None:
        """Answer the first request, and give the page the time to hear the answer."""
        self.wait()
        route = self._routes.pop(0)
        with self._page.expect_response(route.request.url) as answered:
            route.continue_()
        answered.value.finished()
        self._page.evaluate("() => new Promise((done) => setTimeout(done, 100))")


@pytest.mark.parametrize("path", ["/new/noise-sweep", "/new/reidentify"])
def test_a_model_chosen_before_does_not_replace_the_one_chosen_after(
    site: Site, page: Page, path: str
) -> None:
    first = Held(page, r"/v1/models/tube$")
    page.goto(f"{site.url}{path}")
    first.wait()
    page.locator("[name=model]").select_option("actuator")
    inertia = page.locator("[data-parameter=J]").first
    expect(inertia).to_be_attached()
    first.let_go()
    expect(inertia).to_be_attached()
    expect(page.locator("[data-parameter=K]")).to_have_count(0)


def test_nothing_can_be_typed_for_a_model_that_is_going_to_be_replaced(
    site: Site, page: Page
) -> None:
    page.goto(f"{site.url}/new/noise-sweep")
    expect(page.get_by_label(re.compile(r"^true K\b"))).to_be_visible()  # of the tube
    second = Held(page, r"/v1/models/fopdt$")
    page.locator("[name=model]").select_option("fopdt")
    expect(page.locator("[data-truth], [data-input], [data-parameter]")).to_have_count(0)
    second.let_go()
    expect(page.get_by_label(re.compile(r"^true K\b"))).to_be_visible()


def test_channels_follow_the_model_that_is_chosen_after_the_recordings(
    site: Site, page: Page
) -> None:
    page.goto(f"{site.url}/new/reidentify")
    expect(page.locator("[data-parameter=K]").first).to_be_attached()
    page.get_by_label("label of tube 40 m").fill("40")
    expect(page.get_by_label("output y")).to_be_visible()
    page.locator("[name=model]").select_option("actuator")
    expect(page.get_by_label("output theta")).to_be_visible()
    expect(page.get_by_label("output y")).to_have_count(0)


def test_the_form_shows_the_model_that_was_chosen_last(site: Site, page: Page) -> None:
    opened(site, page)
    first = Held(page, r"/v1/models/fopdt$")
    page.locator("[name=model]").select_option("fopdt")
    first.wait()
    page.locator("[name=model]").select_option("actuator")
    equations = page.get_by_label("equations in YAML")
    expect(equations).to_have_value(re.compile("actuator"))
    first.let_go()
    expect(equations).to_have_value(re.compile("actuator"))
    expect(page.locator("[data-parameter=J]").first).to_be_attached()


def test_an_answer_about_an_earlier_text_is_not_one_about_the_text_that_is_there(
    site: Site, page: Page
) -> None:
    opened(site, page)
    asked = Held(page, r"/v1/models:check$")
    write_own(page, EQUATIONS)
    asked.let_go()
    expect(page.locator("#check")).to_have_text("checking…")
    asked.let_go()
    expect(page.locator("#check")).to_contain_text("can be used")


def test_bounds_that_were_typed_outlive_a_change_of_the_equations(site: Site, page: Page) -> None:
    opened(site, page)
    write_own(page, EQUATIONS)
    expect(page.locator("#check")).to_contain_text("can be used")
    page.get_by_label("upper of L").fill("0.3")
    page.get_by_label("equations in YAML").fill(EQUATIONS.replace("K*u", "2*K*u"))
    expect(page.locator("#check")).to_have_text("the model can be used")
    expect(page.get_by_label("upper of L")).to_have_value("0.3")
