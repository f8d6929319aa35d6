"""A trend as text, for the command line, the page and the report.

All functions take the document of ``GET /v1/jobs/{id}/trend``.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from service.core.label_text import format_count
from sysid.core.text import (
    DASH,
    append_unit,
    find_shown_error,
    format_number,
    format_unit,
    join_estimate,
    plain_estimate,
    plain_unit,
)

QuantityDocument = Mapping[str, Any]


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


def build_tables(trend: Mapping[str, Any], style: Style) -> TrendTables:
    """Build the tables of a trend. Quantities without any value are left out."""
    shown: list[QuantityDocument] = [
        quantity
        for quantity in trend["quantities"]
        if any(p["value"] is not None for p in quantity["points"])
    ]
    return TrendTables(
        headings=[append_unit(quantity["name"], quantity["unit"]) for quantity in shown],
        rows=[_label_row(label_runs, shown, style) for label_runs in trend["labels"]],
        laws=[
            LawRow(
                quantity["name"],
                format_law(quantity["name"], law, trend["x"], style),
                law["aic"],
                law["birge"],
                law["is_chosen"],
            )
            for quantity in shown
            for law in quantity["laws"]
        ],
        predictions=[
            _prediction_row(quantity, prediction, style)
            for quantity in shown
            for prediction in quantity["predictions"]
        ],
        reasons=[
            (quantity["name"], quantity["reason"]) for quantity in shown if quantity["reason"]
        ],
    )


def _label_row(
    label_runs: Mapping[str, Any], quantities: list[QuantityDocument], style: Style
) -> PlaceRow:
    points = [
        next((p for p in quantity["points"] if p["x"] == label_runs["x"]), None)
        for quantity in quantities
    ]
    return PlaceRow(
        x_text=style.label(label_runs["x"]),
        cells=[
            DASH
            if p is None or p["value"] is None
            else style.estimate(p["value"], find_shown_error(p["stderr"], p["status"]))
            for p in points
        ],
        span_text="; ".join(map(format_span, label_runs["spans"])) or DASH,
        evaluations=label_runs["evaluations"],
        flags=list_flags(label_runs, quantities),
        runs=label_runs["runs"],
    )


def _prediction_row(
    quantity: QuantityDocument, prediction: Mapping[str, Any], style: Style
) -> PredictionRow:
    name, x = str(quantity["name"]), style.label(prediction["x"])
    if prediction["value"] is None or prediction["lower"] is None:
        return PredictionRow(name, x, DASH, DASH, "the law is not defined here")
    interval = style.between.join(style.number(prediction[end]) for end in ("lower", "upper"))
    unit = style.unit(quantity["unit"])
    remark = "extrapolated" if prediction["is_outside"] else ""
    return PredictionRow(name, x, style.number(prediction["value"]) + unit, interval + unit, remark)


def list_flags(label_runs: Mapping[str, Any], quantities: list[QuantityDocument]) -> list[str]:
    """List what needs attention in the runs of one label."""
    flags = [*label_runs["flags"]]
    for quantity in quantities:
        for point in quantity["points"]:
            if point["x"] == label_runs["x"]:
                flags += [f"{quantity['name']} {text}" for text in _list_point_flags(point)]
    return flags


def _list_point_flags(point: Mapping[str, Any]) -> list[str]:
    flags = []
    if point["is_outlier"]:
        flags.append(f"outlier (p = {point['p_value']:.2g})")
    for drift in point["drifts"]:
        if drift["drifted"]:
            reference = "the reference" if drift["kind"] == "run" else "the reference's trend"
            flags.append(
                f"drifted from {reference} (z = {drift['z']:+.1f}, limit {drift['limit']:.1f})"
            )
    return flags


def format_limits(quantities: list[QuantityDocument]) -> str:
    """Describe the z at which drift is flagged; empty if nothing is compared."""
    limits: dict[str, dict[str, None]] = {}
    for quantity in quantities:
        for drift in (drift for point in quantity["points"] for drift in point["drifts"]):
            against = "the reference's trend" if drift["kind"] == "trend" else "the reference run"
            limits.setdefault(f"{drift['limit']:.1f} against {against}", {})[quantity["name"]] = (
                None
            )
    text = "; ".join(f"{limit} ({', '.join(names)})" for limit, names in limits.items())
    return f"drift is flagged where z, in standard errors, exceeds {text}" if text else ""


def format_reference(trend: Mapping[str, Any]) -> str:
    """Format the reference: ``'tube' (length_m = 40)``; empty without names and label."""
    names = ", ".join(f"{name!r}" for name in trend["reference_names"])
    label = "" if trend["reference_x"] is None else f"{trend['x']} = {trend['reference_x']:g}"
    return " ".join(filter(None, (names, f"({label})" if label else "")))


def format_span(span: Mapping[str, Any]) -> str:
    """Format the range of an output, with the channel's name if it has no unit."""
    unit = plain_unit(span["unit"]) or f" ({span['channel']})"
    return f"{span['lower']:.6g} to {span['upper']:.6g}{unit}"


def format_law(name: str, law: Mapping[str, Any], x: str, style: Style) -> str:
    """Format a law with its coefficients and their standard errors."""
    coefficients = {
        coefficient["name"]: f"({style.estimate(coefficient['value'], coefficient['stderr'])})"
        for coefficient in law["coefficients"]
    }
    a, b = coefficients["a"], coefficients["b"]
    text = f"{a} + {b}·{x}" if law["law"] == "line" else f"{a}·{x}^{b}"
    return f"{name} = {text}"


def list_notes(trend: Mapping[str, Any]) -> list[str]:
    """List all notes on the numbers."""
    notes = [
        f"{quantity['name']}: {text}"
        for quantity in trend["quantities"]
        for text in quantity["notes"]
    ]
    by_text: dict[str, list[str]] = {}
    for label_runs in trend["labels"]:
        for text in label_runs["warnings"]:
            by_text.setdefault(text, []).append(f"{label_runs['x']:g}")
    notes += [f"{trend['x']} {', '.join(values)}: {text}" for text, values in by_text.items()]
    if trend["missing"]:
        notes.append(_describe_missing(trend["missing"], trend["failed"], trend["unended"]))
    limits = format_limits(trend["quantities"])
    return [*notes, *trend["notes"], *([limits] if limits else [])]


def _describe_missing(missing: int, failed: int, unended: int) -> str:
    """Describe the runs that are in no table, by the reason."""
    others = missing - failed - unended
    reasons = (
        (failed, "failed"),
        (unended, "have not ended" if unended > 1 else "has not ended"),
        (others, "were cancelled or deleted" if others > 1 else "was cancelled or deleted"),
    )
    told = [f"{format_count(count)} {reason}" for count, reason in reasons if count]
    return f"Runs that are not in the table: {', '.join(told)}"
