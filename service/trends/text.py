"""What a trend says in words, for the command line, the page and the report alike.

All work on the document of ``GET /v1/jobs/{id}/trend``.
"""

from collections.abc import Callable
from typing import Any

Quantity = dict[str, Any]

USUAL = ("identified", "group", "measured", "not told")
"""Statuses that need no second look."""


def flags(place: dict[str, Any], quantities: list[Quantity]) -> list[str]:
    """What is to be looked at in the runs of one label."""
    found = []
    for one in quantities:
        for point in one["points"]:
            if point["x"] == place["x"]:
                found += [f"{one['name']} {text}" for text in _flags(point)]
    separable = [text for text in place["warnings"] if "not separable" in text]
    return found + [text.partition(":")[0].partition(" (")[0] for text in separable]


def _flags(point: dict[str, Any]) -> list[str]:
    found = [word for word in point["status"].split(", ") if word not in USUAL]
    if point["is_outlier"]:
        found.append(f"outlier (p = {point['p_value']:.2g})")
    for drift in point["drifts"]:
        if drift["drifted"]:
            whom = "the reference" if drift["kind"] == "run" else "the reference's trend"
            found.append(f"drifted from {whom} (z = {drift['z']:+.1f}, limit {drift['limit']:.1f})")
    return found


def limit_text(quantities: list[Quantity]) -> str:
    """From how many standard errors on drift is flagged; empty where nothing is compared."""
    found: dict[str, dict[str, None]] = {}
    for one in quantities:
        for drift in (drift for point in one["points"] for drift in point["drifts"]):
            against = "the reference's trend" if drift["kind"] == "trend" else "the reference run"
            found.setdefault(f"{drift['limit']:.1f} against {against}", {})[one["name"]] = None
    told = "; ".join(f"{limit} ({', '.join(names)})" for limit, names in found.items())
    return f"drift is flagged where z, in standard errors, is beyond {told}" if told else ""


def reference_text(trend: dict[str, Any]) -> str:
    """Names and label of the reference: ``'tube' (length_m = 40)``; empty where it has none."""
    names = ", ".join(f"{name!r}" for name in trend["reference_names"])
    label = "" if trend["reference_x"] is None else f"{trend['x']} = {trend['reference_x']:g}"
    return " ".join(filter(None, (names, f"({label})" if label else "")))


def span_text(one: dict[str, Any]) -> str:
    """From where to where an output went; the channel's name where it has no unit."""
    unit = f" {one['unit']}" if one["unit"] not in ("", "1") else f" ({one['channel']})"
    return f"{one['lower']:.6g} to {one['upper']:.6g}{unit}"


def law_text(name: str, law: dict[str, Any], x: str, shown: Callable[[dict[str, Any]], str]) -> str:
    """A law with its coefficients, each written by `shown`."""
    known = {one["name"]: f"({shown(one)})" for one in law["coefficients"]}
    a, b = known["a"], known["b"]
    text = f"{a} + {b}·{x}" if law["law"] == "line" else f"{a}·{x}^{b}"
    return f"{name} = {text}"


def notes(trend: dict[str, Any]) -> list[str]:
    """All that the numbers need beside them."""
    found = [f"{one['name']}: {text}" for one in trend["quantities"] for text in one["notes"]]
    by_text: dict[str, list[str]] = {}
    for place in trend["places"]:
        for text in place["warnings"]:
            by_text.setdefault(text, []).append(f"{place['x']:g}")
    found += [f"{trend['x']} {', '.join(at)}: {text}" for text, at in by_text.items()]
    if trend["missing"]:
        found.append(f"{trend['missing']} runs failed or are not over: they are not in the table")
    limits = limit_text(trend["quantities"])
    return [*found, *trend["notes"], *([limits] if limits else [])]
