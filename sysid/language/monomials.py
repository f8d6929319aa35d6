"""Laurent polynomials: ``k - (1 + L/h)`` is collected into the terms k, 1 and L/h.

A polynomial maps each monomial to its coefficient. A monomial is a tuple of (factor, whole
exponent), with negative exponents. The empty monomial is the constant. An expression that is
neither a sum nor a product, such as ``sqrt(L)``, is a factor.
"""

from functools import reduce
from typing import TypeAlias

from sysid.language.tree import Binary, Expression, Number, Unary

Monomial: TypeAlias = tuple[tuple[Expression, int], ...]
LaurentPolynomial: TypeAlias = dict[Monomial, float]

CONSTANT: Monomial = ()

_MAX_TERMS = 64
"""A product with more terms stays one factor."""


def collect_terms(expression: Expression) -> LaurentPolynomial:
    """Collect an expression as a polynomial; equal terms are added, ``h/h`` is 1."""
    match expression:
        case Number(value):
            return {CONSTANT: value} if value else {}
        case Unary("-", operand):
            return scale_polynomial(collect_terms(operand), -1.0)
        case Binary("+", left, right):
            return add_polynomials(collect_terms(left), collect_terms(right))
        case Binary("-", left, right):
            return add_polynomials(
                collect_terms(left), scale_polynomial(collect_terms(right), -1.0)
            )
        case Binary("*", left, right):
            return _multiply_polynomials(collect_terms(left), collect_terms(right), expression)
        case Binary("/", left, right):
            return _multiply_polynomials(collect_terms(left), _invert_expression(right), expression)
        case Binary("**", base, Number(value)) if value.is_integer() and 0 < value <= 8:
            return _raise_polynomial(collect_terms(base), int(value), expression)
        case _:
            return {((expression, 1),): 1.0}


def add_polynomials(a: LaurentPolynomial, b: LaurentPolynomial) -> LaurentPolynomial:
    """Add two polynomials; terms that cancel are removed."""
    total = dict(a)
    for monomial, coefficient in b.items():
        total[monomial] = total.get(monomial, 0.0) + coefficient
    return {monomial: value for monomial, value in total.items() if value}


def scale_polynomial(a: LaurentPolynomial, factor: float) -> LaurentPolynomial:
    """Multiply a polynomial by a number."""
    return {monomial: value * factor for monomial, value in a.items()}


def multiply_factor(a: LaurentPolynomial, factor: Expression) -> LaurentPolynomial:
    """Multiply a polynomial by one factor."""
    return {_merge_monomials(monomial, ((factor, 1),)): value for monomial, value in a.items()}


def to_expression(a: LaurentPolynomial) -> Expression:
    """Build the tree of a polynomial; the constant comes last."""
    ordered = sorted(a.items(), key=lambda term: term[0] == CONSTANT)
    if not ordered:
        return Number(0.0)
    first, *others = ordered
    return reduce(_append_term, others, _build_term(*first))


def _append_term(tree: Expression, term: tuple[Monomial, float]) -> Expression:
    monomial, value = term
    return Binary("-" if value < 0 else "+", tree, _build_term(monomial, abs(value)))


def _build_term(monomial: Monomial, coefficient: float) -> Expression:
    above = [_raise_factor(factor, power) for factor, power in monomial if power > 0]
    below = [_raise_factor(factor, -power) for factor, power in monomial if power < 0]
    if coefficient == -1.0 and above:
        above[0] = Unary("-", above[0])
    elif coefficient != 1.0 or not above:
        above.insert(0, Number(coefficient))
    return reduce(lambda a, b: Binary("/", a, b), below, reduce(_multiply_expressions, above))


def _multiply_expressions(a: Expression, b: Expression) -> Expression:
    return Binary("*", a, b)


def _raise_factor(factor: Expression, power: int) -> Expression:
    return factor if power == 1 else Binary("**", factor, Number(float(power)))


def _merge_monomials(a: Monomial, b: Monomial) -> Monomial:
    powers = dict(a)
    for factor, power in b:
        powers[factor] = powers.get(factor, 0) + power
    # Sorted by text, not by hash: the same model must give the same tree in every process.
    return tuple(sorted(((f, p) for f, p in powers.items() if p), key=lambda item: repr(item)))


def _multiply_polynomials(
    a: LaurentPolynomial, b: LaurentPolynomial, whole: Expression
) -> LaurentPolynomial:
    if len(a) * len(b) > _MAX_TERMS:
        return {((whole, 1),): 1.0}
    total: LaurentPolynomial = {}
    for monomial, value in a.items():
        total = add_polynomials(
            total, {_merge_monomials(monomial, m): value * v for m, v in b.items()}
        )
    return total


def _raise_polynomial(
    base: LaurentPolynomial, exponent: int, whole: Expression
) -> LaurentPolynomial:
    total = base
    for _ in range(exponent - 1):
        total = _multiply_polynomials(total, base, whole)
    return total


def _invert_expression(divisor: Expression) -> LaurentPolynomial:
    terms = collect_terms(divisor)
    if len(terms) != 1:
        return {((divisor, -1),): 1.0}
    [(monomial, value)] = terms.items()
    return {tuple((factor, -power) for factor, power in monomial): 1.0 / value}
