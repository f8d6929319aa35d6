"""The trend on a job's page, in a browser: drawn, told, and a run accepted from it."""

import httpx
import pytest
from playwright.sync_api import Page, expect

from tests.e2e.conftest import LIMIT_SECONDS, Site
from tests.identified import carried_out
from tests.integration.rest.test_rest_reidentify import BODY, LENGTHS, recorded
from tests.rest import CSV

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def batch_of(site: Site) -> str:
    """A batch of four lengths that is over."""
    with httpx.Client(base_url=site.url, timeout=LIMIT_SECONDS) as client:
        experiments = []
        for x in LENGTHS:
            stored = client.post(f"/v1/datasets?name=e2e-{x:g}", content=recorded(x), headers=CSV)
            experiments.append({"x": x, "datasets": [stored.json()["id"]]})
        answer = client.post("/v1/recipes/reidentify", json={**BODY, "batch": experiments})
        job = str(answer.json()["id"])
    carried_out(site.parts, job)
    return job


def test_the_trend_is_drawn_and_a_run_accepted(own_site: Site, page: Page) -> None:
    page.goto(f"{own_site.url}/jobs/{batch_of(own_site)}")
    trend = page.locator("#trend")
    expect(trend.locator(".js-plotly-plot")).to_be_visible()
    expect(trend.locator(".plot .xtitle").first).to_have_text("length_m")
    expect(trend.locator("table").first.locator("tbody tr")).to_have_count(len(LENGTHS))
    trend.get_by_label("as the reference").fill("seen in a browser")
    trend.get_by_label("Accept the run").select_option(index=2)
    trend.get_by_role("button", name="Accept").click()
    expect(trend.locator("[data-accepted]")).to_contain_text("seen in a browser is now run_")
    told = httpx.get(
        f"{own_site.url}/v1/references/seen in a browser", timeout=LIMIT_SECONDS
    ).json()
    assert told["labels"] == {"length_m": LENGTHS[2]}
    trend.get_by_label("as the reference").fill(" blank")
    trend.get_by_role("button", name="Accept").click()
    expect(trend.locator("[data-accepted]")).to_contain_text("need 1 to 100 printable characters")
