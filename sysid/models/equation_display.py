"""Equations of a model as a reader writes them: as text, and as MathML for a page."""

import re
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

from sysid.language.mathml import format_mathml, format_name, format_table, format_terms
from sysid.models.model import Model, ModelForm, Term

MAX_SHOWN_TERMS = 30
"""Most terms of a polynomial that are shown; the others are counted."""
_LINE_LETTERS = 44
"""Letters of a line, after which a long sum goes on in a new one."""
_NAMESPACE = "http://www.w3.org/1998/Math/MathML"


class DisplayedEquation(NamedTuple):
    """An equation to show.

    Attributes
    ----------
    text : str
        ``dx/dt = (K*u(t - L) - x)/T``; a screen reader reads it aloud.
    mathml : str
        The same as a ``<math>`` element, with `text` as its label.
    """

    text: str
    mathml: str


def format_equations(model: Model) -> tuple[DisplayedEquation, ...]:
    """Format the equations of a model, its intermediate names and its outputs, in this order.

    Constants and intermediate names keep their names. A polynomial is one sum of its terms; with
    a rule of selection they are the candidates.

    Examples
    --------
    >>> from sysid.models.catalogue.load import load_model
    >>> [equation.text for equation in format_equations(load_model("fopdt"))]
    ['dx/dt = (K*u(t - L) - x)/T', 'y = x + y0']
    """
    if model.form == "polynomial":
        return (_format_polynomial(model),)
    document = model.document
    equations = [
        _format_equation(*_name_left_side(state, model.form), text)
        for state, text in document["equations"].items()
    ]
    outputs = {name: output["expression"] for name, output in document["outputs"].items()}
    equations += [
        _format_equation(name, format_name(name), text)
        for name, text in (*document.get("let", {}).items(), *outputs.items())
        if text != name
    ]
    return tuple(equations)


def _name_left_side(state: str, form: ModelForm) -> tuple[str, str]:
    """Write what an equation gives, as text and as MathML: dx/dt, or x(k)."""
    name = format_name(state)
    if form == "differential":
        upright = '<mi mathvariant="normal">d</mi>'
        parts = f"<mrow>{upright}{name}</mrow><mrow>{upright}<mi>t</mi></mrow>"
        return f"d{state}/dt", f"<mfrac>{parts}</mfrac>"
    return f"{state}(k)", f"{name}<mo>\u2061</mo><mrow><mo>(</mo><mi>k</mi><mo>)</mo></mrow>"


def _format_equation(left_text: str, left: str, text: str) -> DisplayedEquation:
    return _join_sides(left_text, left, text, format_terms(text))


def _format_polynomial(model: Model) -> DisplayedEquation:
    [output] = model.outputs
    shown, hidden = model.terms[:MAX_SHOWN_TERMS], len(model.terms[MAX_SHOWN_TERMS:])
    texts = [_write_term(term) for term in shown]
    terms = [_format_term(term) for term in shown]
    if hidden:
        texts.append(f"{hidden} more terms")
        terms.append(f"<mtext>{hidden} more terms</mtext>")
    terms[1:] = [f'<mo form="infix">+</mo>{term}' for term in terms[1:]]
    return _join_sides(*_name_left_side(output.name, model.form), " + ".join(texts), terms)


def _write_term(term: Term) -> str:
    return f"{term.coefficient_name}*{term.label}" if term.factors else term.coefficient_name


def _format_term(term: Term) -> str:
    """Format a term with its coefficient, whose subscript is the term."""
    product = format_mathml(term.label)
    coefficient = f"<msub><mi>a</mi><mrow>{product}</mrow></msub>"
    return f"{coefficient}<mo>⋅</mo>{product}" if term.factors else coefficient


def _join_sides(left_text: str, left: str, text: str, terms: Sequence[str]) -> DisplayedEquation:
    """Join both sides; a long sum has several lines."""
    whole = f"{left_text} = {text}"
    lines = _break_lines(terms)
    right = lines[0]
    if len(lines) > 1:
        right = format_table([line] for line in lines)
    head = f'<math xmlns="{_NAMESPACE}" displaystyle="true" aria-label="{escape(whole)}">'
    return DisplayedEquation(whole, f"{head}{left}<mo>=</mo>{right}</math>")


def _break_lines(terms: Sequence[str]) -> list[str]:
    """Distribute the terms of a sum over lines."""
    lines, length = [""], 0
    for term in terms:
        width = _count_letters(term)
        if length and length + width > _LINE_LETTERS:
            lines.append("")
            length = 0
        lines[-1] += term
        length += width
    return lines


def _count_letters(mathml: str) -> int:
    return len(re.sub(r"<[^>]*>", "", mathml))
