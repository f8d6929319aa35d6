"""What pages call the fields that distinguish a run."""

from service.pages.views import format_cell


def test_fields_are_told_by_their_last_part_and_those_that_end_alike_in_full() -> None:
    cell = {"/noise/sigma": 0.0, "/noise/seed": 7, "/seed": 7, "/algorithm/method": "simple"}
    assert format_cell(cell, {}) == "sigma 0, noise seed 7, seed 7, method simple"
    assert format_cell({"/seed": 7}, {}) == "seed 7"


def test_where_labels_tell_of_the_data_their_identifiers_are_left_out() -> None:
    assert format_cell({"/datasets": ["ds_1"], "/seed": 2}, {"length_m": 5}) == "length_m 5, seed 2"
