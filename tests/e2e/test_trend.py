"""The trend on a job's page, in a browser: drawn, told, and a run accepted from it."""

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Page, expect

from tests.e2e.conftest import serve_folder
from tests.e2e.test_late_answers import LIVE
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.tube_batch import LENGTHS, copy_batch

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[str, str]]:
    """The address of a service with a batch of four lengths that is over, and of its job."""
    batch = copy_batch(tmp_path)
    with serve_folder(tmp_path) as served:
        yield served.url, f"{served.url}/jobs/{batch.job}"


def test_the_trend_is_drawn_and_a_run_accepted(server: tuple[str, str], page: Page) -> None:
    url, job = server
    page.goto(job)
    trend = page.locator("#trend")
    expect(trend.locator(".js-plotly-plot")).to_be_visible()
    expect(trend.locator(".plot .xtitle").first).to_have_text("length [m]")
    expect(trend.locator("table").first.locator("tbody tr")).to_have_count(len(LENGTHS))
    # As on a page that was opened before the first run ended: its choices come with the results.
    chosen = trend.get_by_label("Accept the run")
    chosen.evaluate("select => select.replaceChildren()")
    page.evaluate(f"async () => (await import({LIVE})).refresh()")
    expect(chosen.locator("option")).to_have_count(len(LENGTHS))
    trend.get_by_label("as the reference").fill("seen in a browser")
    trend.get_by_label("Accept the run").select_option(index=2)
    trend.get_by_role("button", name="Accept").click()
    expect(trend.locator("[data-accepted]")).to_contain_text("seen in a browser is now run_")
    told = httpx.get(f"{url}/v1/references/seen in a browser", timeout=LIMIT_SECONDS).json()
    assert told["labels"] == {"length_m": LENGTHS[2]}
    trend.get_by_label("as the reference").fill(" blank")
    trend.get_by_role("button", name="Accept").click()
    expect(trend.locator("[data-accepted]")).to_contain_text("need 1 to 100 printable characters")
