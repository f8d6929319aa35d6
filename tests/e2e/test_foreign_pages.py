"""What a page of somebody else can do to a service on loopback, in a real browser: nothing."""

import httpx
import pytest
from fastapi import FastAPI
from playwright.sync_api import Browser

from tests.e2e.conftest import LIMIT_MILLISECONDS, Site
from tests.support.service.web_server import serve_in_thread

pytestmark = [pytest.mark.browser, pytest.mark.slow]

SEND = """async (url) => {
  const form = new FormData();
  form.append('file', new Blob(['t,u,y\\n0,1,2\\n1,2,3\\n'], { type: 'text/csv' }), 'evil.csv');
  const sent = [
    ['/v1/models', new Blob(['{"name": "tank"}'])],
    ['/v1/datasets', 't,u,y\\n0,1,2\\n1,2,3\\n'],
    ['/v1/datasets', form],
    ['/v1/jobs/job_0:cancel', undefined],
  ];
  for (const [path, body] of sent) {
    await fetch(url + path, { method: 'POST', mode: 'no-cors', body }).catch(() => {});
  }
}"""


def test_a_page_of_somebody_else_reads_nothing_and_changes_nothing(
    browser: Browser, site: Site
) -> None:
    before = httpx.get(f"{site.url}/v1/datasets").json()
    port = site.url.rpartition(":")[2]
    with browser.new_context() as context:
        page = context.new_page()
        page.set_default_timeout(LIMIT_MILLISECONDS)
        rebound = page.goto(f"http://rebound.test:{port}/")
        assert rebound is not None
        assert rebound.status == 421
        assert "Identifications" not in page.content()
        failures: list[str | None] = []
        with serve_in_thread(FastAPI()) as other:
            page.goto(other.replace("127.0.0.1", "evil.test"))
            page.on("requestfailed", lambda request: failures.append(request.failure))
            page.evaluate(SEND, site.url)
        # They arrived, and not even the status of an answer is given to the page.
        assert failures == ["net::ERR_BLOCKED_BY_RESPONSE.NotSameOrigin"] * 4
    assert httpx.get(f"{site.url}/v1/datasets").json() == before
