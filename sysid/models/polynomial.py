"""Kolmogorov–Gabor polynomials: a document of lags and a degree to one difference equation.

The paper's Eq. 2–3 sum over all index pairs, which counts each mixed product twice. Here each
monomial occurs once, i ≤ j ≤ …: C(s + m, m) - 1 coefficients for s past values and degree m.
"""

from collections.abc import Mapping, Sequence
from functools import reduce
from itertools import combinations_with_replacement
from math import comb
from typing import Any, NamedTuple, cast, get_args

from sysid.core.errors import InvalidBounds, InvalidSettings, join_pointer, nearest
from sysid.language.checker import check
from sysid.language.delays import delay
from sysid.language.printer import text
from sysid.language.scope import Scope
from sysid.language.tree import Binary, Expression, Number, Past, Symbol
from sysid.models.documents import Reader, shown
from sysid.models.equations import note
from sysid.models.model import Criterion, ErrorKind, Term, TermRule
from sysid.models.parameters import Parameter, Scale
from sysid.models.sections import MAX_PARAMETERS

FIELDS = ("output", "degree", "lags", "coefficients", "constant", "terms")

MAX_CANDIDATES = 512
"""Terms that a selection may choose from."""

_MAX_DEGREE = 9
_SELECTORS = ("frols",)
_RULE_FIELDS = ("select", "keep", "err", "criterion", "exchange", "error", "candidates")


def check_samples(candidates: int, samples: int) -> None:
    """Raise if a selection has more candidates than samples to tell them apart by.

    Raises
    ------
    InvalidSettings
    """
    if samples < candidates:
        raise InvalidSettings(
            "/model/terms",
            f"{candidates} candidates cannot be told apart by {samples} samples; give longer "
            "records, a lower degree or fewer lags",
        )


class Polynomial(NamedTuple):
    """The right-hand side of y(k) = …, its coefficients and terms.

    With a rule the terms are candidates, and so are the coefficients.
    """

    tree: Expression
    coefficients: tuple[Parameter, ...]
    terms: tuple[Term, ...]
    rule: TermRule | None


def expand(reader: Reader, fields: Mapping[str, Any], scope: Scope) -> Polynomial:
    """What a document's lags, degree and terms say."""
    known, written = reader.count(), fields.get("terms", "all")
    selects = isinstance(written, Mapping)
    terms = _candidates(reader, fields, scope) if selects else _terms(reader, fields, scope)
    if _wants_constant(reader, fields):
        terms = (*terms, Term(()))
    if not selects and len(terms) > MAX_PARAMETERS:
        detail = f"gives {len(terms)} coefficients; at most {MAX_PARAMETERS} are allowed"
        reader.fault("/terms", detail)
        terms = ()
    # Where lags or degree are at fault it is not known how many candidates there will be.
    candidates = len(terms) if reader.count() == known else 0
    rule = _rule(reader, written, candidates) if selects else None
    coefficients = _coefficients(reader, fields.get("coefficients"), terms)
    return Polynomial(_sum([_product(term) for term in terms]), coefficients, terms, rule)


def _rule(reader: Reader, written: Mapping[str, Any], candidates: int) -> TermRule:
    fields = reader.section(written, "/terms", _RULE_FIELDS)
    if reader.required(fields, "select", "/terms", "name the selector: frols") is not None:
        reader.choice(fields["select"], _SELECTORS, "/terms/select")
    criterion = reader.choice(
        fields.get("criterion", "none"), get_args(Criterion), "/terms/criterion"
    )
    exchange = _truth(reader, fields.get("exchange", True), "/terms/exchange")
    err = None if fields.get("err") is None else _share(reader, fields["err"])
    most, keep = min(candidates, MAX_PARAMETERS), fields.get("keep")
    if keep is None and err is None and fields.get("criterion", "none") == "none":
        reader.fault("/terms/keep", "is missing; say how many terms to keep, such as 8")
    error = reader.choice(fields.get("error", "one-step"), get_args(ErrorKind), "/terms/error")
    # Without candidates, that is the fault to tell.
    all_of_them = keep is None or most == 0
    number = max(most, 1) if all_of_them else _kept(reader, keep, candidates, most)
    return TermRule(number, err, cast(Criterion, criterion), exchange, cast(ErrorKind, error))


def _share(reader: Reader, written: object) -> float:
    err = reader.number(written, "/terms/err", 0.5)
    if not 0 < err < 1:
        need = "need a share between 0 and 1 that may stay unexplained, such as 1e-4"
        reader.fault("/terms/err", f"found {err:g}; {need}")
    return err


def _kept(reader: Reader, keep: object, candidates: int, most: int) -> int:
    is_whole = isinstance(keep, int) and not isinstance(keep, bool)
    if is_whole and cast(int, keep) > most:
        few = f"the document has {candidates} candidate terms" if most == candidates else (
            f"a model may have {most} coefficients")  # fmt: skip
        reader.fault("/terms/keep", f"found {keep}, but {few}; need 1 to {most}")
        return most
    return reader.whole(keep, "/terms/keep", 1, most)


def _candidates(reader: Reader, fields: Mapping[str, Any], scope: Scope) -> tuple[Term, ...]:
    written = fields["terms"].get("candidates", "all")
    if isinstance(written, list | tuple):
        return _listed(reader, written, scope, "/terms/candidates", MAX_CANDIDATES)
    if written != "all":
        detail = f"{shown(written)} is not 'all' or a list of terms"
        reader.fault("/terms/candidates", detail)
    return _all_terms(reader, fields, scope, MAX_CANDIDATES)


def _wants_constant(reader: Reader, fields: Mapping[str, Any]) -> bool:
    return _truth(reader, fields.get("constant", False), "/constant")


def _truth(reader: Reader, found: object, place: str) -> bool:
    if not isinstance(found, bool):
        reader.fault(place, f"{shown(found)} is not true or false")
    return found is True


def _terms(reader: Reader, fields: Mapping[str, Any], scope: Scope) -> tuple[Term, ...]:
    written = fields.get("terms", "all")
    if isinstance(written, list | tuple):
        if not written and fields.get("constant") is True:
            return ()  # the constant alone
        return _listed(reader, written, scope, "/terms", MAX_PARAMETERS)
    if written != "all":
        need = "is not 'all' or a list of terms, nor asks for a selection"
        reader.fault("/terms", f"{shown(written)} {need}")
    return _all_terms(reader, fields, scope, MAX_PARAMETERS)


def _all_terms(
    reader: Reader, fields: Mapping[str, Any], scope: Scope, most: int
) -> tuple[Term, ...]:
    highest = reader.required(fields, "degree", "", "it is the largest number of factors in a term")
    degree = 1 if highest is None else reader.whole(highest, "/degree", 1, _MAX_DEGREE)
    values = _regressors(reader, fields, scope)
    count = comb(len(values) + degree, degree) - 1
    if count > most:
        what = "coefficients" if most == MAX_PARAMETERS else "candidates"
        detail = (
            f"degree {degree} of {len(values)} past values gives {count} {what}; at most "
            f"{most} are allowed: lower it, or list the terms"
        )
        reader.fault("/degree", detail)
        return ()
    return tuple(
        Term(factors)
        for size in range(1, degree + 1)
        for factors in combinations_with_replacement(values, size)
    )


def _regressors(reader: Reader, fields: Mapping[str, Any], scope: Scope) -> tuple[Past, ...]:
    """V1 … Vs of Eq. 2: the past values that the document's lags name."""
    lags = reader.required(fields, "lags", "", "name the past values, such as {y: [1], u: [1]}")
    found: list[Past] = []
    for name, entries in reader.section(lags, "/lags").items():
        place = join_pointer("lags", name)
        if name not in scope.signals:
            reader.fault(place, f"there is no such signal{nearest(name, scope.signals)}")
        elif not isinstance(entries, list | tuple) or not entries:
            reader.fault(place, f"{shown(entries)} is not a list of lags in samples")
        else:
            found += [
                value
                for number, entry in enumerate(entries)
                if (value := _regressor(reader, name, entry, f"{place}/{number}", scope))
            ]
    for number, value in enumerate(found):
        if value in found[:number]:
            reader.fault(join_pointer("lags", value.name), f"{text(value)} is listed twice")
    return tuple(found)


def _regressor(reader: Reader, name: str, entry: object, place: str, scope: Scope) -> Past | None:
    known = reader.count()
    silent = Scope("difference", parameters=scope.parameters, constants=scope.constants)
    checked = check(reader.expression(entry, place), silent)
    note(reader, checked, place)
    if reader.count() > known or checked.tree is None:
        return None
    found = delay(Binary("-", Symbol("k", "index"), checked.tree), scope)
    if isinstance(found, str):
        reader.fault(place, found)
        return None
    value = Past(name, "state" if name in scope.states else "input", *found)
    return _not_present(reader, value, place)


def _not_present(reader: Reader, value: Past, place: str) -> Past | None:
    if value.kind == "state" and value.offset == 0:
        detail = f"{text(value)} may reach the present {value.name}(k); need a lag of 1 or more"
        reader.fault(place, detail)
        return None
    return value


def _listed(
    reader: Reader, written: Sequence[object], scope: Scope, where: str, most: int
) -> tuple[Term, ...]:
    terms: list[Term] = []
    if not written:
        reader.fault(where, "the list is empty; name at least one term, such as y(k-1)")
    if len(written) > most:
        reader.fault(where, f"has {len(written)} terms; at most {most} are allowed")
    for number, one in enumerate(written[:most]):
        place, known = f"{where}/{number}", reader.count()
        checked = check(reader.expression(one, place), scope)
        note(reader, checked, place)
        if checked.tree is None or reader.count() > known:
            continue
        factors = _factors(checked.tree)
        if factors is None:
            detail = "a term is a product of past values, such as y(k-1)*u(k-1-dk)**2"
            reader.fault(place, detail)
        elif Term(factors).label in {term.label for term in terms}:
            reader.fault(place, f"{Term(factors).label} is listed twice")
        elif all(_not_present(reader, value, place) for value in factors):
            terms.append(Term(factors))
    return tuple(terms)


def _factors(tree: Expression) -> tuple[Past, ...] | None:
    """The past values whose product a tree is, states first; None if it is none."""
    match tree:
        case Past():
            return (tree,)
        case Binary("*", left, right):
            first, second = _factors(left), _factors(right)
            if first is None or second is None:
                return None
            return tuple(sorted(first + second, key=lambda v: (v.kind == "input", text(v))))
        case Binary("**", Past() as base, Number(power)) if power in range(1, _MAX_DEGREE + 1):
            return (base,) * int(power)
        case _:
            return None


def _coefficients(reader: Reader, entry: object, terms: Sequence[Term]) -> tuple[Parameter, ...]:
    known = reader.count()
    fields = reader.section(entry, "/coefficients", ("lower", "upper", "scale", "unit"))
    ends = {}
    for bound in ("lower", "upper"):
        value = reader.required(fields, bound, "/coefficients", "it bounds every coefficient")
        ends[bound] = 0.0 if value is None else reader.number(value, f"/coefficients/{bound}")
    unit = reader.unit(fields.get("unit"), "/coefficients/unit")
    scale = reader.choice(fields.get("scale", "linear"), ("linear", "log"), "/coefficients/scale")
    if reader.count() > known:
        return ()
    try:
        return tuple(
            Parameter(term.coefficient, ends["lower"], ends["upper"], unit, cast(Scale, scale))
            for term in terms
        )
    except InvalidBounds as error:
        reader.fault("/coefficients", str(error))
        return ()


def _product(term: Term) -> Expression:
    coefficient: Expression = Symbol(term.coefficient, "parameter")
    return reduce(lambda a, b: Binary("*", a, b), term.factors, coefficient)


def _sum(terms: Sequence[Expression]) -> Expression:
    """The sum in halves: hundreds of terms, yet a shallow tree."""
    if not terms:
        return Number(0.0)
    if len(terms) == 1:
        return terms[0]
    middle = len(terms) // 2
    return Binary("+", _sum(terms[:middle]), _sum(terms[middle:]))
