"""What a trend says in words, for the command line, the page and the report alike.

All work on the document of ``GET /v1/jobs/{id}/trend``.
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
"""Statuses that need no second look."""


class Style(NamedTuple):
    """How numbers are written; `between` joins the ends of an interval."""

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
    """The runs of one label; `cells` has one text for each quantity."""

    x_text: str
    cells: Sequence[str]
    span_text: str
    evaluations: int
    flags: Sequence[str]
    runs: Sequence[str]


class LawRow(NamedTuple):
    """A law that was fitted to a quantity."""

    quantity: str
    text: str
    aic: float
    birge: float
    is_chosen: bool


class PredictionRow(NamedTuple):
    """A law at one label, with its interval and what is to be said of it."""

    quantity: str
    x_text: str
    value: str
    interval: str
    remark: str


class TrendTables(NamedTuple):
    """A trend as tables; `reasons` are quantities without a law, each with the reason."""

    headings: Sequence[str]
    rows: Sequence[PlaceRow]
    laws: Sequence[LawRow]
    predictions: Sequence[PredictionRow]
    reasons: Sequence[tuple[str, str]]


def build_tables(trend: dict[str, Any], style: Style) -> TrendTables:
    """The tables of a trend; quantities without any value are left out."""
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
    """What is to be looked at in the runs of one label."""
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
    """From how many standard errors on drift is flagged; empty where nothing is compared."""
    found: dict[str, dict[str, None]] = {}
    for one in quantities:
        for drift in (drift for point in one["points"] for drift in point["drifts"]):
            against = "the reference's trend" if drift["kind"] == "trend" else "the reference run"
            found.setdefault(f"{drift['limit']:.1f} against {against}", {})[one["name"]] = None
    told = "; ".join(f"{limit} ({', '.join(names)})" for limit, names in found.items())
    return f"drift is flagged where z, in standard errors, exceeds {told}" if told else ""


def format_reference(trend: dict[str, Any]) -> str:
    """Names and label of the reference: ``'tube' (length_m = 40)``; empty where it has none."""
    names = ", ".join(f"{name!r}" for name in trend["reference_names"])
    label = "" if trend["reference_x"] is None else f"{trend['x']} = {trend['reference_x']:g}"
    return " ".join(filter(None, (names, f"({label})" if label else "")))


def format_span(one: dict[str, Any]) -> str:
    """From where to where an output went; the channel's name where it has no unit."""
    unit = plain_unit(one["unit"]) or f" ({one['channel']})"
    return f"{one['lower']:.6g} to {one['upper']:.6g}{unit}"


def format_law(name: str, law: dict[str, Any], x: str, style: Style) -> str:
    """A law with its coefficients and their standard errors."""
    known = {
        one["name"]: f"({style.estimate(one['value'], one['stderr'])})"
        for one in law["coefficients"]
    }
    a, b = known["a"], known["b"]
    text = f"{a} + {b}·{x}" if law["law"] == "line" else f"{a}·{x}^{b}"
    return f"{name} = {text}"


def list_notes(trend: dict[str, Any]) -> list[str]:
    """All that the numbers need beside them."""
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
