"""Mark the coefficients of a polynomial that depend on which terms were selected."""

from dataclasses import replace

from sysid.models.model import Model, SelectedTerm
from sysid.selection.term_odds import CERTAIN, MOST_MOVE
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
        percent = max(100.0 * term.probability, 0.0)
        least = "less than 1" if percent < 1.0 else f"{percent:.0f}"
        return (
            f"the term belongs to the model with a probability of {least} %; "
            f"{term.rival} the data may be explained as well"
        )
    if term.move > MOST_MOVE:
        return (
            f"between selections of terms that explain the data it varies by {term.move:.1f} "
            f"standard errors; one is {term.rival}"
        )
    return ""
