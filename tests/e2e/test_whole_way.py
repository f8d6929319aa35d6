"""From a file on a user's disk to estimates on the page, through the whole service."""

import re
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Locator, Page, expect

from tests.support.service.whole_service import Service

pytestmark = [
    pytest.mark.browser,
    pytest.mark.ray,
    pytest.mark.slow,
    pytest.mark.timeout(600),
]

K, T, L, STEP = 2.0, 0.35, 0.12, 0.02
LAST = "plot => Math.max(0, ...(plot.data ?? []).flatMap(trace => trace.x))"


def make_recording(path: Path) -> Path:
    """A first-order lag behind a dead time, integrated exactly between the samples, as CSV."""
    times = np.arange(600) * STEP
    u = np.where(times % 3 < 1.5, 1.0, -0.5)
    pole, delay = np.exp(-STEP / T), round(L / STEP)
    y = np.zeros_like(u)
    for n in range(1, u.size):
        past = u[max(n - 1 - delay, 0)]
        y[n] = pole * y[n - 1] + K * (1 - pole) * past
    y += 0.005 * np.random.default_rng(3).standard_normal(y.size)
    lines = [f"{t:.2f},{a},{b:.6f}" for t, a, b in zip(times, u, y, strict=True)]
    path.write_text("t [s],u [V],y [V]\n" + "\n".join(lines) + "\n")
    return path


def fill_in_form(service: Service, page: Page, path: Path, name: str) -> None:
    page.goto(f"{service.stand.url}/#new")
    page.wait_for_function("() => document.querySelector('[name=equations]').value !== ''")
    page.get_by_label("or upload a recording").set_input_files(path)
    expect(page.locator("#dataset-facts")).to_have_text("u [V] · y [V]")
    page.get_by_role("combobox", name="Model", exact=True).select_option("fopdt")
    expect(page.get_by_label("equations in YAML")).to_have_value(re.compile("name: fopdt"))
    page.get_by_label("name of the job").fill(name)


def press_tab_to(page: Page, target: Locator) -> None:
    """Reach what a user without a mouse would use next."""
    for _ in range(60):
        page.keyboard.press("Tab")
        if target.evaluate("node => node === document.activeElement"):
            return
    pytest.fail(f"no Tab leads to {target}")


def test_a_file_becomes_estimates_with_their_errors_without_a_mouse(
    service: Service, page: Page, tmp_path: Path
) -> None:
    page.goto(service.stand.url)
    press_tab_to(page, page.locator("#new > summary"))
    page.keyboard.press("Enter")
    page.wait_for_function("() => document.querySelector('[name=equations]').value !== ''")
    page.wait_for_function("() => !document.getElementById('job-form').inert")
    upload = page.get_by_label("or upload a recording")
    press_tab_to(page, upload)
    upload.set_input_files(make_recording(tmp_path / "step.csv"))  # the dialog is the system's
    expect(page.locator("#dataset-facts")).to_have_text("u [V] · y [V]")
    model = page.get_by_role("combobox", name="Model", exact=True)
    press_tab_to(page, model)
    page.keyboard.press("Home")
    for _ in range(model.locator("option").count()):
        if model.input_value() == "fopdt":
            break
        page.keyboard.press("ArrowDown")
    expect(model).to_have_value("fopdt")
    press_tab_to(page, page.get_by_label("name of the job"))
    page.keyboard.type("whole way")
    press_tab_to(page, page.get_by_role("button", name="Identify"))
    page.keyboard.press("Enter")
    page.wait_for_url(re.compile(r"/jobs/job_"))
    expect(page.locator("#job .chip")).to_have_text("succeeded")
    table = page.locator("table.estimates tbody")
    expect(table).to_contain_text("identified")
    delay = table.locator("tr", has=page.get_by_role("rowheader", name="L")).locator("td").first
    assert float(delay.inner_text()) == pytest.approx(L, abs=0.02)
    page.locator('[data-figure="response"]').scroll_into_view_if_needed()
    expect(page.locator('[data-figure="response"] .scatterlayer .trace')).to_have_count(8)
    press_tab_to(page, page.get_by_role("link", name="Simulate"))


def test_a_long_search_is_watched_and_cancelled(
    service: Service, page: Page, tmp_path: Path
) -> None:
    fill_in_form(service, page, make_recording(tmp_path / "step.csv"), "long")
    page.get_by_label("generations").fill("10000000")
    page.get_by_label("method").select_option("simple")
    page.get_by_role("button", name="Identify").click()
    page.wait_for_url(re.compile(r"/jobs/job_"))
    expect(page.locator("#job .chip")).to_have_text("running")
    plot = page.locator('[data-figure="history"]')
    expect(plot.locator(".scatterlayer .trace").first).to_be_attached()
    seen = plot.evaluate(LAST)
    page.wait_for_function(
        f"seen => ({LAST})(document.querySelector('[data-figure=history]')) > seen", arg=seen
    )
    page.get_by_role("button", name="Cancel").click()
    expect(page.locator("#job .chip")).to_have_text("cancelled")
    expect(page.get_by_role("button", name="Resume")).to_be_visible()
