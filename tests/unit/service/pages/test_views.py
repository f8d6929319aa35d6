"""What pages call the fields that distinguish a run, and what their notes advise."""

from dataclasses import replace

from service.pages.result_filters import list_note_texts
from service.pages.views import format_cell
from sysid.core.findings import note
from tests.support.checkout import ROOT
from tests.support.storage.run_results import conclude


def test_fields_are_told_by_their_last_part_and_those_that_end_alike_in_full() -> None:
    cell = {"/noise/sigma": 0.0, "/noise/seed": 7, "/seed": 7, "/algorithm/method": "simple"}
    assert format_cell(cell, {}) == "sigma 0, noise seed 7, seed 7, method simple"
    assert format_cell({"/seed": 7}, {}) == "seed 7"


def test_where_labels_tell_of_the_data_their_identifiers_are_left_out() -> None:
    assert format_cell({"/datasets": ["ds_1"], "/seed": 2}, {"length_m": 5}) == "length_m 5, seed 2"


def test_a_note_names_the_fields_of_the_form() -> None:
    text = "Read as straight lines (hold: {u: first}) or with loss: {noise_model: ar1} it differs"
    found = replace(conclude().identification, findings=(note("reading", "reading", text),))
    [shown] = list_note_texts(found)
    assert shown == (
        "Read as straight lines (“u between samples: straight line (first)”) or with "
        "“noise: first-order coloured (ar1)” it differs"
    )
    pages = ROOT / "service/pages"
    assert "} between samples`" in (pages / "static/form.js").read_text()
    assert "<label>noise <select" in (pages / "templates/form.html").read_text()
