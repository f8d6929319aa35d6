"""Resolving a model whose terms are to be selected on the estimation records."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from sysid.core.errors import InvalidSettings
from sysid.core.threads import one_thread
from sysid.data.records import Record
from sysid.models.model import Model, SelectedTerm, Selection, TermRule
from sysid.models.parameters import Parameter, override
from sysid.models.parse import with_terms
from sysid.models.polynomial import check_samples
from sysid.selection.free_run import reselected
from sysid.selection.frols import Forward, forward, select, solved
from sysid.selection.lag_search import affordable, lag_values, search
from sysid.selection.regression import Regression

Changes = Mapping[str, Mapping[str, Any]]


def selected(
    model: Model, records: Sequence[Record], changes: Changes | None = None, skip: int = 0
) -> tuple[Model, dict[str, Mapping[str, Any]]]:
    """The model with the terms that its rule selects on the records; another as it is.

    Without records the model stays as it is, too. Unknown lags are tried at whole samples inside
    their bounds; the terms are those at the lags where they explain most. The lags stay unknown:
    their values are in the `selection` of the model, for the search to begin with.

    Parameters
    ----------
    model : Model
    records : sequence of Record
        Those for the estimate.
    changes : mapping of str to mapping
        Changed bounds, scales or fixed values, also of candidates' coefficients.
    skip : int
        First samples of each output that are not scored.

    Returns
    -------
    Model
    dict
        The changes, without those of coefficients that the model no longer has.

    Raises
    ------
    InvalidSettings
        If the records have fewer samples than there are candidates, or nothing to explain.
    InvalidRecord, RecordTooShort, InvalidBounds
        If a record does not have what the model needs, or a change cannot be used.
    """
    given = dict(changes or {})
    if model.rule is None or not records:
        return model, given
    own = {parameter.name for parameter in model.parameters}
    parameters = override(
        model.parameters, {name: fields for name, fields in given.items() if name in own}
    )
    with one_thread():  # so that the last bit does not depend on the number of cores
        found, lags, coefficients, samples = _found(model, model.rule, records, parameters, skip)
        if model.rule.error == "simulation":
            better = reselected(model, model.rule, records, given, skip, found.order, lags)
            if better is not None:
                found, lags = better.found, better.lags
                coefficients = better.coefficients.tolist()
    resolved = with_terms(model, [model.terms[i].label for i in found.order])
    dropped = frozenset(own - {parameter.name for parameter in resolved.parameters})
    selection = Selection(_told(model, found, coefficients), lags, samples)
    kept = {name: fields for name, fields in given.items() if name not in dropped}
    return replace(resolved, selection=selection), kept


def _found(
    model: Model, rule: TermRule, records: Sequence[Record],
    parameters: Sequence[Parameter], skip: int,
) -> tuple[Forward, dict[str, float], list[float], int]:  # fmt: skip
    regression = Regression.of(model, records, parameters, skip)
    check_samples(len(model.terms), regression.samples)
    values = lag_values(model, parameters, regression.pieces[0].period)
    lags: dict[str, float] = {}
    if values:
        effort = affordable(values, len(model.terms))
        few = regression.thinned(effort.rows)

        def unexplained(tried: Mapping[str, float]) -> float:
            triangle, _ = few.triangle(model.terms, tried)
            return forward(triangle, rule.keep, rule.err).unexplained

        lags = search(values, unexplained, effort.trials)[0].lags
    triangle, samples = regression.triangle(model.terms, lags)
    check_samples(len(model.terms), samples)
    found = select(triangle, rule, samples)
    if not found.order:
        raise InvalidSettings(
            "/model/terms",
            "the output, or every candidate, is zero where it is scored; there is nothing to "
            "explain, so no term can be selected",
        )
    return found, lags, solved(triangle, found.order).tolist(), samples


def _told(model: Model, found: Forward, coefficients: Sequence[float]) -> tuple[SelectedTerm, ...]:
    return tuple(
        SelectedTerm(model.terms[i].label, ratio, 1.0 - left, coefficients[i])
        for i, ratio, left in zip(found.order, found.ratios, found.left, strict=True)
    )
