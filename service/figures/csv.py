"""Write the numbers of a figure as CSV."""

from collections.abc import Iterator, Mapping
from itertools import chain
from typing import Any

from service.core.label_text import write_csv
from sysid.figures.plotly import Figure


def to_csv(figure: Figure) -> str:
    """Write the drawn numbers as CSV, one per row: series, x, y (and z of a matrix).

    Contours are left out: they are drawn from numbers of other series.
    """
    traces = [trace for trace in figure["data"] if trace["type"] != "contour"]
    matrix = any("z" in trace for trace in traces)
    heading = ("series", "x", "y", *(["z"] if matrix else []))
    return write_csv(chain([heading], chain.from_iterable(map(_list_points, traces))))


def _list_points(trace: Mapping[str, Any]) -> Iterator[tuple[Any, ...]]:
    name = trace.get("name", "")
    if "z" not in trace:
        yield from ((name, x, y) for x, y in zip(trace["x"], trace["y"], strict=True))
        return
    for y, line in zip(trace["y"], trace["z"], strict=True):
        yield from ((name, x, y, z) for x, z in zip(trace["x"], line, strict=True))
