"""Items in Chromium: found by a form, edited and deleted by dialogs that ask first."""

import re

import pytest
from playwright.sync_api import Page, expect

from tests.e2e.conftest import Site

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def test_lists_are_filtered_by_a_form_that_keeps_what_was_typed(site: Site, page: Page) -> None:
    page.goto(site.url)
    page.get_by_text("Filter", exact=True).first.click()
    form = page.get_by_role("search")
    form.get_by_label("Name", exact=True).fill("DIVERGES")
    form.get_by_label("Since").fill("2020-01-31")
    form.get_by_role("button", name="Filter").click()
    expect(page.locator("table.jobs tbody tr")).to_have_count(1)
    expect(form.get_by_label("Name", exact=True)).to_have_value("DIVERGES")
    page.get_by_role("link", name="succeeded", exact=True).click()  # the other conditions stay
    expect(page.get_by_text("No job meets all conditions.")).to_be_visible()
    page.get_by_role("link", name="show all").click()
    expect(page.locator("table.jobs tbody tr")).to_have_count(5)
    page.goto(f"{site.url}/datasets?name=&since=&tag=none")
    expect(page.get_by_text("No recording meets all conditions.")).to_be_visible()


def test_a_date_that_is_none_is_told_on_a_page(site: Site, page: Page) -> None:
    answer = page.goto(f"{site.url}/?since=yesterday")
    assert answer is not None
    assert answer.status == 422
    expect(page.get_by_text("need a date")).to_be_visible()


def test_a_job_is_edited_and_a_stale_page_is_refused(own_site: Site, page: Page) -> None:
    page.goto(f"{own_site.url}/jobs/{own_site.filled.finished}")
    with page.context.new_page() as other:
        other.goto(page.url)
        for window, name in ((page, "renamed <b>"), (other, "too late")):
            window.get_by_role("button", name="Edit").first.click()
            dialog = window.get_by_role("dialog", name="Edit the job")
            dialog.get_by_label("Name").fill(name)
            dialog.get_by_label("Note").fill("valve <i>stuck</i>\nsince May")
            dialog.get_by_label("Tags").fill("night, suspect ,")
            dialog.get_by_role("button", name="Save").click()
            if window is page:
                expect(page.get_by_role("heading", level=1)).to_have_text("renamed <b>")
        expect(other.get_by_text("Somebody has changed it meanwhile")).to_be_visible()
    expect(page.locator(".annotations .tag")).to_have_text(["night", "suspect"])
    expect(page.locator(".item-note")).to_have_text(re.compile("valve <i>stuck</i>"))
    page.goto(f"{own_site.url}/?tag=suspect")
    expect(page.locator("table.jobs tbody tr")).to_have_count(1)


def test_a_recording_is_deleted_after_its_jobs_were_shown(own_site: Site, page: Page) -> None:
    page.goto(f"{own_site.url}/jobs/{own_site.filled.running}")
    page.get_by_role("button", name="Delete").first.click()
    dialog = page.get_by_role("dialog", name="Delete the job")
    dialog.get_by_role("button", name="Delete").click()
    expect(dialog.get_by_role("alert")).to_contain_text("Cancel it before deleting it")
    page.goto(f"{own_site.url}/jobs/{own_site.filled.finished}")  # until its scripts have begun
    # All figures have come: what is asked of a deleted job is refused.
    page.wait_for_load_state("networkidle")
    page.get_by_role("button", name="Delete").first.click()
    dialog.get_by_role("button", name="Close").click()
    expect(dialog).to_be_hidden()
    page.get_by_role("button", name="Delete").first.click()
    dialog.get_by_role("button", name="Delete").click()
    expect(page).to_have_url(f"{own_site.url}/")
    expect(page.locator("table.jobs tbody tr")).to_have_count(4)
    page.goto(f"{own_site.url}/datasets/{own_site.filled.dataset}")
    expect(page.get_by_text("job, deleted")).to_be_visible()  # its place in the lineage
    page.get_by_role("button", name="Delete").click()
    dialog = page.get_by_role("dialog", name="Delete the dataset")
    dialog.get_by_role("button", name="Delete").click()
    expect(dialog.get_by_text("These were made from it:")).to_be_visible()
    dialog.get_by_role("button", name=re.compile("Delete it and these")).click()
    expect(dialog.get_by_role("alert")).to_contain_text("is running")  # nothing was deleted
