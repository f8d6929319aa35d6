"""Answers of the server that come late, or in another order than they were asked for."""

import re
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import BrowserContext, Page, Request, Route, expect

from service.repositories.job_rows import JobRepository
from tests.e2e.conftest import Site
from tests.e2e.test_form import EQUATIONS, open_form, write_own
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.filled_folder import MODEL, end_running, progress

pytestmark = [pytest.mark.browser, pytest.mark.slow]


class HeldAnswer:
    """Requests of a page that wait until they are let go, first come first."""

    def __init__(self, page: Page, pattern: str) -> None:
        self._page = page
        self._routes: list[Route] = []
        self._pattern = re.compile(pattern)
        page.route(self._pattern, self._hold)

    def _hold(self, route: Route) -> None:
        self._routes.append(route)

    def wait(self) -> None:
        """Until a request is there."""
        while not self._routes:
            self._page.wait_for_timeout(10)

    def stop(self) -> None:
        """Hold no more."""
        self._page.unroute(self._pattern)

    def answer(self) -> None:
        """Answer the first request; the page may go elsewhere by it."""
        self.wait()
        self._routes.pop(0).continue_()

    def let_go(self) -> None:
        """Answer the first request, and give the page the time to hear the answer."""
        self.wait()
        with self._page.expect_response(self._routes[0].request.url) as answered:
            self.answer()
        answered.value.finished()
        self._page.evaluate("() => new Promise((done) => setTimeout(done, 100))")


@pytest.mark.parametrize("path", ["/new/noise-sweep", "/new/reidentify"])
def test_a_model_chosen_before_does_not_replace_the_one_chosen_after(
    site: Site, page: Page, path: str
) -> None:
    first = HeldAnswer(page, r"/v1/models/tube$")
    page.goto(f"{site.url}{path}")
    first.wait()
    page.locator("select[name=model]").select_option("actuator")
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
    second = HeldAnswer(page, r"/v1/models/fopdt$")
    page.locator("select[name=model]").select_option("fopdt")
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
    page.locator("select[name=model]").select_option("actuator")
    expect(page.get_by_label("output theta")).to_be_visible()
    expect(page.get_by_label("output y")).to_have_count(0)


def test_the_form_shows_the_model_that_was_chosen_last(site: Site, page: Page) -> None:
    open_form(site, page)
    first = HeldAnswer(page, r"/v1/models/sopdt$")
    page.locator("select[name=model]").select_option("sopdt")
    first.wait()
    page.locator("select[name=model]").select_option("actuator")
    equations = page.get_by_label("equations in YAML")
    expect(equations).to_have_value(re.compile("actuator"))
    first.let_go()
    expect(equations).to_have_value(re.compile("actuator"))
    expect(page.locator("[data-parameter=J]").first).to_be_attached()


def test_an_upload_that_ends_late_neither_selects_itself_nor_reports(
    own_site: Site, page: Page, tmp_path: Path
) -> None:
    good, bad = tmp_path / "good.csv", tmp_path / "bad.csv"
    good.write_text("t,u,y\n" + "".join(f"{n / 10},{n % 2},{n}\n" for n in range(20)))
    bad.write_text("t,u,y\n0,1,2\n0.1,oops,2\n0.2,1,2\n")
    open_form(own_site, page)
    uploads = HeldAnswer(page, r"/v1/datasets\?name=")
    chosen, facts = page.locator("[name=dataset]"), page.locator("#dataset-facts")
    for late in (bad, good):
        page.get_by_label("or upload a recording").set_input_files(late)
        uploads.wait()
        chosen.select_option(own_site.filled.dataset)  # the user has chosen otherwise
        expect(facts).to_contain_text("P1")
        uploads.let_go()
        expect(facts).to_contain_text("P1")
        expect(page.locator('[data-fault="/datasets"]')).to_be_empty()
        expect(page.locator("#upload-state")).to_be_empty()
    page.get_by_label("or upload a recording").set_input_files(bad)
    uploads.wait()
    page.get_by_label("or upload a recording").set_input_files(good)
    uploads.let_go()
    uploads.let_go()
    expect(page.locator("#upload-state")).to_contain_text("good.csv is stored")
    expect(page.locator('[data-fault="/datasets"]')).to_be_empty()


def test_an_answer_about_an_earlier_text_is_not_one_about_the_text_that_is_there(
    site: Site, page: Page
) -> None:
    open_form(site, page)
    asked = HeldAnswer(page, r"/v1/models:check$")
    write_own(page, EQUATIONS)
    asked.let_go()
    expect(page.locator("#check")).to_have_text("checking…")
    asked.let_go()
    expect(page.locator("#check")).to_contain_text("the model is valid")


def test_bounds_that_were_typed_outlive_a_change_of_the_equations(site: Site, page: Page) -> None:
    open_form(site, page)
    write_own(page, EQUATIONS)
    expect(page.locator("#check")).to_contain_text("the model is valid")
    page.get_by_label("upper of L").fill("0.3")
    page.get_by_label("equations in YAML").fill(EQUATIONS.replace("K*u", "2*K*u"))
    expect(page.locator("#check")).to_have_text("the model is valid")
    expect(page.get_by_label("upper of L")).to_have_value("0.3")


def test_a_cloned_request_cannot_be_sent_before_all_of_it_is_there(
    own_site: Site, page: Page
) -> None:
    body = {
        "model": MODEL,
        "datasets": [own_site.filled.dataset],
        "channels": {"u": "P1", "p": "P2"},
        "parameters": {"L": {"upper": 0.3}},
    }
    job = httpx.post(f"{own_site.url}/v1/jobs", json=body, timeout=LIMIT_SECONDS).json()["id"]
    check = HeldAnswer(page, r"/v1/models:check$")
    page.goto(f"{own_site.url}/?clone={job}#new")
    check.wait()
    button = page.locator("#job-form [type=submit]")
    button.scroll_into_view_if_needed()
    place = button.bounding_box()
    assert place is not None
    page.mouse.click(place["x"] + place["width"] / 2, place["y"] + place["height"] / 2)
    check.let_go()
    expect(page.get_by_label("upper of L")).to_have_value("0.3")
    check.stop()
    button.click()
    page.wait_for_url(re.compile(r"/jobs/job_"))
    with own_site.parts.database.read_session() as session:
        spec = JobRepository(session).get(page.url.rsplit("/", 1)[1]).spec
    assert spec["parameters"] == body["parameters"]


def test_a_request_waits_for_the_model_that_was_chosen(own_site: Site, scripted_page: Page) -> None:
    page = scripted_page
    open_form(own_site, page)
    page.locator("[name=dataset]").select_option(own_site.filled.dataset)
    expect(page.locator("[data-signal]").first).to_be_attached()
    sent: list[Request] = []
    page.on("request", lambda one: sent.append(one) if one.method == "POST" else None)
    model = HeldAnswer(page, r"/v1/models/sopdt$")
    page.locator("select[name=model]").select_option("sopdt")
    model.wait()
    page.locator("#job-form [type=submit]").click()
    page.wait_for_timeout(200)
    assert not sent
    model.answer()
    page.wait_for_url(re.compile(r"/jobs/job_"))
    assert sent[0].post_data_json["model"] == "sopdt"
    assert set(sent[0].post_data_json["channels"]) == {"u", "y"}


LIVE = "new URL('live.js', document.querySelector('script[type=module]').src)"


def test_a_page_that_comes_late_does_not_bring_back_what_was(own_site: Site, page: Page) -> None:
    job = own_site.filled.failed
    page.goto(f"{own_site.url}/jobs/{job}")  # it has no stream: nothing else is asked for
    asked: list[Route] = []

    def hold_first(route: Route) -> None:
        asked.append(route)
        if len(asked) > 1:
            route.continue_()

    page.route(f"**/jobs/{job}", hold_first)
    refresh = f"async () => {{ const {{ refresh }} = await import({LIVE}); await refresh(); }}"
    page.evaluate(f"() => {{ window.first = ({refresh})(); }}")
    while not asked:
        page.wait_for_timeout(10)
    earlier = asked[0].fetch()
    with own_site.parts.database.write_session() as session:
        JobRepository(session).resume(job)
    page.evaluate(refresh)
    chip = page.locator("#job .chip")
    expect(chip).to_have_text("queued")
    asked[0].fulfill(response=earlier)
    page.evaluate("() => window.first")
    expect(chip).to_have_text("queued")


@pytest.mark.parametrize("refused", ["jobs/{job}", "v1/jobs/{job}/events"])
def test_a_page_is_fresh_again_after_the_server_was_away(
    own_site: Site, browser_context: BrowserContext, refused: str
) -> None:
    job, database = own_site.filled.running, own_site.parts.database
    page = browser_context.new_page()  # of its own: what fails is told on the console
    page.goto(f"{own_site.url}/jobs/{job}")
    expect(page.locator("#job .chip")).to_have_text("running")
    times = iter(range(2))

    def is_away(route: Route) -> None:
        route.continue_() if next(times, None) is None else route.fulfill(status=503)

    page.route("**/" + refused.format(job=job), is_away)
    if "events" in refused:
        page.reload()
    progress(database, own_site.filled.lease, own_site.filled.running_run, 180)
    expect(page.locator('[data-live="head"]')).to_contain_text("generation 180")
    end_running(database, own_site.parts.store, own_site.filled.lease)
    expect(page.locator("#job .chip")).to_have_text("succeeded")
    page.close()
