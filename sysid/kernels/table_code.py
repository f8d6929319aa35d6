"""Code generation of lookup tables: a polynomial in each interval, chosen by comparisons.

The points are few, so all intervals are computed and one is selected, without branches. The
coefficients depend on parameters at most: the compiler moves them out of the time loop.
"""

from collections.abc import Sequence
from itertools import pairwise

from sysid.kernels.vectors import IrValue, VectorBuilder


def emit_table(
    lanes: VectorBuilder,
    argument: IrValue,
    x: Sequence[float],
    y: Sequence[IrValue],
    *,
    is_cubic: bool,
) -> IrValue:
    """Emit the value of a table; at the ends it stays constant, and nan stays nan."""
    pieces = _Pieces(lanes, x, y)
    coefficients = pieces.emit_cubics() if is_cubic else [(rise,) for rise in pieces.rises]
    result = y[0]
    for position, value, factors in zip(x, y, coefficients, strict=False):
        beyond = lanes.sub(argument, lanes.make_number(position))
        inside = factors[-1]
        for factor in reversed(factors[:-1]):
            inside = lanes.add(factor, lanes.mul(beyond, inside))
        inside = lanes.add(value, lanes.mul(beyond, inside))
        is_reached = lanes.compare(">=", argument, lanes.make_number(position))
        result = lanes.select(is_reached, inside, result)
    is_behind = lanes.compare(">=", argument, lanes.make_number(x[-1]))
    result = lanes.select(is_behind, y[-1], result)
    return lanes.select(lanes.compare("!=", argument, argument), argument, result)


class _Pieces:
    """Intervals of a table, and their mean slopes."""

    def __init__(self, lanes: VectorBuilder, x: Sequence[float], y: Sequence[IrValue]) -> None:
        self._lanes = lanes
        self._widths = [after - before for before, after in pairwise(x)]
        self.rises = [
            lanes.div(lanes.sub(after, before), lanes.make_number(width))
            for before, after, width in zip(y, y[1:], self._widths, strict=False)
        ]

    def emit_cubics(self) -> list[tuple[IrValue, IrValue, IrValue]]:
        """Emit factors of the first to third power from the start of each interval on."""
        lanes, slopes = self._lanes, self._emit_slopes()
        cubics = []
        for width, rise, first, last in zip(
            self._widths, self.rises, slopes, slopes[1:], strict=False
        ):
            over, under = lanes.sub(rise, first), lanes.sub(last, rise)
            # 3 δ - 2 a - b = 2 (δ - a) - (b - δ); a + b - 2 δ = (b - δ) - (δ - a)
            second = lanes.sub(lanes.mul(lanes.make_number(2.0), over), under)
            third = lanes.sub(under, over)
            cubics.append(
                (
                    first,
                    lanes.mul(second, lanes.make_number(1.0 / width)),
                    lanes.mul(third, lanes.make_number(1.0 / width**2)),
                )
            )
        return cubics

    def _emit_slopes(self) -> list[IrValue]:
        """Emit the slopes at the points, so that the cubics are monotone as the points are.

        Weighted harmonic means (Fritsch and Butland 1984), and at the ends parabolas that are
        limited (Moler 2004, section 3.4).
        """
        if len(self.rises) == 1:
            return [self.rises[0]] * 2
        inner = [self._emit_inner_slope(i) for i in range(1, len(self.rises))]
        return [self._emit_end_slope(0, 1), *inner, self._emit_end_slope(-1, -2)]

    def _emit_inner_slope(self, i: int) -> IrValue:
        lanes, before, after = self._lanes, self._widths[i - 1], self._widths[i]
        first, second = self.rises[i - 1], self.rises[i]
        mean = lanes.add(
            lanes.div(lanes.make_number(2 * after + before), first),
            lanes.div(lanes.make_number(after + 2 * before), second),
        )
        slope = lanes.div(lanes.make_number(3 * (before + after)), mean)
        return self._keep_if_alike(first, second, slope)

    def _emit_end_slope(self, end: int, inner: int) -> IrValue:
        lanes, width, other = self._lanes, self._widths[end], self._widths[inner]
        rise, next_rise = self.rises[end], self.rises[inner]
        above = lanes.sub(
            lanes.mul(lanes.make_number(2 * width + other), rise),
            lanes.mul(lanes.make_number(width), next_rise),
        )
        slope = lanes.div(above, lanes.make_number(width + other))
        limit = lanes.mul(lanes.make_number(3.0), rise)
        sizes = [lanes.call_intrinsic("fabs", value) for value in (slope, limit)]
        limited = lanes.select(lanes.compare(">", *sizes), limit, slope)
        slope = lanes.select(self._is_alike(rise, next_rise), slope, limited)
        return self._keep_if_alike(slope, rise, slope)

    def _is_alike(self, a: IrValue, b: IrValue) -> IrValue:
        return self._lanes.compare(">", self._lanes.mul(a, b), self._lanes.make_number(0.0))

    def _keep_if_alike(self, a: IrValue, b: IrValue, slope: IrValue) -> IrValue:
        """Emit a slope, or 0 unless both numbers have the same sign."""
        return self._lanes.select(self._is_alike(a, b), slope, self._lanes.make_number(0.0))
