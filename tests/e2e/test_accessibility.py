"""Pages for keyboards and screen readers: the rules of axe find nothing, light and dark."""

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page

from service.jobs.job_schemas import ReferenceIn
from service.jobs.references import accept_reference
from tests.e2e.conftest import Site

PATHS = (
    "/",
    "/datasets",
    "/datasets/{dataset}",
    "/?sort=fit",
    "/compare?run={finished_run}&run={sweep_run}",
    "/results",
    "/models",
    "/models/fopdt",
    "/references",
    "/references/tube",
    "/health",
    "/settings",
    "/jobs/{sweep}",
    "/jobs/{failed}",
    "/runs/{finished_run}",
    "/runs/{finished_run}/simulate",
    "/new/noise-sweep",
    "/new/reidentify",
    "/guides/README.md",
    "/guides/explanation/method.md",
    "/guides/uncertainty.md",
)


@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.night)])
def test_axe_finds_nothing(site: Site, page: Page, scheme: str) -> None:
    page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
    axe, found = Axe(), []
    with site.parts.database.write_session() as session:
        accept_reference(session, "tube", ReferenceIn(run=site.filled.finished_run))
    for path in PATHS:
        page.goto(site.url + path.format(**vars(site.filled)))
        page.wait_for_load_state("networkidle")
        for fault in axe.run(page).response["violations"]:
            places = [node["target"][0] for node in fault["nodes"]]
            found.append(f"{path}: {fault['id']}: {fault['help']}: {places[:4]}")
    assert not found, "\n".join(found)
