"""Coefficients of a polynomial that depend on which terms were selected."""

from collections.abc import Iterator, Sequence

from sysid.core.findings import Finding
from sysid.models.model import Model, SelectedTerm
from sysid.selection.term_odds import CERTAIN, LEAST_COVERAGE
from sysid.uncertainty.estimates import Estimate


def find_open_terms(estimates: Sequence[Estimate], model: Model) -> Iterator[Finding]:
    """Find coefficients whose term is not certain, or that rival selections move."""
    terms = () if model.selection is None else model.selection.terms
    doubts = {f"a[{term.term}]": doubt for term in terms if (doubt := _explain_doubt(term))}
    names = [one.name for one in estimates if one.status == "identified" and one.name in doubts]
    depend = "depends" if len(names) == 1 else "depend"
    for name in names:
        yield Finding(
            "selection of terms",
            "structure",
            "caution",
            f"{len(names)} of {len(terms)} coefficients {depend} on the selection of terms",
            f"other selections of terms explain the data about as well. {name}: {doubts[name]}.",
            parameters=(name,),
            reason=doubts[name],
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
