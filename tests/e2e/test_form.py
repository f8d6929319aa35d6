"""The form of a new identification in Chromium."""

import re
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from playwright.sync_api import Page, expect

from service.repositories.dataset_rows import DatasetRepository
from service.repositories.job_rows import JobRepository
from tests.e2e.conftest import Site, serve_folder
from tests.support.limits import LIMIT_SECONDS

pytestmark = [pytest.mark.browser, pytest.mark.slow]

EQUATIONS = """\
name: my-tube
form: differential
inputs: {u: kPa}
states: {y: kPa}
parameters:
  K: {lower: 0, upper: 2}
  T: {lower: 0.01, upper: 2, unit: s}
  L: {lower: 0, upper: 0.5, unit: s}
equations:
  y: (K*u(t - L) - y)/T
outputs: {y: y}
initial: {y: 0}
"""


def open_form(site: Site, page: Page, query: str = "") -> None:
    page.goto(f"{site.url}/{query}#new")
    page.wait_for_function("() => document.querySelector('[name=equations]').value !== ''")


def write_own(page: Page, text: str) -> None:
    page.get_by_label("own equations").check()
    page.get_by_label("equations in YAML").fill(text)


def test_an_unknown_name_in_an_equation_is_told_with_its_column(site: Site, page: Page) -> None:
    open_form(site, page)
    write_own(page, EQUATIONS.replace("K*u(t - L)", "Kp*u(t - L)"))
    check = page.locator("#check")
    expect(check).to_contain_text("column 2")
    expect(check).to_contain_text("Kp")
    expect(page.locator("#about-model")).to_be_hidden()  # it has the equations of before
    write_own(page, EQUATIONS)
    expect(check).to_contain_text("the model is valid")
    expect(page.get_by_role("math", name="dy/dt = (K*u(t - L) - y)/T")).to_be_visible()


def test_own_equations_are_submitted_with_bounds_and_channels(own_site: Site, page: Page) -> None:
    open_form(own_site, page, f"?dataset={own_site.filled.dataset}")
    write_own(page, EQUATIONS)
    expect(page.locator("#check")).to_contain_text("the model is valid")
    page.get_by_label("upper of L").fill("0,3")
    page.get_by_label("output y").select_option("P2")
    page.get_by_label("u between samples").select_option("zero")
    page.get_by_label("noise").select_option("ar1")
    page.get_by_label("population").fill("24")
    page.get_by_label("name of the job").fill("by hand")
    page.get_by_role("button", name="Identify").click()
    page.wait_for_url(re.compile(r"/jobs/job_"))
    expect(page.locator("h1")).to_have_text("by hand")
    with own_site.parts.database.read_session() as session:
        spec = JobRepository(session).get(page.url.rsplit("/", 1)[1]).spec
    assert spec["model"]["name"] == "my-tube"
    assert spec["datasets"] == [own_site.filled.dataset]
    assert spec["channels"] == {"u": "P1", "y": "P2"}
    assert spec["parameters"] == {"L": {"upper": 0.3}}
    assert spec["hold"] == {"u": "zero"}
    assert spec["loss"]["noise_model"] == "ar1"
    assert spec["algorithm"]["population"] == 24


@pytest.mark.parametrize("hold", ["mean", "mean-after"])
def test_an_output_that_is_a_mean_is_one_in_the_job_and_in_its_clone(
    own_site: Site, page: Page, hold: str
) -> None:
    open_form(own_site, page, f"?dataset={own_site.filled.dataset}")
    write_own(page, EQUATIONS)
    expect(page.locator("#check")).to_contain_text("the model is valid")
    page.get_by_label("output y").select_option("P2")
    choice = page.get_by_label("y between samples")
    expect(choice).to_have_value("")  # as recorded
    values = choice.locator("option").evaluate_all("all => all.map(one => one.value)")
    assert values == ["", "mean", "mean-after"]  # no other hold is one of an output
    choice.select_option(hold)
    page.get_by_role("button", name="Identify").click()
    page.wait_for_url(re.compile(r"/jobs/job_"))
    page.get_by_text("The exact request").click()
    expect(page.locator(".request pre")).to_contain_text(re.compile(rf'"y": "{hold}"'))
    job = page.url.rsplit("/", 1)[1]
    with own_site.parts.database.read_session() as session:
        assert JobRepository(session).get(job).spec["hold"] == {"y": hold}
    open_form(own_site, page, f"?clone={job}")
    expect(choice).to_have_value(hold)


def test_a_refused_request_is_told_at_the_field(site: Site, page: Page) -> None:
    open_form(site, page, f"?dataset={site.filled.dataset}")
    write_own(page, EQUATIONS)  # of the recording's units: nothing else is refused
    expect(page.locator("#check")).to_contain_text("the model is valid")
    page.get_by_label("output y").select_option("P2")
    page.get_by_label("population").fill("2")
    page.get_by_role("button", name="Identify").click()
    expect(page.get_by_label("population")).to_have_attribute("aria-invalid", "true")
    told = page.locator('[data-fault="/algorithm"]')
    expect(told).to_have_text(re.compile(r"^Population: .* 4.*\.$"))
    expect(page.locator("#form-fault")).to_have_text("Change the marked fields.")
    assert page.locator("#job-form").inner_text().count("need 4 or more") == 1  # told once
    expect(page.get_by_label("population")).to_be_focused()


def test_a_comma_that_may_separate_thousands_is_refused_with_advice(site: Site, page: Page) -> None:
    open_form(site, page, f"?dataset={site.filled.dataset}")
    page.get_by_label("upper of T").fill("1,000")
    page.get_by_role("button", name="Identify").click()
    expect(page.get_by_label("upper of T")).to_have_attribute("aria-invalid", "true")
    expect(page.locator('[data-fault="/parameters"]')).to_contain_text("write a decimal point")


def test_swapped_bounds_are_marked_both_and_told_once(site: Site, page: Page) -> None:
    open_form(site, page, f"?dataset={site.filled.dataset}")
    write_own(page, EQUATIONS)
    expect(page.locator("#check")).to_contain_text("the model is valid")
    page.get_by_label("output y").select_option("P2")
    bounds = [page.locator(f'[data-pointer="/parameters/T/{end}"]') for end in ("lower", "upper")]
    for field, text in zip(bounds, ("3", "1"), strict=True):
        field.fill(text)
    page.get_by_role("button", name="Identify").click()
    for field in bounds:
        expect(field).to_have_attribute("aria-invalid", "true")
    expect(page.locator('[data-fault="/parameters"]')).to_have_text(re.compile(r"^Parameter 'T'"))


def test_a_csv_file_is_stored_and_chosen(own_site: Site, page: Page, tmp_path: Path) -> None:
    path = tmp_path / "step.csv"
    path.write_text("t [s],u [V],y [V]\n" + "".join(f"{n / 10},{n % 2},{n}\n" for n in range(20)))
    open_form(own_site, page)
    page.get_by_label("or upload a recording").set_input_files(path)
    expect(page.locator("#upload-state")).to_contain_text("step.csv is stored")
    expect(page.locator("#dataset-facts")).to_have_text("u [V] · y [V]")


def test_a_file_that_cannot_be_used_is_told_with_its_place(
    site: Site, page: Page, tmp_path: Path
) -> None:
    path = tmp_path / "bad.csv"
    path.write_text("t,u,y\n0,1,2\n0.1,oops,2\n0.2,1,2\n")
    open_form(site, page)
    page.get_by_label("or upload a recording").set_input_files(path)
    expect(page.locator('[data-fault="/datasets"]')).to_contain_text("oops")


def test_a_file_without_times_is_stored_with_its_sampling_period(
    own_site: Site, page: Page, tmp_path: Path
) -> None:
    path = tmp_path / "notime.csv"
    path.write_text("u;y\n" + "".join(f"{n % 2};{n},5\n" for n in range(20)))
    open_form(own_site, page)
    page.get_by_label("or upload a recording").set_input_files(path)
    expect(page.locator('[data-fault="/datasets"]')).to_contain_text('field "sampling period"')
    page.get_by_label("sampling period [s]").fill("0.1")
    page.get_by_label("sampling period [s]").blur()
    expect(page.locator("#upload-state")).to_contain_text("notime.csv is stored")
    expect(page.locator("#upload-state")).to_contain_text("decimal commas")
    expect(page.locator('[data-fault="/datasets"]')).to_be_empty()


def test_a_clone_starts_from_the_request_of_the_job(own_site: Site, page: Page) -> None:
    open_form(own_site, page, f"?clone={own_site.filled.finished}")
    expect(page.get_by_label("name of the job")).to_have_value("tube 40 m, pattern 1")
    expect(page.get_by_label("validation data")).to_have_value("0.3")
    expect(page.get_by_label("output p")).to_have_value("P2")
    document = yaml.safe_load(page.get_by_label("equations in YAML").input_value())
    assert document["name"] == "lagged-tube"
    page.get_by_role("button", name="Identify").click()
    page.wait_for_url(re.compile(r"/jobs/job_"))
    with own_site.parts.database.read_session() as session:
        jobs = JobRepository(session)
        specs = [
            jobs.get(name).spec for name in (own_site.filled.finished, page.url.rsplit("/", 1)[1])
        ]
    assert specs[0] == specs[1]


def test_a_clone_of_a_job_that_the_service_named_is_named_after_its_new_model(
    own_site: Site, page: Page
) -> None:
    model = yaml.safe_load(EQUATIONS)
    body = {"model": model, "datasets": [own_site.filled.dataset]}
    body |= {"channels": {"u": "P1", "y": "P2"}}
    answer = httpx.post(f"{own_site.url}/v1/jobs", json=body, timeout=LIMIT_SECONDS).json()
    assert answer["name"] == "my-tube on tube 40 m"
    open_form(own_site, page, f"?clone={answer['id']}")
    name = page.get_by_label("name of the job")
    expect(name).to_have_attribute("placeholder", answer["name"])
    write_own(page, EQUATIONS.replace("my-tube", "longer-tube"))
    expect(name).to_have_attribute("placeholder", "longer-tube on tube 40 m")
    expect(name).to_have_value("")
    page.get_by_role("button", name="Identify").click()
    page.wait_for_url(re.compile(r"/jobs/job_"))
    expect(page.locator("h1")).to_have_text("longer-tube on tube 40 m")


def test_a_clone_keeps_starts_scales_and_ties(own_site: Site, page: Page) -> None:
    model = yaml.safe_load(EQUATIONS) | {"initial": {"y": {"lower": 0, "upper": 1}}}
    asked: dict[str, Any] = {
        "K": {"tied": "2*L"},
        "T": {"scale": "log", "lower": 0.02},
        "y(0)": {"upper": 900.0},
        "y(0)[2]": {"fixed": 0.5},
    }
    data = own_site.filled.dataset
    steps = {"steps": [{"offset": {"P2": 1}}]}
    url = f"{own_site.url}/v1/datasets/{data}:derive"
    other = httpx.post(url, json=steps, timeout=LIMIT_SECONDS).json()["id"]
    body = {
        "model": model,
        "datasets": [data, other],
        "channels": {"u": "P1", "y": "P2"},
        "parameters": asked,
        "algorithm": {"generations": 2},
    }
    answer = httpx.post(f"{own_site.url}/v1/jobs", json=body, timeout=LIMIT_SECONDS)
    assert answer.status_code == 202, answer.text
    open_form(own_site, page, f"?clone={answer.json()['id']}")
    expect(page.get_by_label("upper of y(0)", exact=True)).to_have_value("900")
    page.get_by_label("lower of y(0)", exact=True).fill("-3")
    page.get_by_role("button", name="Identify").click()
    page.wait_for_url(re.compile(r"/jobs/job_"))
    with own_site.parts.database.read_session() as session:
        spec = JobRepository(session).get(page.url.rsplit("/", 1)[1]).spec
    assert spec["parameters"] == {**asked, "y(0)": {"lower": -3.0, "upper": 900.0}}


def test_a_part_of_the_recording_is_chosen_in_its_plot_and_its_mean_subtracted(
    own_site: Site, page: Page
) -> None:
    open_form(own_site, page, f"?dataset={own_site.filled.dataset}&fit=fopdt")
    plot = page.locator("[data-preview]")
    expect(plot.locator(".scatterlayer .trace")).to_have_count(2)
    assert page.locator("table.jobs tbody tr").count() == 5  # the form's model filters no list
    math = page.get_by_role("math", name="dx/dt = (K*u(t - L) - x)/T")
    expect(math.locator("mfrac")).to_have_count(2)
    expect(page.get_by_label("upper of L")).to_have_attribute("placeholder", re.compile(r"^\d"))
    expect(page.locator("#parameters tr").first).to_contain_text("static gain")
    plot.evaluate("plot => Plotly.relayout(plot, {'xaxis.range[0]': 6, 'xaxis.range[1]': 12})")
    expect(page.get_by_label("use it from [s]")).to_have_value("6")
    page.get_by_label("to [s]").fill("3")
    page.get_by_label("output y").select_option("P2")
    page.get_by_role("button", name="Identify").click()
    expect(page.locator('[data-fault="/datasets"]')).to_contain_text("need more than the start")
    page.get_by_label("to [s]").fill("15")
    page.get_by_role("combobox", name="subtract").select_option("the mean")
    page.get_by_role("group", name="Channels from which").get_by_label("P1").uncheck()
    page.get_by_label("validation data").select_option("recording tube 40 m")
    page.get_by_role("button", name="Identify").click()
    page.wait_for_url(re.compile(r"/jobs/job_"))
    with own_site.parts.database.read_session() as session:
        spec = JobRepository(session).get(page.url.rsplit("/", 1)[1]).spec
        [part], [other] = spec["datasets"], spec["validation"]["datasets"]
        dataset = DatasetRepository(session).get(part)
        validation = DatasetRepository(session).get(other)
    assert part != own_site.filled.dataset
    assert dataset.duration == pytest.approx(9, abs=0.1)
    [mean] = dataset.details["subtracted"]
    assert validation.details["steps"] == [{"offset": {"P2": mean["value"]}}]


def test_a_file_is_dropped_on_the_page(own_site: Site, page: Page) -> None:
    page.goto(own_site.url)
    page.evaluate(
        """() => {
          const files = new DataTransfer();
          const rows = Array.from({length: 20}, (_, n) => `${n / 10},${n % 2},${n}`);
          files.items.add(new File([['t,u,y', ...rows, ''].join('\\n')], 'dropped.csv'));
          document.dispatchEvent(new DragEvent('drop', {dataTransfer: files, bubbles: true}));
        }"""
    )
    expect(page.locator("#upload-state")).to_contain_text("dropped.csv is stored")
    expect(page.locator("#dataset-facts")).to_have_text("u · y")


def test_a_new_user_finds_an_example_to_try(page: Page, tmp_path: Path) -> None:
    with serve_folder(tmp_path) as server:
        page.goto(server.url)
        page.get_by_role("button", name="Try the example").click()
        page.wait_for_url(re.compile(r"fit=fopdt"))
        expect(page.locator("[data-preview] .scatterlayer .trace")).to_have_count(2)
        page.get_by_role("button", name="Identify").click()
        page.wait_for_url(re.compile(r"/jobs/job_"))
        expect(page.locator("#job .chip")).to_have_text("queued")
        page.goto("about:blank")  # it asks the server nothing more
