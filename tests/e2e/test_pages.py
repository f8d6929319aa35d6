"""The pages in Chromium: what they show, what they do live, what they must never do."""

import itertools
import re
from typing import Literal

import pytest
from playwright.sync_api import Page, expect

from service.core.states import JobState
from service.queue.leases import LeaseQueue
from service.queue.queue_state import read_queue_state
from service.repositories.job_rows import JobRepository
from sysid.figures.theme import plotly_template
from tests.e2e.conftest import Site
from tests.support.service.filled_folder import TRUE, end_running, progress

pytestmark = [pytest.mark.browser, pytest.mark.slow]

LINES = ".scatterlayer .trace"
REASON = "the model diverges everywhere"


def figure(page: Page, name: str) -> str:
    """Wait for a plot and give its selector."""
    page.locator(f'[data-figure="{name}"]').scroll_into_view_if_needed()
    page.wait_for_selector(f'[data-figure="{name}"] .main-svg')
    return f'[data-figure="{name}"]'


def test_the_list_shows_every_job_with_state_rms_and_unit(site: Site, page: Page) -> None:
    page.goto(site.url)
    rows = page.locator("table.jobs tbody tr")
    expect(rows).to_have_count(5)
    expect(rows.locator(".chip")).to_have_text(
        ["queued", "running", "failed", "succeeded", "succeeded"]
    )
    expect(rows.nth(4)).to_contain_text(re.compile(r"0\.4200\s*kPa"))


def test_the_list_is_filtered_by_state(site: Site, page: Page) -> None:
    page.goto(site.url)
    page.get_by_role("link", name="failed", exact=True).click()
    expect(page.locator("table.jobs tbody tr")).to_have_count(1)
    expect(page.locator("table.jobs")).to_contain_text("a model that diverges")


def test_a_finished_job_shows_its_estimates_plots_and_residual_tests(
    site: Site, scripted_page: Page
) -> None:
    page = scripted_page
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.emulate_media(color_scheme="light")
    page.goto(f"{site.url}/jobs/{site.filled.finished}")
    height = "document.documentElement.scrollHeight"
    before = page.evaluate(height)
    rows = page.locator("table.estimates tbody tr")
    expect(rows).to_have_count(len(TRUE))
    expect(rows.nth(1)).to_have_text(
        re.compile(r"T\s*0\.34890\s*0\.3\d+ … 0\.3.*0\.00041\s*s.*identified", re.S)
    )
    assert page.locator(f"{figure(page, 'history')} {LINES}").count() >= 4
    assert page.locator(f"{figure(page, 'convergence')} {LINES}").count() == 4 * len(TRUE)
    assert page.locator(f"{figure(page, 'response')} {LINES}").count() == 8
    expect(page.locator('.modebar-btn[data-title^="Share"]')).to_have_count(0)  # to a cloud
    assert page.locator(f"{figure(page, 'residuals')} .barlayer .trace").count() == 2
    assert page.locator(f"{figure(page, 'correlation')} .hm").count() == 1
    assert page.locator(f"{figure(page, 'waterfall')} {LINES}").count() == 2
    corner = figure(page, "posterior")
    assert page.locator(f"{corner} .contourlayer .contour").count() == 3
    assert page.locator(f"{corner} .barlayer .trace").count() == 3
    expect(page.locator("table.posterior tbody tr").nth(1)).to_contain_text("1\u202f712")
    assert page.evaluate(height) == before  # plots take the room that was left for them
    expect(page.get_by_text("have the correlation −0.78")).to_be_visible()
    assert_residual_tests(page)
    assert red_of(page) <= 128  # dark letters on a light page
    assert [url for url in asked if url.endswith("/events")] == []  # nothing more is to come
    assert [url for url in asked if not url.startswith(site.url)] == []


def assert_residual_tests(page: Page) -> None:
    """Bands and verdicts of the residual tests."""
    rows = page.locator("table.tests tbody tr")
    expect(rows).to_have_count(2)
    expect(rows.nth(0)).to_have_text(re.compile(r"p\s*white.*passed", re.S))
    expect(rows.nth(1)).to_have_text(re.compile(r"independent of u.*passed", re.S))
    plot = page.locator(figure(page, "residuals"))
    bars = "plot => plot.data.filter(one => one.type === 'bar').map(one => one.x.length)"
    assert plot.evaluate(bars) == [25, 51]  # lags 1 … 25, and -25 … 25
    outside = (
        "plot => plot.data.filter(one => one.name === '95 % band')"
        ".every(one => one.y.every(value => Math.abs(value) < 0.2))"
    )
    assert plot.evaluate(outside)
    expect(page.locator("dl.evidence")).to_contain_text("T + L = 0.46160 ± 0.00014")
    expect(page.locator("dl.evidence")).to_contain_text("Onset delay, p behind u")


def red_of(page: Page) -> int:
    """How much red a title of the history's plot has."""
    title = page.locator(f"{figure(page, 'history')} .xtitle")
    return int(re.findall(r"\d+", title.evaluate("node => getComputedStyle(node).fill"))[0])


def test_plots_of_a_finished_job_follow_the_keyboard_the_scheme_and_the_wish_for_profiles(
    site: Site, page: Page
) -> None:
    page.emulate_media(color_scheme="dark")
    page.goto(f"{site.url}/jobs/{site.filled.finished}")
    plot = figure(page, "history")
    assert red_of(page) > 128
    button = page.get_by_role("button", name="evaluations")
    button.focus()
    page.keyboard.press("Enter")
    expect(page.locator(f"{plot} .xtitle")).to_have_text("evaluations")
    expect(button).to_have_attribute("aria-pressed", "true")
    link = page.locator('[data-csv="history"]').get_attribute("href")
    assert link is not None
    assert "abscissa=evaluations" in link
    page.get_by_role("button", name="compute").click()
    page.wait_for_selector("[data-profile-plot] .main-svg")
    assert page.locator(f"[data-profile-plot] {LINES}").count() == len(TRUE)


def test_a_page_hides_its_buttons_on_paper_and_each_figure_is_saved_as_an_image(
    site: Site, scripted_page: Page
) -> None:
    page = scripted_page
    page.goto(f"{site.url}/jobs/{site.filled.finished}")
    page.emulate_media(media="print")
    expect(page.locator("details.request")).to_be_hidden()
    page.emulate_media(media="screen")
    figure(page, "response")
    for kind in ("SVG", "PNG"):
        with page.expect_download() as saved:
            page.get_by_role("button", name=f"Measured against identified as {kind}").click()
        assert saved.value.suggested_filename == f"response.{kind.lower()}"


def count_printed(page: Page) -> int:
    """Print a page; count its figures, all of which are light and within the sheet."""
    page.evaluate(
        "() => addEventListener('beforeprint', () => { window.sheet = "
        "[...document.querySelectorAll('[data-figure], [data-source]')].map(plot => "
        "[plot.querySelector('.main-svg')?.getBoundingClientRect().width ?? null, "
        "plot.layout?.template.layout.font.color]) })"
    )
    page.pdf(format="A4")
    sheet = page.evaluate("window.sheet")
    assert [width for width, _ in sheet if not 0 < width <= 720] == []
    assert {colour for _, colour in sheet} == {plotly_template("light")["layout"]["font"]["color"]}
    return len(sheet)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("is_drawn", [False, True], ids=["at once", "drawn"])
def test_a_printed_page_has_every_figure_in_light_colours_within_the_sheet(
    site: Site, page: Page, scheme: Literal["light", "dark"], is_drawn: bool
) -> None:
    page.emulate_media(color_scheme=scheme)
    page.goto(f"{site.url}/jobs/{site.filled.finished}", wait_until="load")
    names = page.eval_on_selector_all("[data-figure]", "plots => plots.map(p => p.dataset.figure)")
    for name in names if is_drawn else []:
        figure(page, name)
    assert count_printed(page) == len(names)
    page.wait_for_function("() => !document.body.classList.contains('printing')")
    ink = plotly_template(scheme)["layout"]["font"]["color"]
    page.wait_for_function(
        "ink => [...document.querySelectorAll('[data-figure]')]"
        ".every(plot => plot.layout.template.layout.font.color === ink)",
        arg=ink,
    )


def test_runs_are_compared_side_by_side(site: Site, page: Page) -> None:
    page.goto(f"{site.url}/jobs/{site.filled.sweep}")
    links = page.locator("table.runs tbody a")
    chosen = [links.nth(k).get_attribute("href") or "" for k in (1, 2)]
    query = "&".join(f"run={one.removeprefix('/runs/')}" for one in chosen)
    page.goto(f"{site.url}/compare?{query}")
    expect(page.locator("table.runs tbody tr")).to_have_count(2)
    expect(page.locator("table.estimates tbody tr")).to_have_count(len(TRUE))
    page.locator("table.runs tbody a").first.click()
    expect(page.locator('tr[aria-current="true"]')).to_contain_text("run ")


def test_results_are_sorted_and_ticked_to_be_compared(site: Site, page: Page) -> None:
    page.goto(site.url)
    names = page.locator("table.jobs .name")
    page.get_by_role("link", name="Fit").click()
    expect(names.nth(0)).to_have_text("tube 40 m, pattern 1")
    page.get_by_role("link", name="Fit").click()
    expect(names.nth(0)).to_have_text("three methods, four seeds")
    compare = page.get_by_role("button", name="Compare")
    expect(compare).to_be_disabled()
    page.get_by_label("compare tube 40 m, pattern 1").check()
    page.get_by_label("compare three methods, four seeds").check()
    page.evaluate(
        """async () => {
          const script = document.querySelector('script[src*="jobs.js"]').src;
          document.querySelector('table.jobs tbody tr').append('changed');
          await (await import(new URL('live.js', script))).refresh();
        }"""
    )
    expect(page.get_by_label("compare three methods, four seeds")).to_be_checked()
    expect(names.nth(0)).to_have_text("three methods, four seeds")  # the order stays too
    compare.click()
    expect(page.get_by_role("heading", level=1)).to_have_text("Comparison of 2 runs")
    assert page.locator(f"{figure(page, 'response')} {LINES}").count() >= 3


def test_the_answer_is_on_the_first_screen_of_a_finished_run(site: Site, page: Page) -> None:
    page.set_viewport_size({"width": 1280, "height": 800})
    page.goto(f"{site.url}/jobs/{site.filled.finished}")
    tops = {
        name: page.locator(place).first.evaluate("node => node.getBoundingClientRect().bottom")
        for name, place in (
            ("verdict", ".verdict-card"),
            ("estimates", "table.estimates"),
        )
    }
    plot = page.locator('[data-figure="response"]')
    tops["outputs"] = plot.evaluate("node => node.getBoundingClientRect().top + 240")
    assert max(tops.values()) < 800, tops
    assert page.locator('[data-figure="history"]').evaluate(
        "node => node.getBoundingClientRect().top > 800"
    )


def test_a_running_job_is_redrawn_as_events_arrive_and_nothing_moves(
    own_site: Site, page: Page
) -> None:
    filled, database = own_site.filled, own_site.parts.database
    page.goto(f"{own_site.url}/jobs/{filled.running}")
    plot = page.locator(figure(page, "history"))
    last = "plot => Math.max(...plot.data.flatMap(trace => trace.x))"
    assert plot.evaluate(last) == 60
    place = plot.bounding_box()
    loads = page.evaluate("performance.getEntriesByType('navigation').length")
    progress(database, filled.lease, filled.running_run, 180)
    page.wait_for_function(
        "() => Math.max(...document.querySelector('[data-figure=history]')"
        ".data.flatMap(trace => trace.x)) === 180"
    )
    expect(page.locator('[data-live="head"]')).to_contain_text("generation 180")
    assert plot.bounding_box() == place
    assert page.evaluate("performance.getEntriesByType('navigation').length") == loads


def test_the_result_appears_when_a_running_job_ends(own_site: Site, page: Page) -> None:
    page.goto(f"{own_site.url}/jobs/{own_site.filled.running}")
    figure(page, "history")
    expect(page.locator("table.estimates")).to_have_count(0)
    lineage = page.locator('[data-live="lineage"]')
    expect(lineage).to_have_text("Drawn when the job has ended.")
    end_running(own_site.parts.database, own_site.parts.store, own_site.filled.lease)
    expect(page.locator("table.estimates tbody tr")).to_have_count(len(TRUE))
    expect(lineage.get_by_role("link", name="run 1 of")).to_have_count(1)
    expect(page.locator("#job .chip")).to_have_text("succeeded")
    expect(page.locator("[data-announcement]")).to_have_text("succeeded: trustworthy")
    assert page.locator(f"{figure(page, 'response')} {LINES}").count() == 8
    above = "node => node.getBoundingClientRect().top + scrollY"
    tops = [
        page.locator(f'[data-figure="{name}"]').evaluate(above) for name in ("response", "history")
    ]
    assert tops == sorted(tops)  # the answer is above the search now


def test_a_job_is_cancelled_and_resumed_from_its_page(own_site: Site, page: Page) -> None:
    page.goto(f"{own_site.url}/jobs/{own_site.filled.queued}")
    page.get_by_role("button", name="Cancel").click()
    expect(page.locator("#job .chip")).to_have_text("cancelled")
    page.get_by_role("button", name="Resume").click()
    expect(page.locator("#job .chip")).to_have_text("queued")
    with own_site.parts.database.write_session() as session:
        assert read_queue_state(session).jobs[JobState.QUEUED] == 1


def test_the_page_of_a_resumed_job_goes_on_after_its_earlier_end(
    own_site: Site, scripted_page: Page
) -> None:
    page = scripted_page
    job, database = own_site.filled.queued, own_site.parts.database
    with database.write_session() as session:
        JobRepository(session).cancel(job)
        JobRepository(session).resume(job)
    page.add_init_script(
        """const Plain = EventSource;
        window.open_after_end = [];
        window.EventSource = class extends Plain {
          constructor(url) {
            super(url);
            const isOpen = () => open_after_end.push(this.readyState !== Plain.CLOSED);
            this.addEventListener('end', () => setTimeout(isOpen));
          }
        };"""
    )
    page.goto(f"{own_site.url}/jobs/{job}")
    page.wait_for_function("() => open_after_end.length > 0")
    assert page.evaluate("open_after_end[0]")
    with database.write_session() as session:
        claim = LeaseQueue(session).claim_job("test")
        assert claim is not None
        assert claim.job.id == job
    expect(page.locator("#job .chip")).to_have_text("running")


def test_a_failed_job_says_why_and_a_name_is_never_markup(site: Site, page: Page) -> None:
    page.goto(f"{site.url}/jobs/{site.filled.failed}")
    expect(page.get_by_role("alert").filter(has_text=REASON).first).to_be_visible()
    page.goto(f"{site.url}/jobs/{site.filled.running}")
    expect(page.locator("h1")).to_have_text("tube 80 m <b>live</b>")


def test_a_job_of_many_runs_shows_a_table_and_the_best_of_them(site: Site, page: Page) -> None:
    page.goto(f"{site.url}/jobs/{site.filled.sweep}")
    rows = page.locator("table.runs tbody tr")
    expect(rows).to_have_count(12)
    expect(page.locator('tr[aria-current="true"]')).to_contain_text("run 1")
    rows.nth(6).get_by_role("link").click()
    expect(page.locator('tr[aria-current="true"]')).to_contain_text("run 7")
    assert page.locator(f"{figure(page, 'history')} {LINES}").count() >= 4


def test_when_another_run_becomes_the_best_all_that_is_shown_is_of_that_run(
    site: Site, page: Page
) -> None:
    page.goto(f"{site.url}/jobs/{site.filled.sweep}")
    figure(page, "history")
    shown = page.locator("#run")
    first = shown.get_attribute("data-run")
    other = page.locator("table.runs tbody tr").nth(6).get_by_role("link").get_attribute("href")
    assert other is not None
    page.evaluate(
        """async (other) => {
          history.replaceState(null, '', other);
          const job = document.querySelector('script[type=module][src*="job.js"]').src;
          const [live, figures] = await Promise.all(['live.js', 'figures.js']
            .map((name) => import(new URL(name, job))));
          await live.refresh();
          figures.watch();
        }""",
        other,
    )
    run = other.rpartition("/")[2]
    assert run != first
    expect(shown).to_have_attribute("data-run", run)
    expect(shown.get_by_role("heading", name="run 7", exact=True)).to_be_visible()
    plots = shown.locator("[data-figure]")
    urls = [one.get_attribute("data-url") or "" for one in plots.all()]
    assert urls
    assert all(run in url for url in urls)
    assert page.locator(f"{figure(page, 'history')} {LINES}").count() >= 4


def test_the_page_of_a_dataset_draws_its_channels_and_a_zoom_brings_more_samples(
    site: Site, page: Page
) -> None:
    page.goto(f"{site.url}/datasets/{site.filled.dataset}")
    plot = page.locator(figure(page, "signals"))
    expect(plot.locator(LINES)).to_have_count(2)
    assert plot.evaluate("plot => plot.data[0].x.length") <= 1000
    plot.evaluate("plot => Plotly.relayout(plot, {'xaxis.range[0]': 10, 'xaxis.range[1]': 12})")
    page.wait_for_function(
        "() => document.querySelector('[data-figure=signals]')"
        ".data[0].x.filter(x => x >= 10 && x <= 12).length >= 200"
    )


def test_the_report_is_drawn_without_a_server(site: Site, page: Page) -> None:
    answer = page.request.get(f"{site.url}/v1/jobs/{site.filled.finished}/report")
    assert answer.ok
    page.route("**/*", lambda route: route.abort())
    page.emulate_media(color_scheme="dark")
    page.set_content(answer.text())
    page.wait_for_selector(".plot .main-svg")
    assert page.locator(".js-plotly-plot").count() == 7
    expect(page.locator('.modebar-btn[data-title^="Share"]')).to_have_count(0)
    expect(page.locator("table.estimates tbody tr")).to_have_count(len(TRUE))
    assert count_printed(page) == 7


def test_a_run_is_simulated_in_a_closed_loop_from_its_page(site: Site, page: Page) -> None:
    page.goto(f"{site.url}/jobs/{site.filled.finished}")
    page.get_by_role("link", name="Simulate").click()
    expect(page.get_by_label("tuning")).to_have_value("simc PI")
    page.get_by_label("gain").first.fill("0.5")
    page.get_by_label("integral time").fill("")
    page.get_by_label("height").fill("10")
    page.get_by_role("button", name="Simulate").click()
    page.wait_for_selector("#result .main-svg")
    expect(page.get_by_role("heading", name="Response")).to_be_focused()
    expect(page.get_by_role("heading", name="Response")).to_be_in_viewport()
    expect(page.get_by_label("tuning")).to_have_value("by hand")
    expect(page.locator("#result .verdict")).to_have_text("settles")
    assert page.locator(f"#result {LINES}").count() == 3  # reference, output and input
    address = page.url
    page.goto(site.url)
    page.goto(address)  # the address is the request
    page.wait_for_selector("#result .main-svg")
    page.set_viewport_size({"width": 390, "height": 900})
    page.wait_for_function("() => document.documentElement.scrollWidth <= innerWidth")


def test_a_rule_tunes_a_pi_controller_and_its_numbers_can_be_changed_by_hand(
    site: Site, page: Page
) -> None:
    page.goto(f"{site.url}/runs/{site.filled.finished_run}/simulate")
    page.get_by_label("tuning").select_option("SIMC, PI")
    page.get_by_label("time constant of SIMC").fill("1")
    page.get_by_role("button", name="Simulate").click()
    page.wait_for_selector("#result .main-svg")
    expect(page.locator("#result")).to_contain_text("Controller by SIMC")
    expect(page.get_by_label("integral time")).not_to_have_value("")
    page.get_by_label("tuning").select_option("by hand")
    page.get_by_label("upper limit").fill("1000")
    page.get_by_label("time constant of SIMC").fill("")
    page.get_by_role("button", name="Simulate").click()
    page.wait_for_selector("#result .main-svg")
    expect(page.locator("#result")).not_to_contain_text("Controller by SIMC")
    expect(page.locator("#result")).to_contain_text("Phase margin")


def test_a_run_is_run_freely_over_a_recording_from_its_page(site: Site, page: Page) -> None:
    page.goto(f"{site.url}/runs/{site.filled.finished_run}/simulate?kind=recording")
    page.get_by_label("stored recording").select_option(site.filled.dataset)
    page.get_by_role("button", name="Simulate").click()
    page.wait_for_selector("#result .main-svg")
    expect(page.locator("#result dl")).to_contain_text(re.compile(r"RMS error\s*0\.\d+\s*kPa"))
    assert page.locator(f"#result {LINES}").count() == 4


def test_a_wrong_gain_is_told_at_its_field(site: Site, page: Page) -> None:
    page.goto(f"{site.url}/runs/{site.filled.finished_run}/simulate")
    page.get_by_label("gain").first.fill("much")
    page.get_by_role("button", name="Simulate").click()
    expect(page.get_by_role("alert")).to_contain_text("gain: found 'much'; need a number")
    expect(page.get_by_role("alert")).to_be_focused()
    expect(page.locator("[name=gain]")).to_have_attribute("aria-invalid", "true")


CUT_TABLES = """boxes => boxes.filter((box) => box.checkVisibility()).filter((box) =>
  box.scrollWidth > box.clientWidth
  || [...box.querySelectorAll('td:not(:empty)')].some((cell) => !cell.checkVisibility())
).map((box) => box.innerText)"""
"""Tables that are cut at the window's edge, or hide a cell."""
PATHS = ["/", "/docs", "/datasets", "/jobs/{failed}", "/jobs/{sweep}", "/datasets/{dataset}"]


def test_the_menu_of_a_narrow_page_is_opened_by_the_keyboard(site: Site, page: Page) -> None:
    page.goto(f"{site.url}/health")
    models = page.get_by_role("navigation", name="Main").get_by_role("link", name="Models")
    expect(models).to_be_visible()
    expect(page.get_by_text("Menu", exact=True)).to_be_hidden()
    page.set_viewport_size({"width": 390, "height": 900})
    expect(models).to_be_hidden()
    head = page.locator(".top").bounding_box()
    assert head is not None
    assert head["height"] < 60  # one line
    for key in ("Tab", "Tab", "Tab", "Enter"):  # the skip link, the brand, the menu
        page.keyboard.press(key)
    expect(models).to_be_visible()
    for _ in range(4):
        page.keyboard.press("Tab")
    expect(models).to_be_focused()


def test_a_narrow_page_does_not_overflow_and_its_headings_are_in_order(
    site: Site, page: Page
) -> None:
    page.set_viewport_size({"width": 390, "height": 900})
    for path in PATHS:
        page.goto(site.url + path.format(**vars(site.filled)))
        assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth"), path
        assert page.locator(".scroll:has(> .stacked)").evaluate_all(CUT_TABLES) == [], path
        headings = "() => [...document.querySelectorAll('h1, h2, h3')].map(one => +one.tagName[1])"
        levels = page.evaluate(headings)
        assert levels.count(1) == 1, path
        assert all(after <= before + 1 for before, after in itertools.pairwise(levels)), path
