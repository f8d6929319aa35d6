"""Every model of the catalogue gives back the parameters that made a record, from its bounds."""

import pytest

from sysid.core.settings import GeneticAlgorithm, Stop
from sysid.data.records import Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import catalogue, load_model
from sysid.models.model import Model
from sysid.results.identification import Identification
from tests.support.library.catalogue_cases import CASES, Case, make_record


def search(model: Model, record: Record, case: Case) -> Identification:
    """An identification with default settings and bounds that ends at the truth's RMS."""
    stop = Stop(rms=max(1.02 * case.sigma, 1e-9))
    settings = GeneticAlgorithm(stop=stop)
    return identify(model, record, settings, prediction=case.prediction)


def test_every_model_of_the_catalogue_has_a_case() -> None:
    assert set(CASES) == set(catalogue())


SIMILAR = {"silverbox-9", "narx", "actuator"}
"""Found again by the gate in another way: by a smaller sibling, and in tests of their own."""

HEDGED = {
    "silverbox": "b and k1 are said to depend on the start: errors of the integration remain",
}
"""Right answers that the judge takes for doubtful."""


def list_marks(name: str) -> list[pytest.MarkDecorator]:
    marks = [pytest.mark.night] if name in SIMILAR else []
    if name in HEDGED:
        marks.append(pytest.mark.xfail(strict=True, reason=HEDGED[name]))
    return marks


@pytest.mark.parametrize("name", [pytest.param(one, marks=list_marks(one)) for one in CASES])
def test_the_parameters_that_made_a_record_are_found_again(name: str) -> None:
    model, case = load_model(name), CASES[name]
    found = search(model, make_record(model, case), case)
    spans = {parameter.name: parameter.upper - parameter.lower for parameter in model.parameters}
    free = {p.name for p in model.parameters if p.is_free}
    statuses = {one.name: one.status for one in found.parameters if one.name in free}
    assert statuses == dict.fromkeys(free, "identified") | dict(case.statuses)
    for one in found.parameters:
        if one.name in case.truth:
            truth = case.truth[one.name]
            room = case.within * (abs(truth) or spans[one.name])
            assert one.value == pytest.approx(truth, abs=room), found.parameters
