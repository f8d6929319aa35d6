"""docs/tutorials: each page runs, and prints what it shows."""

from pathlib import Path

import pytest

from tests.documents.tutorials import Output, check_page, list_tutorials

PAGES = list_tutorials()
WITHOUT_SERVICE = [page for page in PAGES if "lagid serve" not in page.read_text("utf-8")]


def describe(outputs: list[Output]) -> str:
    return "\n".join(f"on the page:\n{one.written}\nnow:\n{one.seen}" for one in outputs)


LONG = {"dead_time_in_transfer_functions"}  # as much computing as all the others: at night


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.stem, marks=[pytest.mark.night] if page.stem in LONG else [])
        for page in WITHOUT_SERVICE
    ],
)
def test_a_tutorial_prints_what_it_shows(page: Path) -> None:
    differing = check_page(page)
    assert differing == [], describe(differing)


@pytest.mark.night
@pytest.mark.parametrize(
    "page", [page for page in PAGES if page not in WITHOUT_SERVICE], ids=lambda page: page.stem
)
def test_a_tutorial_with_a_service_prints_what_it_shows(page: Path) -> None:
    differing = check_page(page)
    assert differing == [], describe(differing)


def test_another_number_is_seen() -> None:
    output = Output("L 11.985 ± 0.049 s\n3 of 7 independent starts", "L 12.985 ± 0.049 s\n3 of 7 x")
    assert not output.agrees


def test_what_varies_is_no_difference() -> None:
    shown = "RMS 1.5, fit 90 %; 300 simulations in 0.2 s\njob_01m84x9p2zhg36268wv0yqps84"
    seen = "RMS 1.5001, fit 90 %; 800 simulations in 1.3 s\njob_01m84x9m2d5s6jyy7e8xcghjb8"
    assert Output(shown, seen).agrees
