"""A trend as tables: the batch, the laws, the predictions."""

from typing import Any

from service.cli.common import estimate, out, print_table
from service.cli.places import Places
from service.trend_text import Quantity, flags, law_text, notes, reference_text, span_text


def print_trend(trend: dict[str, Any], places: Places) -> None:
    """Print what `GET /v1/jobs/{id}/trend` tells, with notes that name the user's `places`."""
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
    if trend["reference"] is not None:
        named = reference_text(trend)
        text = f"compared with {trend['reference']}{named and ', '}{named}"
        out.print(text, markup=False, soft_wrap=True)
    for note in notes(trend):
        out.print(f"note: {places.in_note(note)}", markup=False, soft_wrap=True)


def _row(place: dict[str, Any], quantities: list[Quantity]) -> list[object]:
    points = [next((p for p in one["points"] if p["x"] == place["x"]), None) for one in quantities]
    cells = [None if p is None or p["value"] is None else estimate(p) for p in points]
    told = flags(place, quantities)
    return [
        place["x"], *cells, "; ".join(map(span_text, place["spans"])) or None, place["evaluations"],
        "; ".join(told),
    ]  # fmt: skip


def _laws(one: Quantity, x: str) -> list[list[object]]:
    name = str(one["name"])
    return [
        [name, law_text(name, law, x, estimate), f"{law['aic']:.2f}", f"{law['birge']:.2f}",
         "chosen" if law["is_chosen"] else ""]
        for law in one["laws"]
    ]  # fmt: skip


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
    return str(one["name"]) + ("" if one["unit"] in ("", "1") else f" [{one['unit']}]")
