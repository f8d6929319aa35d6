"""The small functions that exported C programs call, and how C99 writes expressions."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from sysid.control.linear_form import Identified, variants_of
from sysid.export.expressions import WIDTHS, Language
from sysid.language.functions import FUNCTIONS, Level


@dataclass(slots=True)
class CLanguage(Language):
    """C99 with the functions of math.h; `called` gathers what math.h does not have."""

    called: set[str] = field(default_factory=set)
    words: Mapping[str, str] = field(default_factory=lambda: {"and": "&&", "or": "||"})

    def negation(self, condition: str) -> str:
        """``not (…)``, to stand anywhere."""
        return f"!({condition})"

    def function(self, name: str, arguments: list[str]) -> str:
        """A call of a function of the model language."""
        function = FUNCTIONS[name].c
        self.called.add(function)
        return f"{function}({', '.join(arguments)})"

    def power(self, base: str, exponent: str, whole: int | None) -> tuple[str, int]:
        """A power and its level."""
        return f"pow({base}, {exponent})", Level.ATOM

    def choice(self, condition: str, first: str, second: str) -> str:
        """``where``, to stand anywhere."""
        return f"({condition} ? {first} : {second})"

    def quotient(self, above: str) -> str:
        """A dividend of numbers only: it needs nothing here."""
        return above

    def element(self, array: str, index: str, divisor: int) -> str:
        """Array at the whole part of index / divisor."""
        if divisor == 1:
            return f"{array}[{index}]"
        return f"{array}[{f'({index})' if '-' in index else index}/{divisor}]"

    def read(self, helper: str, signal: str, place: str) -> str:
        """A call of ``between``, ``held`` or ``averaged``."""
        return f"{helper}({signal}, n, {place}{WIDTHS[helper]})"

    def limited(self, value: str, least: int, most: int) -> str:
        """A number held between two others."""
        return f"fmin(fmax({value}, {least}.0), {most}.0)"

    def real(self, index: str) -> str:
        """A whole number as floating-point number."""
        return f"(double){index}"


_BETWEEN = """\
/* Signal at a place in samples, on a line between them; its end values outside. */
static double between(const double *signal, long n, double place)
{
    const double inside = fmin(fmax(place, 0.0), (double)(n - 1));
    const long i = (long)inside < n - 2 ? (long)inside : n - 2;
    return signal[i] + (inside - (double)i)*(signal[i + 1] - signal[i]);
}
"""
_HELD = """\
/* Signal at a place in samples, held after each; a jump takes `ramp` to either side. */
static double held(const double *signal, long n, double place, double ramp)
{
    const double inside = fmin(fmax(place, -1.0), (double)n);
    const double nearest = floor(inside + 0.5);
    const double part = fmin(fmax((inside - nearest + ramp)/(2*ramp), 0.0), 1.0);
    const long i = (long)nearest;
    const double after = signal[i < 0 ? 0 : i < n ? i : n - 1];
    const double before = signal[i < 1 ? 0 : i <= n ? i - 1 : n - 1];
    return before + part*(after - before);
}
"""
_HELD_ON_GRID = """\
/* Signal at a place in samples, held after each; on lines between points `ramp` apart. */
static double held(const double *signal, long n, double place, double ramp)
{
    const double inside = fmin(fmax(place, -1.0), (double)n);
    const double first = floor(inside/ramp), part = inside/ramp - first;
    double value = 0.0;
    for (int j = 0; j < 2; ++j)
        for (int side = -1; side < 2; side += 2) { /* at a jump the mean of both sides */
            const long k = (long)floor((first + j)*ramp + 1e-6*side);
            value += 0.5*(j == 0 ? 1.0 - part : part)*signal[k < 0 ? 0 : k < n ? k : n - 1];
        }
    return value;
}
"""
_AVERAGED = """\
/* Mean of a held signal from `half` before a place, in samples, to `half` after it. */
static double averaged(const double *signal, long n, double place, double half)
{
    const double inside = fmin(fmax(place, -1.0 - half), (double)n + half);
    const double first = inside - half, last = inside + half;
    double total = 0.0;
    for (long k = (long)floor(first); (double)k < last; ++k) {
        const double width = fmin((double)(k + 1), last) - fmax((double)k, first);
        total += width*signal[k < 0 ? 0 : k < n ? k : n - 1];
    }
    return total/(2*half);
}
"""
_SAMPLE = """\
/* Value at a step that may lie before the start. */
static double sample(const double *array, double before, long step)
{
    return step >= 0 ? array[step] : before;
}
"""
_PAST = """\
/* Value `lag` >= 0 steps before a finished step, on a line between two; `before` the start. */
static double past(const double *array, double before, long step, double lag)
{
    const double whole = floor(-lag);
    const double older = sample(array, before, step + (long)whole);
    const double newer = sample(array, before, step + (long)fmin(whole + 1.0, 0.0));
    return older + (-lag - whole)*(newer - older);
}
"""
_PAST_CUBIC = """\
/* Value `lag` >= 0 steps before a finished step, on a cubic through four (the last: three). */
static double past(const double *array, double before, long step, double lag)
{
    const double whole = floor(-lag), part = -lag - whole;
    const int last = whole <= -2.0 ? 2 : 1;
    double value = 0.0;
    for (int a = -1; a <= last; ++a) {
        double weight = 1.0;
        for (int b = -1; b <= last; ++b)
            if (b != a)
                weight *= (part - b)/(a - b);
        value += weight*sample(array, before, step + (long)fmin(whole + a, 0.0));
    }
    return value;
}
"""
_LATELY = """\
/* Value `lag` steps before the place `part` of a step after it began, where it is `there`. */
static double lately(const double *array, double before, long step, double part, double there,
                     double lag)
{
    if (lag < part)
        return array[step] + (part - lag)/part*(there - array[step]);
    return past(array, before, step, lag - part);
}
"""
_SIGN = """\
static double sign(double x)
{
    return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : x;
}
"""
_LEAST = """\
static double least(double a, double b)
{
    return isnan(a) || a < b ? a : b;
}
"""
_GREATEST = """\
static double greatest(double a, double b)
{
    return isnan(a) || a > b ? a : b;
}
"""
HELPERS: Mapping[str, str] = {
    "sign": _SIGN, "least": _LEAST, "greatest": _GREATEST, "between": _BETWEEN, "held": _HELD,
    "held on grid": _HELD_ON_GRID, "averaged": _AVERAGED,
    "sample": _SAMPLE, "past": _PAST, "past cubic": _PAST_CUBIC, "lately": _LATELY,
}  # fmt: skip


def with_needed(used: Iterable[str], identified: Identified) -> list[str]:
    """Keys of the helpers that are used or that those call, each before who calls it."""
    wanted = set(used)
    if "lately" in wanted:
        wanted.add("past")
    if "past" in wanted:
        wanted.add("sample")
    variants = variants_of(identified)
    return [variants.get(name, name) for name in HELPERS if name in wanted]
