"""The small functions that exported Python programs call, and how Python writes expressions."""

from collections.abc import Iterable, Mapping

from sysid.control.linear_form import Identified, variants_of
from sysid.export.expressions import WIDTHS, Language
from sysid.language.functions import FUNCTIONS, Level


class PythonLanguage(Language):
    """Python, with NumPy's functions on single numbers: overflow gives ``inf``, not an error."""

    words: Mapping[str, str] = {}

    def negation(self, condition: str) -> str:
        """``not (…)``, to stand anywhere."""
        return f"(not ({condition}))"

    def function(self, name: str, arguments: list[str]) -> str:
        """A call of a function of the model language."""
        return f"np.{FUNCTIONS[name].numpy}({', '.join(arguments)})"

    def power(self, base: str, exponent: str, whole: int | None) -> tuple[str, int]:
        """A power and its level."""
        if whole is not None:
            return f"{base}**{whole}", Level.ATOM - 1
        return f"np.power({base}, {exponent})", Level.ATOM

    def choice(self, condition: str, first: str, second: str) -> str:
        """``where``, to stand anywhere."""
        return f"({first} if {condition} else {second})"

    def quotient(self, above: str) -> str:
        """A dividend of numbers only."""
        return f"np.float64({above})"

    def element(self, array: str, index: str, divisor: int) -> str:
        """Array at the whole part of index / divisor."""
        if divisor == 1:
            return f"{array}[{index}]"
        return f"{array}[{f'({index})' if '-' in index else index}//{divisor}]"

    def read(self, helper: str, signal: str, place: str) -> str:
        """A call of ``between``, ``held`` or ``averaged``."""
        return f"{helper}({signal}, {place}{WIDTHS[helper]})"

    def limited(self, value: str, least: int, most: int) -> str:
        """A number held between two others."""
        return f"min(max({value.replace('ceil', 'np.ceil')}, {least}), {most})"

    def real(self, index: str) -> str:
        """A whole number as floating-point number."""
        return f"np.float64({index})"


_BETWEEN = '''def between(signal, place):
    """Signal at a place in samples, on a line between them; its end values outside."""
    place = min(max(place, 0.0), signal.size - 1.0)
    i = min(int(place), signal.size - 2)
    return signal[i] + (place - i)*(signal[i + 1] - signal[i])
'''
_HELD = '''def held(signal, place, ramp):
    """Signal at a place in samples, held after each; a jump takes `ramp` to either side."""
    i = int(np.floor(place + 0.5))
    part = min(max((place - i + ramp)/(2*ramp), 0.0), 1.0)
    before = signal[min(max(i - 1, 0), signal.size - 1)]
    return before + part*(signal[min(max(i, 0), signal.size - 1)] - before)
'''
_HELD_ON_GRID = '''def held(signal, place, ramp):
    """Signal at a place in samples, held after each; on lines between points `ramp` apart."""
    i = int(np.floor(place/ramp))
    part = place/ramp - i
    value = 0.0
    for j, weight in ((i, 1.0 - part), (i + 1, part)):
        for side in (-1e-6, 1e-6):  # at a jump the mean of both sides
            k = int(np.floor(j*ramp + side))
            value += 0.5*weight*signal[min(max(k, 0), signal.size - 1)]
    return value
'''
_AVERAGED = '''def averaged(signal, place, half):
    """Mean of a held signal from `half` before a place, in samples, to `half` after it."""
    first, last = place - half, place + half
    total = 0.0
    for k in range(int(np.floor(first)), int(np.ceil(last))):
        width = min(k + 1.0, last) - max(float(k), first)
        total += width*signal[min(max(k, 0), signal.size - 1)]
    return total/(2*half)
'''
_PAST = '''def past(array, before, step, lag):
    """Value `lag` >= 0 steps before a finished step, on a line between two; `before` the start."""
    i = int(np.floor(-lag))
    part = -lag - i
    older, newer = (
        array[step + j] if step + j >= 0 else before for j in (i, min(i + 1, 0))
    )
    return older + part*(newer - older)
'''
_PAST_CUBIC = '''def past(array, before, step, lag):
    """Value `lag` >= 0 steps before a finished step, on a cubic through four (the last: three)."""
    i = int(np.floor(-lag))
    part = -lag - i
    nodes = (-1, 0, 1, 2) if i <= -2 else (-1, 0, 1)
    value = 0.0
    for a in nodes:
        j = step + min(i + a, 0)
        weight = np.prod([(part - b)/(a - b) for b in nodes if b != a])
        value += weight*(array[j] if j >= 0 else before)
    return value
'''
_LATELY = '''def lately(array, before, step, part, there, lag):
    """Value `lag` steps before the place `part` of a step after it began, where it is `there`."""
    if lag < part:
        return array[step] + (part - lag)/part*(there - array[step])
    return past(array, before, step, lag - part)
'''
HELPERS: Mapping[str, str] = {
    "between": _BETWEEN, "held": _HELD, "held on grid": _HELD_ON_GRID,
    "averaged": _AVERAGED,
    "past": _PAST, "past cubic": _PAST_CUBIC,
    "lately": _LATELY,
}  # fmt: skip


def with_needed(used: Iterable[str], identified: Identified) -> list[str]:
    """Keys of the helpers that are used or that those call, each before who calls it."""
    wanted = set(used)
    if "lately" in wanted:
        wanted.add("past")
    order = ("between", "held", "averaged", "past", "lately")
    variants = variants_of(identified)
    return [variants.get(name, name) for name in order if name in wanted]
