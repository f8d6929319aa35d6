"""Selection of a model's terms on the estimation records."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from sysid.core.errors import InvalidSettings
from sysid.core.settings import PredictionKind
from sysid.core.threads import use_one_thread
from sysid.core.types import FloatArray
from sysid.data.records import Record
from sysid.models.model import Model, SelectedTerm, Selection, TermRule
from sysid.models.parameters import Parameter, override_parameters
from sysid.models.parse import keep_terms
from sysid.models.polynomial import check_candidate_count
from sysid.selection.free_run import FreeRunSelection, FreeRunSelector, fits_in_memory
from sysid.selection.frols import (
    ForwardSelection,
    compute_bic,
    select_forward,
    select_terms,
    solve_coefficients,
)
from sysid.selection.lag_search import list_lag_values, plan_effort, search_lags
from sysid.selection.regression import Regression
from sysid.selection.term_odds import weigh_terms
from sysid.simulation.problem import Problem

ParameterChanges = Mapping[str, Mapping[str, Any]]


class _OneStepSelection(NamedTuple):
    """Terms selected one step ahead, and the regression (M + 1, M + 1) of `samples` rows."""

    forward_selection: ForwardSelection
    triangle: FloatArray
    samples: int
    lags: dict[str, float]

    @property
    def variance(self) -> float:
        """Mean square of what the terms leave of the output."""
        squares = float(self.triangle[:, -1] @ self.triangle[:, -1])
        return self.forward_selection.unexplained_share * squares / self.samples


def select_model_terms(
    model: Model,
    records: Sequence[Record],
    changes: ParameterChanges | None = None,
    skip: int = 0,
    prediction: PredictionKind = "simulation",
) -> tuple[Model, dict[str, Mapping[str, Any]]]:
    """Select the terms of a model by its rule; a model without a rule stays the same.

    Without records the model stays the same, too. Unknown lags are tried at whole samples inside
    their bounds, and the terms are selected at the lags that explain most. The lags stay unknown.
    The `selection` of the model has their values as starts for the search, and how likely each term
    belongs to the model.

    Parameters
    ----------
    model : Model
    records : sequence of Record
        The estimation records.
    changes : mapping of str to mapping
        Changed bounds, scales or fixed values, also of candidates' coefficients.
    skip : int
        Number of first samples of each output that are not scored.
    prediction : {"simulation", "one-step"}
        What the coefficients will be fitted to. One step ahead only that error is considered,
        unless the rule names the other.

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
    rule = model.rule
    if rule is None or not records:
        return model, remaining_changes
    names = {parameter.name for parameter in model.parameters}
    parameters = override_parameters(
        model.parameters,
        {name: fields for name, fields in remaining_changes.items() if name in names},
    )
    with use_one_thread():  # so that the last bit does not depend on the number of cores
        one_step = _select_one_step(model, rule, records, parameters, skip)
        by_free_run = None
        if prediction == "simulation" or rule.error == "simulation":
            candidates = replace(model, rule=None, selection=Selection((), one_step.lags))
            whole = Problem.build(candidates, records, parameters=remaining_changes, skip=skip)
            by_free_run = _select_by_free_run(whole, rule, one_step)
        selection = _describe_selection(model, rule, one_step, by_free_run)
    resolved = keep_terms(model, [term.term for term in selection.terms])
    dropped = frozenset(names - {parameter.name for parameter in resolved.parameters})
    final_changes = {
        name: fields for name, fields in remaining_changes.items() if name not in dropped
    }
    return replace(resolved, selection=selection), final_changes


def _select_by_free_run(
    whole: Problem, rule: TermRule, one_step: _OneStepSelection
) -> FreeRunSelection | None:
    """Select by the free run, or fit the terms of one step ahead if the rule asks for them."""
    if rule.error != "simulation" and not fits_in_memory(whole):
        return None
    selector, order = FreeRunSelector(whole, rule), one_step.forward_selection.order
    if rule.error == "one-step":
        return selector.try_terms(order)
    return selector.select([order, _choose_simple_terms(whole.model, one_step.triangle)])


def _choose_simple_terms(model: Model, triangle: FloatArray) -> tuple[int, ...]:
    """Choose one past value of the output, and all of the inputs.

    Its dynamics are of first order, so no common factor of two polynomials can hide in them.
    """
    linear = [(i, term.factors[0]) for i, term in enumerate(model.terms) if len(term.factors) == 1]
    outputs = [i for i, past in linear if past.kind == "state"]
    inputs = [i for i, past in linear if past.kind != "state"]
    first = select_forward(triangle, 1, among=outputs).order if outputs else ()
    return (*first, *inputs)


def _describe_selection(
    model: Model, rule: TermRule, one_step: _OneStepSelection, by_free_run: FreeRunSelection | None
) -> Selection:
    """Choose one of the selections by the rule, and weigh its terms by the better prediction."""
    is_better = by_free_run is not None and _rate(
        by_free_run.innovation_variance, by_free_run.forward_selection, by_free_run.samples, model
    ) < _rate(one_step.variance, one_step.forward_selection, by_free_run.samples, model)
    simulates = rule.error == "simulation" or (rule.error == "auto" and is_better)
    if by_free_run is not None and simulates:
        selected, lags = by_free_run.forward_selection, by_free_run.lags
        coefficients = by_free_run.coefficients
    else:
        selected, lags = one_step.forward_selection, one_step.lags
        coefficients = solve_coefficients(one_step.triangle, selected.order)
    labels = [term.label for term in model.terms]
    judged = one_step if by_free_run is None or not (is_better or simulates) else by_free_run
    odds = weigh_terms(judged.triangle, selected.order, judged.samples, labels)
    terms = tuple(
        SelectedTerm(labels[i], ratio, 1.0 - unexplained, float(coefficients[i]), *one)
        for i, ratio, unexplained, one in zip(
            selected.order, selected.ratios, selected.unexplained_shares, odds, strict=True
        )
    )
    return Selection(terms, lags, one_step.samples)


def _rate(variance: float, selection: ForwardSelection, samples: int, model: Model) -> float:
    return float(compute_bic(variance, len(selection.order), samples, len(model.terms)))


def _select_one_step(
    model: Model,
    rule: TermRule,
    records: Sequence[Record],
    parameters: Sequence[Parameter],
    skip: int,
) -> _OneStepSelection:
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
    return _OneStepSelection(selection, triangle, samples, lags)
