"""A trend as text, for the command line, the page and the report.

All functions take the document of ``GET /v1/jobs/{id}/trend``.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from service.core.text import (
    DASH,
    append_unit,
    format_number,
    format_unit,
    join_estimate,
    plain_estimate,
    plain_unit,
)

QuantityDocument = dict[str, Any]

USUAL_STATUSES = ("identified", "group", "measured", "not told")
"""Statuses that need no attention."""


class Style(NamedTuple):
    """Number formats; `between` joins the ends of an interval."""

    estimate: Callable[[float, float | None], str]
    number: Callable[[float], str]
    label: Callable[[float], str]
    unit: Callable[[str], str]
    between: str


PLAIN = Style(plain_estimate, "{:.4g}".format, "{:g}".format, plain_unit, " to ")
"""For terminals."""
TYPESET = Style(
    join_estimate, format_number, lambda x: f"{x:g}".replace("-", "−"), format_unit, " … "
)
"""For pages and reports."""


class PlaceRow(NamedTuple):
    """Row for the runs of one label; `cells` has one text per quantity."""

    x_text: str
    cells: Sequence[str]
    span_text: str
    evaluations: int
    flags: Sequence[str]
    runs: Sequence[str]


class LawRow(NamedTuple):
    """Row for a law fitted to a quantity."""

    quantity: str
    text: str
    aic: float
    birge: float
    is_chosen: bool


class PredictionRow(NamedTuple):
    """Row for the prediction of a law at one label, with its interval and a remark."""

    quantity: str
    x_text: str
    value: str
    interval: str
    remark: str


class TrendTables(NamedTuple):
    """Trend as tables; `reasons` lists the quantities without a law, each with the reason."""

    headings: Sequence[str]
    rows: Sequence[PlaceRow]
    laws: Sequence[LawRow]
    predictions: Sequence[PredictionRow]
    reasons: Sequence[tuple[str, str]]


def build_tables(trend: dict[str, Any], style: Style) -> TrendTables:
    """Build the tables of a trend. Quantities without any value are left out."""
    shown: list[QuantityDocument] = [
        one for one in trend["quantities"] if any(p["value"] is not None for p in one["points"])
    ]
    return TrendTables(
        headings=[append_unit(one["name"], one["unit"]) for one in shown],
        rows=[_place_row(place, shown, style) for place in trend["places"]],
        laws=[
            LawRow(
                one["name"],
                format_law(one["name"], law, trend["x"], style),
                law["aic"],
                law["birge"],
                law["is_chosen"],
            )
            for one in shown
            for law in one["laws"]
        ],
        predictions=[_prediction_row(one, at, style) for one in shown for at in one["predictions"]],
        reasons=[(one["name"], one["reason"]) for one in shown if one["reason"]],
    )


def _place_row(place: dict[str, Any], quantities: list[QuantityDocument], style: Style) -> PlaceRow:
    points = [next((p for p in one["points"] if p["x"] == place["x"]), None) for one in quantities]
    return PlaceRow(
        x_text=style.label(place["x"]),
        cells=[
            DASH if p is None or p["value"] is None else style.estimate(p["value"], p["stderr"])
            for p in points
        ],
        span_text="; ".join(map(format_span, place["spans"])) or DASH,
        evaluations=place["evaluations"],
        flags=list_flags(place, quantities),
        runs=place["runs"],
    )


def _prediction_row(one: QuantityDocument, at: dict[str, Any], style: Style) -> PredictionRow:
    name, x = str(one["name"]), style.label(at["x"])
    if at["value"] is None or at["lower"] is None:
        return PredictionRow(name, x, DASH, DASH, "the law is not defined here")
    interval = style.between.join(style.number(at[end]) for end in ("lower", "upper"))
    unit = style.unit(one["unit"])
    remark = "extrapolated" if at["is_outside"] else ""
    return PredictionRow(name, x, style.number(at["value"]) + unit, interval + unit, remark)


def list_flags(place: dict[str, Any], quantities: list[QuantityDocument]) -> list[str]:
    """List the findings that need attention in the runs of one label."""
    found = []
    for one in quantities:
        for point in one["points"]:
            if point["x"] == place["x"]:
                found += [f"{one['name']} {text}" for text in _list_point_flags(point)]
    separable = [text for text in place["warnings"] if "not separable" in text]
    return found + [text.partition(":")[0].partition(" (")[0] for text in separable]


def _list_point_flags(point: dict[str, Any]) -> list[str]:
    found = [word for word in point["status"].split(", ") if word not in USUAL_STATUSES]
    if point["is_outlier"]:
        found.append(f"outlier (p = {point['p_value']:.2g})")
    for drift in point["drifts"]:
        if drift["drifted"]:
            whom = "the reference" if drift["kind"] == "run" else "the reference's trend"
            found.append(f"drifted from {whom} (z = {drift['z']:+.1f}, limit {drift['limit']:.1f})")
    return found


def format_limits(quantities: list[QuantityDocument]) -> str:
    """Describe the z at which drift is flagged; empty if nothing is compared."""
    found: dict[str, dict[str, None]] = {}
    for one in quantities:
        for drift in (drift for point in one["points"] for drift in point["drifts"]):
            against = "the reference's trend" if drift["kind"] == "trend" else "the reference run"
            found.setdefault(f"{drift['limit']:.1f} against {against}", {})[one["name"]] = None
    told = "; ".join(f"{limit} ({', '.join(names)})" for limit, names in found.items())
    return f"drift is flagged where z, in standard errors, exceeds {told}" if told else ""


def format_reference(trend: dict[str, Any]) -> str:
    """Format the reference: ``'tube' (length_m = 40)``; empty without names and label."""
    names = ", ".join(f"{name!r}" for name in trend["reference_names"])
    label = "" if trend["reference_x"] is None else f"{trend['x']} = {trend['reference_x']:g}"
    return " ".join(filter(None, (names, f"({label})" if label else "")))


def format_span(one: dict[str, Any]) -> str:
    """Format the range of an output, with the channel's name if it has no unit."""
    unit = plain_unit(one["unit"]) or f" ({one['channel']})"
    return f"{one['lower']:.6g} to {one['upper']:.6g}{unit}"


def format_law(name: str, law: dict[str, Any], x: str, style: Style) -> str:
    """Format a law with its coefficients and their standard errors."""
    known = {
        one["name"]: f"({style.estimate(one['value'], one['stderr'])})"
        for one in law["coefficients"]
    }
    a, b = known["a"], known["b"]
    text = f"{a} + {b}·{x}" if law["law"] == "line" else f"{a}·{x}^{b}"
    return f"{name} = {text}"


def list_notes(trend: dict[str, Any]) -> list[str]:
    """List all notes on the numbers."""
    found = [f"{one['name']}: {text}" for one in trend["quantities"] for text in one["notes"]]
    by_text: dict[str, list[str]] = {}
    for place in trend["places"]:
        for text in place["warnings"]:
            by_text.setdefault(text, []).append(f"{place['x']:g}")
    found += [f"{trend['x']} {', '.join(at)}: {text}" for text, at in by_text.items()]
    if trend["missing"]:
        found.append(f"{trend['missing']} runs failed or have not ended. They are not in the table")
    limits = format_limits(trend["quantities"])
    return [*found, *trend["notes"], *([limits] if limits else [])]
