"""Selection of a model's terms on the estimation records."""

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
    """Select the terms of a model by its rule; a model without a rule stays the same.

    Without records the model stays the same, too. Unknown lags are tried at whole samples inside
    their bounds, and the terms are selected at the lags that explain most. The lags stay unknown.
    The `selection` of the model has their values as starts for the search.

    Parameters
    ----------
    model : Model
    records : sequence of Record
        The estimation records.
    changes : mapping of str to mapping
        Changed bounds, scales or fixed values, also of candidates' coefficients.
    skip : int
        Number of first samples of each output that are not scored.

    Returns
    -------
    Model
    dict
        The changes without those of removed coefficients.

    Raises
    ------
    InvalidSettings
        If the records have fewer samples than candidates, or nothing to explain.
    InvalidRecord, RecordTooShort, InvalidBounds
        If a record does not have what the model needs, or a change cannot be used.
    """
    remaining_changes = dict(changes or {})
    if model.rule is None or not records:
        return model, remaining_changes
    names = {parameter.name for parameter in model.parameters}
    parameters = override_parameters(
        model.parameters,
        {name: fields for name, fields in remaining_changes.items() if name in names},
    )
    with use_one_thread():  # so that the last bit does not depend on the number of cores
        selected, lags, coefficients, samples = _select_one_step(
            model, model.rule, records, parameters, skip
        )
        if model.rule.error == "simulation":
            by_free_run = select_by_free_run(
                model, model.rule, records, remaining_changes, skip, selected.order, lags
            )
            if by_free_run is not None:
                selected, lags = by_free_run.forward_selection, by_free_run.lags
                coefficients = by_free_run.coefficients.tolist()
    resolved = keep_terms(model, [model.terms[i].label for i in selected.order])
    dropped = frozenset(names - {parameter.name for parameter in resolved.parameters})
    selection = Selection(_list_selected_terms(model, selected, coefficients), lags, samples)
    final_changes = {
        name: fields for name, fields in remaining_changes.items() if name not in dropped
    }
    return replace(resolved, selection=selection), final_changes


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
        thinned = regression.thin_rows(effort.rows)

        def measure_unexplained(tried: Mapping[str, float]) -> float:
            triangle, _ = thinned.factor_terms(model.terms, tried)
            return select_forward(triangle, rule.keep, rule.err).unexplained_share

        lags = search_lags(values, measure_unexplained, effort.trials)[0].lags
    triangle, samples = regression.factor_terms(model.terms, lags)
    check_candidate_count(len(model.terms), samples)
    selection = select_terms(triangle, rule, samples)
    if not selection.order:
        raise InvalidSettings(
            "/model/terms",
            "no term can be selected: the output, or every candidate, is zero at all scored "
            "samples",
        )
    return selection, lags, solve_coefficients(triangle, selection.order).tolist(), samples


def _list_selected_terms(
    model: Model, selection: ForwardSelection, coefficients: Sequence[float]
) -> tuple[SelectedTerm, ...]:
    return tuple(
        SelectedTerm(model.terms[i].label, ratio, 1.0 - unexplained, coefficients[i])
        for i, ratio, unexplained in zip(
            selection.order, selection.ratios, selection.unexplained_shares, strict=True
        )
    )
