"""Whatever is put into a model document, reading it gives a model or faults, nothing else."""

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from sysid.core.errors import InvalidModel
from sysid.models.catalogue.load import catalogue, copy_catalogue_document
from sysid.models.document_reader import parse_yaml
from sysid.models.parse import parse_model

junk = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.floats(),
        st.text(max_size=8),
        st.sampled_from(["x", "k", "y(k-1)", "measured", "log", "all", 1e308, -1, 10**400]),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.one_of(st.text(max_size=4), st.integers()), inner, max_size=3),
    ),
    max_leaves=4,
)


@given(st.sampled_from(catalogue()), st.data())
def test_a_damaged_document_gives_faults_or_a_model_that_round_trips(
    name: str, data: st.DataObject
) -> None:
    damaged: dict[str, Any] = copy_catalogue_document(name)
    for _ in range(data.draw(st.integers(1, 3))):
        _damage(damaged, data)
    said, model = "", None
    try:
        model = parse_model(damaged)
    except InvalidModel as error:
        said = str(error)
    assert said or (model is not None and parse_model(model.document) == model)
    assert "\n" not in said


def _damage(place: dict[str, Any], data: st.DataObject) -> None:
    key = data.draw(st.sampled_from(list(place)) if place else st.just("name"))
    inside = place.get(key)
    if isinstance(inside, dict) and inside and data.draw(st.booleans()):
        _damage(inside, data)
    elif data.draw(st.booleans()):
        place[key] = data.draw(junk)
    else:
        place[data.draw(st.text(max_size=6))] = place.pop(key, None)


@given(st.text(alphabet="abk:{}[]&*!?|>-#\"' \n\t0123456789.,%@`<\x00é", max_size=60))
def test_no_text_makes_the_yaml_reader_raise_anything_but_its_own_error(text: str) -> None:
    said = ""
    try:
        parse_yaml(text)
    except InvalidModel as error:
        said = str(error)
    assert "\n" not in said
