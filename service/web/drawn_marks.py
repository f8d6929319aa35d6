"""Symbols of points in a drawing, by the names that figures give them."""

from collections.abc import Callable, Mapping

_Path = Callable[[float, float, float], str]


def symbol(name: str, x: float, y: float, radius: float, colour: str) -> str:
    """A symbol about a place (px); a name that ends with ``-open`` is only an outline."""
    shape, is_open = name.removesuffix("-open"), name.endswith("-open")
    is_thin = shape in _THIN
    paint = f'fill="none" stroke="{colour}"' if is_open or is_thin else f'fill="{colour}"'
    if shape in _PATHS:
        return f'<path d="{_PATHS[shape](x, y, radius)}" {paint}/>'
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" {paint}/>'


def _diamond(x: float, y: float, r: float) -> str:
    return f"M{x:.1f} {y - r:.1f}l{r:.1f} {r:.1f}l{-r:.1f} {r:.1f}l{-r:.1f} {-r:.1f}Z"


def _triangle(x: float, y: float, r: float) -> str:
    return f"M{x:.1f} {y - r:.1f}l{r:.1f} {1.7 * r:.1f}h{-2 * r:.1f}Z"


def _cross(x: float, y: float, r: float) -> str:
    return (
        f"M{x - r:.1f} {y - r:.1f}l{2 * r:.1f} {2 * r:.1f}M{x - r:.1f} {y + r:.1f}l{2 * r:.1f} "
        f"{-2 * r:.1f}"
    )


def _star(x: float, y: float, r: float) -> str:
    return (
        f"{_cross(x, y, 0.7 * r)}M{x - r:.1f} {y:.1f}h{2 * r:.1f}M{x:.1f} {y - r:.1f}v{2 * r:.1f}"
    )


_PATHS: Mapping[str, _Path] = {
    "diamond": _diamond, "triangle-up": _triangle, "x-thin": _cross, "star": _star,
}  # fmt: skip
_THIN = ("x-thin", "star")
