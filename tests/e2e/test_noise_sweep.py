"""A large sweep in Chromium: Figure 15, and the grid of its cells instead of a list of its runs."""

import re
from collections.abc import Iterator

import httpx
import pytest
from playwright.sync_api import Page, expect

from tests.e2e.conftest import serve_folder
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.local_runs import carry_out_job

pytestmark = [pytest.mark.browser, pytest.mark.slow]

BODY = {
    "name": "under noise",
    "model": "fopdt",
    "sigma": [0, 0.25],
    "replicates": 13,
    "truth": {
        "parameters": {"K": 2, "T": 1, "L": 0.5, "y0": 0},
        "inputs": {"u": {"kind": "binary", "period": 2}},
        "samples": 100,
        "sample_time": 0.1,
    },
    "parameters": {"T": {"upper": 5.0}, "L": {"upper": 1.0}},
    "algorithm": {"population": 10, "generations": 8, "islands": 1},
}
PLOT = '[data-figure="summary"]'


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a sweep of 52 runs that has ended."""
    with serve_folder(tmp_path_factory.mktemp("sweep")) as server:
        url = f"{server.url}/v1/recipes/noise-sweep"
        answer = httpx.post(url, json=BODY, timeout=LIMIT_SECONDS)
        assert answer.status_code == 202, answer.text
        name: str = answer.json()["id"]
        carry_out_job(server.parts, name)
        yield f"{server.url}/jobs/{name}"


def test_a_sweep_shows_its_errors_and_a_cell_leads_to_its_runs(page: Page, job: str) -> None:
    page.goto(job)
    page.wait_for_selector(f"{PLOT} .main-svg")
    drawn = page.locator(PLOT).evaluate("plot => plot.data.map(one => one.legendgroup)")
    assert set(drawn) == {
        "simple",
        "improved",
        "Cramér–Rao bound (median; 5 and 95 %)",
    }
    height = page.locator(PLOT).evaluate("plot => [plot.clientHeight, plot.layout.height]")
    assert height[0] == height[1]  # the page had left room: nothing below has moved
    expect(page.locator("table.runs")).to_have_count(0)
    cells = page.locator("table.cells tbody td a")
    expect(cells).to_have_count(4)
    expect(cells.first).to_contain_text("13 runs")
    cells.last.click()
    expect(page).to_have_url(re.compile(r"cell=.*sigma%3D0\.25.*method%3D%22improved%22"))
    rows = page.locator("table.runs tbody tr")
    expect(rows).to_have_count(13)
    expect(rows.first).to_contain_text("sigma 0.25")
    expect(page.locator("table.cells td[aria-current] a")).to_have_count(1)
    page.get_by_role("link", name="all cells").click()
    expect(page.locator("table.runs")).to_have_count(0)


def test_the_plots_of_a_narrow_page_stand_below_each_other(page: Page, job: str) -> None:
    page.set_viewport_size({"width": 420, "height": 900})
    page.goto(job)
    page.wait_for_selector(f"{PLOT} .main-svg")
    domains = page.locator(PLOT).evaluate(
        "plot => Object.keys(plot.layout).filter(one => one.startsWith('xaxis'))"
        ".map(one => plot.layout[one].domain)"
    )
    assert len(domains) == 6  # the response, four parameters, and where the state starts
    assert all(domain == [0, 1] for domain in domains)
    wide = "() => document.documentElement.scrollWidth <= innerWidth"
    assert page.evaluate(wide)
