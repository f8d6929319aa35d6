"""Words and signs of other languages, and what they are here; for messages."""

_CHOICE = "write where(condition, a, b) for a choice"
_TABLE = "write table(u, [x1, x2], [y1, y2]) for a lookup table"

SIGNS = {
    "^": "write ** for a power",
    "=": "write == to compare, inside where(…)",
    "−": "write the ASCII minus sign -",
    "–": "write the ASCII minus sign -",
    "·": "write * for a product",
    "×": "write * for a product",
    "÷": "write / for a quotient",
    "≤": "write <=",
    "≥": "write >=",
    "≠": "write !=",
    "√": "write sqrt(…) for a root",
    ".": "values are single numbers, so write * / ** without a dot",
    "&": "write 'and' inside where(…)",
    "|": "write 'or' inside where(…), or abs(x) for a size",
    "!": "write 'not' inside where(…)",
    "?": _CHOICE,
    ":": _CHOICE,
    ";": "an expression has no end sign; leave it out",
    "%": "write mod(x, y) for a remainder, and x/100 for a percentage",
}
"""Advice for signs that are not part of the language."""

_WORDS = {
    "write clip(x, lower, upper) for a limit": "sat saturate saturation limit clamp constrain",
    _CHOICE: "if else elif iif ifelse ifelif cond piecewise ternary",
    _TABLE: "interp interp1 interp1d lookup lut spline",
    "write log(x)": "ln",
    "write a**b for a power": "pow power",
    "write u(t - L), or u(k - n) in the difference form, for a delay": "delay lag transport shift",
    "write floor(x + 0.5)": "round",
    "write -floor(-x)": "ceil",
    "write mod(x, y)": "rem fmod remainder",
    "write x - clip(x, -d, d) for a dead zone": "deadzone deadband dz",
    "write where(t >= t0, 1, 0) for a step": "step heaviside",
    "write exp(x)": "e",
    "the equation of a state gives its derivative; write that expression, or name it in let": (
        "der diff derivative ddt"
    ),
}
_ADVICE = {word: advice for advice, words in _WORDS.items() for word in words.split()}
_PLAIN_WORDS = ("e", "if", "else")
_POWERS = {"²": 2, "³": 3}


def find_advice(name: str, *, is_called: bool = True) -> str:
    """Find what a word of other languages is here; empty for any other word.

    A word that is not called, such as `lag`, may be a forgotten parameter.

    Examples
    --------
    >>> find_advice("sat")
    'write clip(x, lower, upper) for a limit'
    >>> find_advice("x²")
    'write x**2 for a power'
    """
    if len(name) > 1 and name[-1] in _POWERS:
        return f"write {name[:-1]}**{_POWERS[name[-1]]} for a power"
    return _ADVICE.get(name, "") if is_called or name in _PLAIN_WORDS else ""
