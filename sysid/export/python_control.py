"""Export as a script for python-control: transfer functions with their dead times."""

from sysid.control.linear_form import IdentifiedModel
from sysid.control.transfer import (
    QuasiPolynomial,
    TransferFunction,
    TransferFunctions,
    compute_transfer_functions,
    group_by_delay,
)
from sysid.export.description import describe_model, wrap_source
from sysid.export.expression_text import write_number
from sysid.export.identifiers import escape_docstring

_LINE_WIDTH = 96

_CONTINUOUS_TEMPLATE = '''\
# numerator and denominator: (dead time in s, coefficients of falling powers of s)
pairs = {
@PAIRS@
}


def response(pair, omega):
    """Frequency response at angular frequencies omega (rad/s), dead times exact."""
    s = 1j*np.asarray(omega, dtype=np.float64)
    numerator, denominator = (
        sum(np.polyval(coefficients, s)*np.exp(-s*delay) for delay, coefficients in terms)
        for terms in pair
    )
    return numerator/denominator


def transfer(pair, order=@ORDER@):
    """Transfer function with a Pade approximation of that order for every dead time."""
    numerator, denominator = pair
    leading = denominator[0][1]

    def delayed(delay, coefficients):
        rational = control.tf(coefficients, leading)
        return rational*control.tf(*control.pade(delay, order)) if delay > 0 else rational

    forward = sum((delayed(*term) for term in numerator), control.tf([0.0], [1.0]))
    if len(denominator) == 1:
        return forward
    loop = sum((delayed(*term) for term in denominator[1:]), control.tf([0.0], [1.0]))
    return forward*control.feedback(control.tf([1.0], [1.0]), loop)


systems = {names: transfer(pair) for names, pair in pairs.items()}
'''
_DISCRETE_TEMPLATE = '''\
period = @PERIOD@  # s
# numerator and denominator: coefficients of falling powers of z
pairs = {
@PAIRS@
}


def response(pair, omega):
    """Frequency response at angular frequencies omega (rad/s)."""
    z = np.exp(1j*np.asarray(omega, dtype=np.float64)*period)
    numerator, denominator = pair
    return np.polyval(numerator, z)/np.polyval(denominator, z)


systems = {names: control.tf(*pair, period) for names, pair in pairs.items()}
'''


def write_control_source(identified: IdentifiedModel, pade_order: int) -> str:
    """Write a script that makes ``systems``: transfer functions by (input, output).

    Parameters
    ----------
    identified : IdentifiedModel
    pade_order : int
        Order of the Padé approximation of dead times in ``systems``; ``response`` is exact.

    Raises
    ------
    NotLinear
        If the model has no transfer function; the message says which term is in the way.
    """
    functions = compute_transfer_functions(identified)
    if functions.period is None:
        body = _CONTINUOUS_TEMPLATE.replace("@ORDER@", str(pade_order))
        pairs = [
            _write_pair(pair, *map(_write_delayed_terms, pair[2:])) for pair in functions.pairs
        ]
    else:
        body = _DISCRETE_TEMPLATE.replace("@PERIOD@", write_number(functions.period))
        pairs = [_write_pair(pair, *_write_fraction(pair)) for pair in functions.pairs]
    body = body.replace("@PAIRS@", "\n".join(pairs))
    lines = [*describe_model(identified), *_describe_constants(identified, functions)]
    title, *others = map(escape_docstring, lines)
    docstring = "\n".join([title, "", *others])
    return f'"""{docstring}\n"""\n\nimport control\nimport numpy as np\n\n{body}'


def _write_pair(pair: TransferFunction, numerator: str, denominator: str) -> str:
    lines = []
    for text in (numerator, denominator):
        first, *others = wrap_source(text, _LINE_WIDTH - 12)
        lines += [f"        {first}", *(f"         {line}" for line in others)]
        lines[-1] += ","
    return "\n".join([f"    ({pair.input!r}, {pair.output!r}): (", *lines, "    ),"])


def _write_delayed_terms(polynomial: QuasiPolynomial) -> str:
    """Write the terms of a quasi-polynomial, the term without dead time first."""
    terms = group_by_delay(polynomial)
    parts = [f"({write_number(delay)}, {_write_list(powers)})" for delay, powers in terms]
    return f"[{', '.join(parts)}]"


def _write_fraction(pair: TransferFunction) -> tuple[str, str]:
    both = (pair.numerator, pair.denominator)
    most = max((int(back) for polynomial in both for _, back in polynomial), default=0)
    numerator, denominator = (
        _write_list([polynomial.get((0, float(back)), 0.0) for back in range(most + 1)])
        for polynomial in both
    )
    return numerator, denominator


def _write_list(values: list[float]) -> str:
    return f"[{', '.join(map(write_number, values))}]"


def _describe_constants(identified: IdentifiedModel, functions: TransferFunctions) -> list[str]:
    """Describe the constants that the transfer functions leave out."""
    model = identified.model
    constants = [
        f"the output {output.name} has the constant {form.constant:.10g}"
        for output, form in zip(model.outputs, functions.linear_form.outputs, strict=True)
        if form.constant
    ] + [
        f"the equation of {state.name} has the constant {form.constant:.10g}"
        for state, form in zip(model.states, functions.linear_form.equations, strict=True)
        if form.constant
    ]
    if not constants:
        return []
    return wrap_source(f"Transfer functions are of deviations: {'; '.join(constants)}.", 94)
