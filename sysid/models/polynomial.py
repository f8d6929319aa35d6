"""Kolmogorov–Gabor polynomials: from lags and a degree to one difference equation.

The paper's Eq. 2–3 sum over all index pairs and count each mixed product twice. Here each
monomial occurs once, i ≤ j ≤ …: C(s + m, m) - 1 coefficients for s past values and degree m.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from itertools import combinations_with_replacement, groupby
from math import comb
from typing import Any, NamedTuple, cast, get_args

from sysid.core.errors import InvalidBounds, InvalidSettings, join_pointer, suggest_name
from sysid.language.checker import check_expression
from sysid.language.delays import has_varying_delay, split_index
from sysid.language.printer import format_expression
from sysid.language.scope import Scope
from sysid.language.tree import Binary, Expression, Number, PastValue, Symbol
from sysid.models.document_reader import DocumentReader, quote_value
from sysid.models.equations import add_faults
from sysid.models.model import Criterion, ErrorKind, Term, TermRule
from sysid.models.parameters import Parameter, ParameterScale
from sysid.models.sections import MAX_PARAMETERS

POLYNOMIAL_FIELDS = ("output", "degree", "lags", "coefficients", "constant", "terms")

MAX_CANDIDATES = 512
"""Most candidate terms of a selection."""

_MAX_DEGREE = 9
_SELECTORS = ("frols",)
_RULE_FIELDS = ("select", "keep", "err", "criterion", "exchange", "error", "candidates")


def check_candidate_count(candidates: int, samples: int) -> None:
    """Raise if a selection has more candidates than samples.

    Raises
    ------
    InvalidSettings
        If so.
    """
    if samples < candidates:
        raise InvalidSettings(
            "/model/terms",
            f"{candidates} candidates cannot be distinguished with {samples} samples; give longer "
            "records, a lower degree or fewer lags",
        )


class PolynomialEquation(NamedTuple):
    """Right-hand side of y(k) = …, with its coefficients and terms.

    With a rule, terms and coefficients are those of the candidates.
    """

    tree: Expression
    coefficients: tuple[Parameter, ...]
    terms: tuple[Term, ...]
    rule: TermRule | None


def expand_polynomial(
    reader: DocumentReader, fields: Mapping[str, Any], scope: Scope
) -> PolynomialEquation:
    """Build the equation from a document's lags, degree and terms."""
    faults_before, written = reader.count_faults(), fields.get("terms", "all")
    selects = isinstance(written, Mapping)
    terms = (
        _read_candidates(reader, fields, scope) if selects else _read_terms(reader, fields, scope)
    )
    if _wants_constant(reader, fields):
        terms = (*terms, Term(()))
    if not selects and len(terms) > MAX_PARAMETERS:
        detail = f"gives {len(terms)} coefficients; at most {MAX_PARAMETERS} are allowed"
        reader.add_fault("/terms", detail)
        terms = ()
    # With faults in lags or degree the number of candidates is unknown.
    candidates = len(terms) if reader.count_faults() == faults_before else 0
    rule = _read_rule(reader, written, candidates) if selects else None
    coefficients = _read_coefficients(reader, fields.get("coefficients"), terms)
    return PolynomialEquation(
        _build_sum([_build_product(term) for term in terms]), coefficients, terms, rule
    )


def _read_rule(reader: DocumentReader, written: Mapping[str, Any], candidates: int) -> TermRule:
    fields = reader.read_section(written, "/terms", _RULE_FIELDS)
    if reader.require_field(fields, "select", "/terms", "name the selector: frols") is not None:
        reader.read_choice(fields["select"], _SELECTORS, "/terms/select")
    criterion = reader.read_choice(
        fields.get("criterion", "none"), get_args(Criterion), "/terms/criterion"
    )
    exchange = _read_flag(reader, fields.get("exchange", True), "/terms/exchange")
    err = None if fields.get("err") is None else _read_share(reader, fields["err"])
    most, keep = min(candidates, MAX_PARAMETERS), fields.get("keep")
    if keep is None and err is None and fields.get("criterion", "none") == "none":
        reader.add_fault("/terms/keep", "is missing; say how many terms to keep, such as 8")
    error = reader.read_choice(fields.get("error", "auto"), get_args(ErrorKind), "/terms/error")
    # Without candidates another fault has been reported already.
    keeps_all = keep is None or most == 0
    number = max(most, 1) if keeps_all else _read_term_count(reader, keep, candidates, most)
    return TermRule(number, err, cast(Criterion, criterion), exchange, cast(ErrorKind, error))


def _read_share(reader: DocumentReader, written: object) -> float:
    err = reader.read_number(written, "/terms/err", 0.5)
    if not 0 < err < 1:
        need = "need a share between 0 and 1 that may stay unexplained, such as 1e-4"
        reader.add_fault("/terms/err", f"found {err:g}; {need}")
    return err


def _read_term_count(reader: DocumentReader, keep: object, candidates: int, most: int) -> int:
    is_whole = isinstance(keep, int) and not isinstance(keep, bool)
    if is_whole and cast(int, keep) > most:
        limit = (
            f"the document has {candidates} candidate terms"
            if most == candidates
            else (f"a model may have {most} coefficients")
        )
        reader.add_fault("/terms/keep", f"found {keep}, but {limit}; need 1 to {most}")
        return most
    return reader.read_whole_number(keep, "/terms/keep", 1, most)


def _read_candidates(
    reader: DocumentReader, fields: Mapping[str, Any], scope: Scope
) -> tuple[Term, ...]:
    written = fields["terms"].get("candidates", "all")
    if isinstance(written, list | tuple):
        return _read_listed_terms(reader, written, scope, "/terms/candidates", MAX_CANDIDATES)
    if written != "all":
        detail = f"{quote_value(written)} is not 'all' or a list of terms"
        reader.add_fault("/terms/candidates", detail)
    return _build_all_terms(reader, fields, scope, MAX_CANDIDATES)


def _wants_constant(reader: DocumentReader, fields: Mapping[str, Any]) -> bool:
    return _read_flag(reader, fields.get("constant", False), "/constant")


def _read_flag(reader: DocumentReader, value: object, pointer: str) -> bool:
    if not isinstance(value, bool):
        reader.add_fault(pointer, f"{quote_value(value)} is not true or false")
    return value is True


def _read_terms(
    reader: DocumentReader, fields: Mapping[str, Any], scope: Scope
) -> tuple[Term, ...]:
    written = fields.get("terms", "all")
    if isinstance(written, list | tuple):
        if not written and fields.get("constant") is True:
            return ()  # the constant alone
        return _read_listed_terms(reader, written, scope, "/terms", MAX_PARAMETERS)
    if written != "all":
        need = "is not 'all', a list of terms or a selection"
        reader.add_fault("/terms", f"{quote_value(written)} {need}")
    return _build_all_terms(reader, fields, scope, MAX_PARAMETERS)


def _build_all_terms(
    reader: DocumentReader, fields: Mapping[str, Any], scope: Scope, most: int
) -> tuple[Term, ...]:
    highest = reader.require_field(
        fields, "degree", "", "it is the largest number of factors in a term"
    )
    degree = 1 if highest is None else reader.read_whole_number(highest, "/degree", 1, _MAX_DEGREE)
    values = _read_regressors(reader, fields, scope)
    count = comb(len(values) + degree, degree) - 1
    if count > most:
        kind = "coefficients" if most == MAX_PARAMETERS else "candidates"
        detail = (
            f"degree {degree} of {len(values)} past values gives {count} {kind}; at most "
            f"{most} are allowed. Lower the degree, or list the terms."
        )
        reader.add_fault("/degree", detail)
        return ()
    return tuple(
        Term(factors)
        for size in range(1, degree + 1)
        for factors in combinations_with_replacement(values, size)
    )


def _read_regressors(
    reader: DocumentReader, fields: Mapping[str, Any], scope: Scope
) -> tuple[PastValue, ...]:
    """Read the regressors V1 … Vs of Eq. 2 from the document's lags."""
    lags = reader.require_field(
        fields, "lags", "", "name the past values, such as {y: [1], u: [1]}"
    )
    regressors: list[PastValue] = []
    for name, entries in reader.read_section(lags, "/lags").items():
        pointer = join_pointer("lags", name)
        if name not in scope.signals:
            reader.add_fault(pointer, f"there is no such signal{suggest_name(name, scope.signals)}")
        elif not isinstance(entries, list | tuple) or not entries:
            reader.add_fault(pointer, f"{quote_value(entries)} is not a list of lags in samples")
        else:
            regressors += [
                value
                for number, entry in enumerate(entries)
                if (value := _read_regressor(reader, name, entry, f"{pointer}/{number}", scope))
            ]
    for number, value in enumerate(regressors):
        if value in regressors[:number]:
            reader.add_fault(
                join_pointer("lags", value.name), f"{format_expression(value)} is listed twice"
            )
    return tuple(regressors)


def _read_regressor(
    reader: DocumentReader, name: str, entry: object, pointer: str, scope: Scope
) -> PastValue | None:
    faults_before = reader.count_faults()
    parameter_scope = replace(scope, states=(), inputs=())
    checked = check_expression(reader.read_expression(entry, pointer), parameter_scope)
    add_faults(reader, checked, pointer)
    for value, column in checked.uses:  # of an intermediate name
        detail = f"the lag depends on {value.name!r}; it consists of parameters and constants only"
        reader.add_fault(pointer, detail, column)
    if reader.count_faults() > faults_before or checked.tree is None:
        return None
    index = split_index(Binary("-", Symbol("k", "index"), checked.tree), scope)
    if isinstance(index, str):
        reader.add_fault(pointer, index)
        return None
    value = PastValue(name, "state" if name in scope.states else "input", *index)
    return _reject_present(reader, value, pointer)


def _reject_present(reader: DocumentReader, value: PastValue, pointer: str) -> PastValue | None:
    if has_varying_delay(value):
        reader.add_fault(pointer, "the lags of a polynomial do not change with inputs")
        return None
    if value.kind == "state" and value.offset == 0:
        detail = (
            f"{format_expression(value)} may reach the present {value.name}(k); "
            "need a lag of 1 or more"
        )
        reader.add_fault(pointer, detail)
        return None
    return value


def _read_listed_terms(
    reader: DocumentReader, written: Sequence[object], scope: Scope, where: str, most: int
) -> tuple[Term, ...]:
    terms: dict[str, Term] = {}
    if not written:
        reader.add_fault(where, "the list is empty; name at least one term, such as y(k-1)")
    if len(written) > most:
        reader.add_fault(where, f"has {len(written)} terms; at most {most} are allowed")
    for number, entry in enumerate(written[:most]):
        pointer, faults_before = f"{where}/{number}", reader.count_faults()
        checked = check_expression(reader.read_expression(entry, pointer), scope)
        add_faults(reader, checked, pointer)
        if checked.tree is None or reader.count_faults() > faults_before:
            continue
        factors = _split_factors(checked.tree)
        term = Term(_sort_factors(factors or ()))
        if factors is None:
            detail = "a term is a product of past values, such as y(k-1)*u(k-1-dk)**2"
            reader.add_fault(pointer, detail)
        elif (label := term.label) in terms:
            reader.add_fault(pointer, f"{label} is listed twice")
        elif all(_reject_present(reader, value, pointer) for value in factors):
            terms[label] = term
    return tuple(terms.values())


def _split_factors(tree: Expression) -> tuple[PastValue, ...] | None:
    """Split a product into its past values; None if it is not such a product."""
    match tree:
        case PastValue():
            return (tree,)
        case Binary("*", left, right):
            first, second = _split_factors(left), _split_factors(right)
            return None if first is None or second is None else first + second
        case Binary("**", PastValue() as base, Number(power)) if power in range(1, _MAX_DEGREE + 1):
            return (base,) * int(power)
        case _:
            return None


def _sort_factors(factors: Sequence[PastValue]) -> tuple[PastValue, ...]:
    """Sort factors by their texts, states first."""
    return tuple(sorted(factors, key=lambda v: (v.kind == "input", format_expression(v))))


def _read_coefficients(
    reader: DocumentReader, entry: object, terms: Sequence[Term]
) -> tuple[Parameter, ...]:
    faults_before = reader.count_faults()
    fields = reader.read_section(entry, "/coefficients", ("lower", "upper", "scale", "unit"))
    ends = {}
    for bound in ("lower", "upper"):
        value = reader.require_field(fields, bound, "/coefficients", "it bounds every coefficient")
        ends[bound] = 0.0 if value is None else reader.read_number(value, f"/coefficients/{bound}")
    unit = reader.read_unit(fields.get("unit"), "/coefficients/unit")
    scale = reader.read_choice(
        fields.get("scale", "linear"), ("linear", "log"), "/coefficients/scale"
    )
    if reader.count_faults() > faults_before:
        return ()
    try:
        return tuple(
            Parameter(
                term.coefficient_name,
                ends["lower"],
                ends["upper"],
                unit,
                cast(ParameterScale, scale),
            )
            for term in terms
        )
    except InvalidBounds as error:
        reader.add_fault("/coefficients", str(error))
        return ()


def _build_product(term: Term) -> Expression:
    """Multiply a coefficient by powers of past values, which terms have in common."""
    coefficient: Expression = Symbol(term.coefficient_name, "parameter")
    powers = (
        value
        if (count := sum(1 for _ in equal)) == 1
        else Binary("**", value, Number(float(count)))
        for value, equal in groupby(term.factors)
    )
    return reduce(lambda a, b: Binary("*", a, b), powers, coefficient)


def _build_sum(terms: Sequence[Expression]) -> Expression:
    """Add terms in halves, so that the tree of hundreds of terms stays shallow."""
    if not terms:
        return Number(0.0)
    if len(terms) == 1:
        return terms[0]
    middle = len(terms) // 2
    return Binary("+", _build_sum(terms[:middle]), _build_sum(terms[middle:]))
