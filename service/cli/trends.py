"""A trend as tables: the batch, the laws, the predictions."""

from typing import Any

from service.cli.common import estimate, out, print_table

Quantity = dict[str, Any]


def print_trend(trend: dict[str, Any]) -> None:
    """Print what `GET /v1/jobs/{id}/trend` tells."""
    shown = [
        one for one in trend["quantities"] if any(p["value"] is not None for p in one["points"])
    ]
    headings = [f">{trend['x']}", *(f">{_title(one)}" for one in shown), ">measured span",
                ">evaluations", "flags"]  # fmt: skip
    rows = [_row(place, shown) for place in trend["places"]]
    print_table(headings, rows, empty="no run has succeeded")
    out.print()
    laws = [row for one in shown for row in _laws(one, trend["x"])]
    print_table(("quantity", "law", ">AIC", ">Birge ratio", ""), laws, empty="")
    for one in shown:
        if one["reason"]:
            out.print(f"{one['name']}: no law: {one['reason']}", markup=False, soft_wrap=True)
    out.print()
    predicted = [row for one in shown for row in _predictions(one)]
    if predicted:
        above = ("predicted", f">{trend['x']}", ">value", "95 % interval for a new estimate", "")
        print_table(above, predicted, empty="")
        out.print()
    for note in _notes(trend, shown):
        out.print(f"note: {note}", markup=False, soft_wrap=True)


def flags(x: float, quantities: list[Quantity]) -> list[str]:
    """What is to be looked at in the runs of one label."""
    found = []
    for one in quantities:
        for point in one["points"]:
            if point["x"] == x:
                found += [f"{one['name']} {text}" for text in _flags(point)]
    return found


def _flags(point: dict[str, Any]) -> list[str]:
    usual = ("identified", "group", "measured", "not told")
    found = [word for word in point["status"].split(", ") if word not in usual]
    if point["is_outlier"]:
        found.append(f"outlier (p = {point['p_value']:.2g})")
    for drift in point["drifts"]:
        if drift["drifted"]:
            whom = "the reference" if drift["kind"] == "run" else "the reference's trend"
            found.append(f"drifted from {whom} (z = {drift['z']:+.1f})")
    return found


def _row(place: dict[str, Any], quantities: list[Quantity]) -> list[object]:
    points = [next((p for p in one["points"] if p["x"] == place["x"]), None) for one in quantities]
    cells = [None if p is None or p["value"] is None else estimate(p) for p in points]
    told = flags(place["x"], quantities)
    told += [text.partition(":")[0].partition(" (")[0] for text in place["warnings"]
             if "not separable" in text]  # fmt: skip
    return [
        place["x"], *cells, "; ".join(map(_span, place["spans"])) or None, place["evaluations"],
        "; ".join(told),
    ]  # fmt: skip


def _span(one: dict[str, Any]) -> str:
    unit = f" {one['unit']}" if one["unit"] not in ("", "1") else f" ({one['channel']})"
    return f"{one['lower']:.5g} to {one['upper']:.5g}{unit}"


def _laws(one: Quantity, x: str) -> list[list[object]]:
    return [
        [
            one["name"], law_text(one, law, x), f"{law['aic']:.2f}", f"{law['birge']:.2f}",
            "chosen" if law["is_chosen"] else "",
        ]
        for law in one["laws"]
    ]  # fmt: skip


def law_text(one: Quantity, law: dict[str, Any], x: str) -> str:
    """A law with its coefficients and their standard errors."""
    known = {c["name"]: f"({estimate(c)})" for c in law["coefficients"]}
    a, b = known["a"], known["b"]
    text = f"{a} + {b}·{x}" if law["law"] == "line" else f"{a}·{x}^{b}"
    return f"{one['name']} = {text}"


def _predictions(one: Quantity) -> list[list[object]]:
    return [_predicted(one, place) for place in one["predictions"]]


def _predicted(one: Quantity, place: dict[str, Any]) -> list[object]:
    told: list[object] = [one["name"], place["x"]]
    if place["value"] is None or place["lower"] is None:
        return [*told, None, "–", "the law has no value here"]
    unit = "" if one["unit"] in ("", "1") else f" {one['unit']}"
    interval = f"{place['lower']:.4g} to {place['upper']:.4g}{unit}"
    outside = "extrapolated" if place["is_outside"] else ""
    return [*told, f"{place['value']:.4g}{unit}", interval, outside]


def _title(one: Quantity) -> str:
    return one["name"] + ("" if one["unit"] in ("", "1") else f" [{one['unit']}]")


def _notes(trend: dict[str, Any], shown: list[Quantity]) -> list[str]:
    notes = [f"{one['name']}: {text}" for one in shown for text in one["notes"]]
    by_text: dict[str, list[str]] = {}
    for place in trend["places"]:
        for text in place["warnings"]:
            by_text.setdefault(text, []).append(f"{place['x']:g}")
    notes += [f"at {', '.join(at)}: {text}" for text, at in by_text.items()]
    if trend["missing"]:
        notes.append(f"{trend['missing']} runs failed or are not over: they are not in the table")
    return [*notes, *trend["notes"]]
