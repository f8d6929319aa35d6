"""Write the numbers of a figure as CSV."""

import csv
import io

from service.core.text import escape_formula
from sysid.figures.plotly import Figure


def to_csv(figure: Figure) -> str:
    """Write the drawn numbers as CSV, one per row: series, x, y (and z of a matrix).

    Contours are left out: they are drawn from numbers of other series.
    """
    sink = io.StringIO()
    rows = csv.writer(sink, lineterminator="\n")
    traces = [trace for trace in figure["data"] if trace["type"] != "contour"]
    matrix = any("z" in trace for trace in traces)
    rows.writerow(["series", "x", "y", *(["z"] if matrix else [])])
    for trace in traces:
        name = escape_formula(trace.get("name", ""))
        if "z" in trace:
            for y, line in zip(trace["y"], trace["z"], strict=True):
                rows.writerows((name, x, y, z) for x, z in zip(trace["x"], line, strict=True))
        else:
            rows.writerows((name, x, y) for x, y in zip(trace["x"], trace["y"], strict=True))
    return sink.getvalue()
