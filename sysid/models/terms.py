"""Terms of a polynomial, how many of them are wanted, and what a selection has found."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from sysid.language.printer import text
from sysid.language.tree import Past

Criterion = Literal["none", "bic"]
ErrorKind = Literal["one-step", "simulation"]


class Term(NamedTuple):
    """A product of past values; the empty one is the constant 1."""

    factors: tuple[Past, ...]

    @property
    def label(self) -> str:
        """Text of the product, such as ``y(k-1)**2*u(k-1-dk)``."""
        if not self.factors:
            return "1"
        powers = {text(factor).replace(" ", ""): 0 for factor in self.factors}
        for factor in self.factors:
            powers[text(factor).replace(" ", "")] += 1
        return "*".join(f"{name}**{n}" if n > 1 else name for name, n in powers.items())

    @property
    def coefficient(self) -> str:
        """Name of the term's coefficient: ``a[y(k-1)*u(k-1)]``."""
        return f"a[{self.label}]"


@dataclass(frozen=True, slots=True)
class TermRule:
    """How the terms of a model are to be selected on the data.

    Attributes
    ----------
    keep : int
        Number of terms; with `err` or `criterion` the largest number.
    err : float or None
        Stop when the share of the output's squares that is not explained falls below this.
    criterion : {"none", "bic"}
        ``bic``: the number of terms with the least Bayesian information criterion.
    exchange : bool
        Whether a taken term may give way to a better one afterwards.
    error : {"one-step", "simulation"}
        Which error the terms are to explain; the latter begins with the former.
    """

    keep: int
    err: float | None = None
    criterion: Criterion = "none"
    exchange: bool = True
    error: ErrorKind = "one-step"


class SelectedTerm(NamedTuple):
    """One term in the order of selection.

    Attributes
    ----------
    err : float
        Error-reduction ratio: the share of the output's squares that this term explains beyond
        the terms before it.
    cumulated : float
        Share explained with all terms so far.
    coefficient : float
        Coefficient in the model of all selected terms, before the search: by least squares one
        step ahead, or on the free run where the terms were selected by that.
    """

    term: str
    err: float
    cumulated: float
    coefficient: float


@dataclass(frozen=True, slots=True)
class Selection:
    """What a selection has found.

    Attributes
    ----------
    terms : tuple of SelectedTerm
    lags : mapping of str to float
        Values of the unknown lags at which the terms explain most.
    samples : int
        Rows of the regression.
    dropped : frozenset of str
        Names of the coefficients that the model no longer has.
    """

    terms: tuple[SelectedTerm, ...]
    lags: Mapping[str, float] = field(default_factory=dict)
    samples: int = 0
    dropped: frozenset[str] = frozenset()
