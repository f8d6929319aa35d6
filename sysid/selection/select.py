"""Resolving a model whose terms are to be selected on the estimation records."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from sysid.core.errors import InvalidSettings
from sysid.core.threads import use_one_thread
from sysid.data.records import Record
from sysid.models.model import Model, SelectedTerm, Selection, TermRule
from sysid.models.parameters import Parameter, override_parameters
from sysid.models.parse import keep_terms
from sysid.models.polynomial import check_candidate_count
from sysid.selection.free_run import select_by_free_run
from sysid.selection.frols import ForwardSelection, select_forward, select_terms, solve_coefficients
from sysid.selection.lag_search import list_lag_values, plan_effort, search_lags
from sysid.selection.regression import Regression

ParameterChanges = Mapping[str, Mapping[str, Any]]


def select_model_terms(
    model: Model, records: Sequence[Record], changes: ParameterChanges | None = None, skip: int = 0
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
    parameters = override_parameters(
        model.parameters, {name: fields for name, fields in given.items() if name in own}
    )
    with use_one_thread():  # so that the last bit does not depend on the number of cores
        found, lags, coefficients, samples = _select_one_step(
            model, model.rule, records, parameters, skip
        )
        if model.rule.error == "simulation":
            better = select_by_free_run(model, model.rule, records, given, skip, found.order, lags)
            if better is not None:
                found, lags = better.forward_selection, better.lags
                coefficients = better.coefficients.tolist()
    resolved = keep_terms(model, [model.terms[i].label for i in found.order])
    dropped = frozenset(own - {parameter.name for parameter in resolved.parameters})
    selection = Selection(_list_selected_terms(model, found, coefficients), lags, samples)
    kept = {name: fields for name, fields in given.items() if name not in dropped}
    return replace(resolved, selection=selection), kept


def _select_one_step(
    model: Model,
    rule: TermRule,
    records: Sequence[Record],
    parameters: Sequence[Parameter],
    skip: int,
) -> tuple[ForwardSelection, dict[str, float], list[float], int]:
    regression = Regression.from_records(model, records, parameters, skip)
    check_candidate_count(len(model.terms), regression.most_rows)
    values = list_lag_values(model, parameters, regression.experiments[0].period)
    lags: dict[str, float] = {}
    if values:
        effort = plan_effort(values, len(model.terms))
        few = regression.thin_rows(effort.rows)

        def unexplained(tried: Mapping[str, float]) -> float:
            triangle, _ = few.factor_terms(model.terms, tried)
            return select_forward(triangle, rule.keep, rule.err).unexplained

        lags = search_lags(values, unexplained, effort.trials)[0].lags
    triangle, samples = regression.factor_terms(model.terms, lags)
    check_candidate_count(len(model.terms), samples)
    found = select_terms(triangle, rule, samples)
    if not found.order:
        raise InvalidSettings(
            "/model/terms",
            "the output, or every candidate, is zero where it is scored; there is nothing to "
            "explain, so no term can be selected",
        )
    return found, lags, solve_coefficients(triangle, found.order).tolist(), samples


def _list_selected_terms(
    model: Model, found: ForwardSelection, coefficients: Sequence[float]
) -> tuple[SelectedTerm, ...]:
    return tuple(
        SelectedTerm(model.terms[i].label, ratio, 1.0 - left, coefficients[i])
        for i, ratio, left in zip(found.order, found.ratios, found.unexplained_shares, strict=True)
    )
