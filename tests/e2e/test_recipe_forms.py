"""The forms of a noise sweep and of a re-identification in Chromium."""

import re

import httpx
import pytest
from playwright.sync_api import Page, expect

from service.repositories.job_rows import JobRepository
from tests.e2e.conftest import Site
from tests.support.limits import LIMIT_SECONDS

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def spec_of(site: Site, page: Page) -> dict[str, object]:
    page.wait_for_url(re.compile(r"/jobs/job_"))
    with site.parts.database.read_session() as session:
        return dict(JobRepository(session).get(page.url.rsplit("/", 1)[1]).spec)


def open_sweep(site: Site, page: Page, model: str = "fopdt") -> None:
    page.goto(f"{site.url}/new/noise-sweep")
    page.locator("[name=model]").select_option(model)
    page.wait_for_selector("[data-truth=K]")


def test_a_sweep_tells_its_runs_before_it_is_submitted_and_makes_as_many(
    own_site: Site, page: Page
) -> None:
    simulated = httpx.post(
        f"{own_site.url}/v1/datasets:simulate",
        json={
            "model": "fopdt",
            "name": "whose truth is known",
            "parameters": {"K": 2, "T": 1, "L": 0.5, "y0": 0},
            "inputs": {"u": {"kind": "binary", "period": 2}},
            "samples": 50,
            "sample_time": 0.1,
        },
        timeout=LIMIT_SECONDS,
    )
    assert simulated.status_code == 201
    open_sweep(own_site, page)
    for name, value in {"K": "2", "T": "1", "L": "0.5", "y0": "0"}.items():
        page.get_by_label(re.compile(rf"^true {name}\b")).fill(value)
    page.get_by_label(re.compile("^input u")).fill("cos(t)")
    page.get_by_label("samples").fill("100")
    page.get_by_label("sampling period").fill("0.1")
    page.get_by_label("σ, as a list").fill("0:0.3:0.1")
    page.get_by_label("replicates").fill("3")
    told = page.locator("#runs-count")
    expect(told).to_have_text("4 σ × 3 replicates × 2 methods = 24 runs")
    page.get_by_label("simple").uncheck()
    expect(told).to_have_text("4 σ × 3 replicates × 1 method = 12 runs")
    page.get_by_text("Bounds of the parameters").click()
    page.get_by_label("upper of L").fill("2")
    page.get_by_label("population").fill("10")
    page.get_by_role("button", name="Sweep").click()
    spec = spec_of(own_site, page)
    expect(page.locator("#job")).to_contain_text("0 of 12 runs")
    assert spec["model"] == "fopdt"
    assert spec["parameters"]["L"]["upper"] == 2  # type: ignore[index]
    assert spec["algorithm"]["population"] == 10  # type: ignore[index]


def test_faults_of_a_sweep_stand_at_their_fields(own_site: Site, page: Page) -> None:
    open_sweep(own_site, page)
    page.get_by_label("σ, as a list").fill("0, a tenth")
    page.get_by_role("button", name="Sweep").click()
    expect(page.locator('[data-fault="/sigma"]')).to_contain_text("tenth")
    expect(page.get_by_label("σ, as a list")).to_have_attribute("aria-invalid", "true")
    page.get_by_label("σ, as a list").fill("0,05 0,1")
    page.get_by_role("button", name="Sweep").click()
    expect(page.locator('[data-fault="/sigma"]')).to_contain_text("semicolons between numbers")
    page.get_by_label("σ, as a list").fill("0, 0.1")
    page.get_by_role("button", name="Sweep").click()
    told = page.locator('[data-fault="/truth"]')
    expect(told).to_contain_text("Give the true value of K.")
    expect(told).to_contain_text("such as 10*cos(5*t).")
    expect(page.locator("#form-fault")).not_to_contain_text("/")
    expect(page.locator('[data-fault="/sigma"]')).to_be_empty()


def test_a_sweep_of_a_recording_says_that_it_adds_the_runs_without_noise(
    own_site: Site, page: Page
) -> None:
    page.goto(f"{own_site.url}/new/noise-sweep?dataset={own_site.filled.dataset}")
    page.locator("[name=model]").select_option("fopdt")
    page.get_by_label("σ, as a list").fill("1; 2,5")
    page.get_by_label("replicates").fill("2")
    expect(page.locator("#runs-count")).to_have_text(
        "2 σ × 2 replicates × 2 methods = 8 runs, and 4 at σ = 0 as the reference of the errors"
    )
    page.get_by_label("output y").select_option("P2")
    page.get_by_role("button", name="Sweep").click()
    spec = spec_of(own_site, page)
    expect(page.locator("#job")).to_contain_text("0 of 12 runs")
    assert spec["datasets"] == [own_site.filled.dataset]
    assert [0.0, 1.0, 2.5] in [axis["values"] for axis in spec["sweep"]["axes"]]  # type: ignore[index]
    assert spec["channels"] == {"u": "P1", "y": "P2"}


def test_recordings_with_labels_become_a_batch_with_a_trend(own_site: Site, page: Page) -> None:
    for length in (5, 10):
        body = {"plant": "tube", "name": f"tube-{length}m", "parameters": {"length_m": length}}
        answer = httpx.post(
            f"{own_site.url}/v1/datasets:simulate", json=body, timeout=LIMIT_SECONDS
        )
        assert answer.status_code == 201, answer.text
    page.goto(f"{own_site.url}/new/reidentify")
    page.locator("[name=model]").select_option("tube")
    page.wait_for_selector("#parameters tr", state="attached")
    page.get_by_label("show only names with").fill("tube-")
    expect(page.get_by_label("label of tube 40 m")).to_be_hidden()
    page.get_by_label("label of tube-10m").fill("10")
    page.get_by_label("label of tube-5m").fill("5")
    expect(page.locator("#runs-count")).to_have_text("2 runs at 2 values of the label")
    page.get_by_role("button", name="Identify").click()
    expect(page.locator('[data-fault="/label"]')).not_to_be_empty()
    page.get_by_label("name of the label").fill("length_m")
    page.get_by_label("parameters to report").fill("L, T")
    page.get_by_label("predict at").fill("30")
    page.get_by_label("input u").select_option("P1")
    page.get_by_label("output y").select_option("P2")
    page.get_by_role("button", name="Identify").click()
    spec = spec_of(own_site, page)
    [axis] = spec["sweep"]["axes"]  # type: ignore[index]
    assert axis["labels"] == [{"length_m": 5}, {"length_m": 10}]
    assert spec["trend"]["parameters"] == ["L", "T"]  # type: ignore[index]
    assert spec["trend"]["predict"] == [30]  # type: ignore[index]
    assert spec["warm_start"] == "previous"


@pytest.mark.parametrize("path", ["/new/noise-sweep", "/new/reidentify"])
def test_the_forms_fit_a_narrow_page_and_every_field_has_a_label(
    site: Site, page: Page, path: str
) -> None:
    page.set_viewport_size({"width": 390, "height": 900})
    page.goto(f"{site.url}{path}")
    page.wait_for_selector("#parameters tr", state="attached")
    assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
    unnamed = (
        "() => [...document.querySelectorAll('input, select')]"
        ".filter(one => !one.labels.length && !one.ariaLabel).length"
    )
    assert page.evaluate(unnamed) == 0
