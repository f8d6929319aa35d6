"""Reason of a verdict: coefficients that depend on which terms were selected."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sysid.results.verdict import Evidence, Reason


def find_open_terms(evidence: "Evidence") -> Iterator["Reason"]:
    """Find coefficients that depend on the selection of the polynomial's terms."""
    from sysid.results.verdict import Reason  # that module imports this one

    names = evidence.list_names("selection-dependent")
    if names:
        terms = [estimate for estimate in evidence.free if estimate.name.startswith("a[")]
        depend = "depends" if len(names) == 1 else "depend"
        yield Reason(
            "caution",
            f"{len(names)} of {len(terms)} coefficients {depend} on the selection of terms",
            f"Other selections of terms explain the data about as well. "
            f"{evidence.describe_reasons('selection-dependent')}",
        )
