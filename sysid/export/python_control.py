"""Export as a script for python-control: transfer functions with their dead times."""

from sysid.control.linear_form import Identified
from sysid.control.transfer import Quasi, Transfer, Transfers, by_delay, transfers
from sysid.export.description import facts, wrapped
from sysid.export.expressions import number
from sysid.export.identifiers import in_docstring

_WIDTH = 96

_CONTINUOUS = '''\
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
_DISCRETE = '''\
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


def control_source(identified: Identified, pade_order: int) -> str:
    """A script that makes ``systems``: for (input, output) a transfer function of python-control.

    Parameters
    ----------
    identified : Identified
    pade_order : int
        Order of the approximation of dead times in ``systems``; ``response`` has none.

    Raises
    ------
    NotLinear
        If the model has no transfer function; the message says which term is in the way.
    """
    found = transfers(identified)
    if found.period is None:
        body = _CONTINUOUS.replace("@ORDER@", str(pade_order))
        pairs = [_entry(one, *map(_delayed, one[2:])) for one in found.pairs]
    else:
        body = _DISCRETE.replace("@PERIOD@", number(found.period))
        pairs = [_entry(one, *_falling(one)) for one in found.pairs]
    body = body.replace("@PAIRS@", "\n".join(pairs))
    lines = [*facts(identified), *_deviations(identified, found)]
    title, *others = map(in_docstring, lines)
    told = "\n".join([title, "", *others])
    return f'"""{told}\n"""\n\nimport control\nimport numpy as np\n\n{body}'


def _entry(pair: Transfer, numerator: str, denominator: str) -> str:
    lines = []
    for text in (numerator, denominator):
        first, *others = wrapped(text, _WIDTH - 12)
        lines += [f"        {first}", *(f"         {one}" for one in others)]
        lines[-1] += ","
    return "\n".join([f"    ({pair.input!r}, {pair.output!r}): (", *lines, "    ),"])


def _delayed(found: Quasi) -> str:
    """Terms of a quasi-polynomial; that without dead time first, even if it is zero."""
    terms = by_delay(found)
    parts = [f"({number(delay)}, {_listed(powers)})" for delay, powers in terms]
    return f"[{', '.join(parts)}]"


def _falling(pair: Transfer) -> tuple[str, str]:
    both = (pair.numerator, pair.denominator)
    most = max((int(back) for one in both for _, back in one), default=0)
    numerator, denominator = (
        _listed([one.get((0, float(back)), 0.0) for back in range(most + 1)]) for one in both
    )
    return numerator, denominator


def _listed(values: list[float]) -> str:
    return f"[{', '.join(map(number, values))}]"


def _deviations(identified: Identified, found: Transfers) -> list[str]:
    """What the transfer functions leave out."""
    model = identified.model
    constants = [
        f"the output {one.name} has the constant {form.constant:.10g}"
        for one, form in zip(model.outputs, found.linear.outputs, strict=True) if form.constant
    ] + [
        f"the equation of {one.name} has the constant {form.constant:.10g}"
        for one, form in zip(model.states, found.linear.equations, strict=True) if form.constant
    ]  # fmt: skip
    if not constants:
        return []
    return wrapped(f"Transfer functions are of deviations: {'; '.join(constants)}.", 94)
