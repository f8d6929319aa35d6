"""Mark the coefficients of a polynomial that depend on which terms were selected."""

from dataclasses import replace

from sysid.models.model import Model, SelectedTerm
from sysid.selection.term_odds import CERTAIN, LEAST_COVERAGE
from sysid.uncertainty.estimates import Estimate


def mark_selection_dependent(estimates: tuple[Estimate, ...], model: Model) -> tuple[Estimate, ...]:
    """Mark identified coefficients whose term is not certain, or that rival selections move."""
    terms = () if model.selection is None else model.selection.terms
    reasons = {f"a[{term.term}]": _explain_doubt(term) for term in terms}
    return tuple(
        replace(estimate, status="selection-dependent", reason=reasons[estimate.name])
        if estimate.status == "identified" and reasons.get(estimate.name)
        else estimate
        for estimate in estimates
    )


def _explain_doubt(term: SelectedTerm) -> str:
    """Explain why a coefficient depends on the selection; empty if it does not."""
    if term.probability < CERTAIN:
        return (
            f"the term belongs to the model with a probability of "
            f"{_write_percent(term.probability)}; the likeliest selection against it is "
            f"{term.rival}"
        )
    if term.coverage < LEAST_COVERAGE:
        return (
            f"over all selections that may be true its 95 % interval holds in "
            f"{_write_percent(term.coverage)}; the one that moves it most is {term.rival}"
        )
    return ""


def _write_percent(share: float) -> str:
    return "less than 1 %" if share < 0.01 else f"{100.0 * share:.0f} %"
