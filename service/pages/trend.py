"""What pages and reports show of a trend: tables as texts, ready to be written."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy.orm import Session

from service.core.errors import InvalidRequest
from service.figures import formats
from service.figures.trend import trend_height
from service.storage.tables import Job
from service.trends.schemas import TrendOut
from service.trends.text import Quantity, flags, law_text, notes, reference_text, span_text
from service.trends.trend import has_trend, trend


@dataclass(frozen=True, slots=True)
class RowView:
    """The runs of one label."""

    x_text: str
    cells: Sequence[str]
    span_text: str
    evaluations: int
    flags: Sequence[str]
    runs: Sequence[str]


@dataclass(frozen=True, slots=True)
class TrendView:
    """A trend; `laws` are (text, AIC, Birge ratio, whether chosen).

    Offered to be accepted is the run at the reference's label under its name; of a batch without
    one the run in the middle, which is the nearest to all others.
    """

    x: str
    headings: Sequence[str]
    rows: Sequence[RowView]
    laws: Sequence[tuple[str, str, str, bool]]
    predictions: Sequence[tuple[str, str, str, str, str]]
    reasons: Sequence[str]
    notes: Sequence[str]
    reference: str | None
    reference_text: str
    offered: str
    offered_name: str
    height: int


def trend_of(session: Session, job: Job) -> TrendOut | None:
    """The trend of a job; None where it asks for none, or has too many runs for one."""
    if not has_trend(job):
        return None
    try:
        return trend(session, job.id)
    except InvalidRequest:
        return None


def trend_view(found: TrendOut) -> TrendView:
    """The tables of a trend."""
    document = found.model_dump()
    shown: list[Quantity] = [
        one for one in document["quantities"] if any(p["value"] is not None for p in one["points"])
    ]
    return TrendView(
        x=found.x,
        headings=[one["name"] + (f" [{one['unit']}]" if _has_unit(one) else "") for one in shown],
        rows=[_row(place, shown) for place in document["places"]],
        laws=[
            (law_text(one["name"], law, found.x, _estimate), formats.number(law["aic"]),
             formats.number(law["birge"], 3), law["is_chosen"])
            for one in shown for law in one["laws"]
        ],
        predictions=[_prediction(one, at) for one in shown for at in one["predictions"]],
        reasons=[f"{one['name']}: {one['reason']}" for one in shown if one["reason"]],
        notes=notes(document), reference=found.reference, reference_text=reference_text(document),
        offered=_offered(found), offered_name=next(iter(found.reference_names), ""),
        height=trend_height(max(len(shown), 1)),
    )  # fmt: skip


def _offered(found: TrendOut) -> str:
    runs = {place.x: place.runs[0] for place in found.places if place.runs}
    middle = list(runs.values())[len(runs) // 2 : len(runs) // 2 + 1]
    known = None if found.reference_x is None else runs.get(found.reference_x)
    return known or next(iter(middle), "")


def _row(place: dict[str, Any], quantities: Sequence[Quantity]) -> RowView:
    known: list[Mapping[str, Any] | None] = [
        next((point for point in one["points"] if point["x"] == place["x"]), None)
        for one in quantities
    ]
    return RowView(
        x_text=f"{place['x']:g}".replace("-", "−"),
        cells=[formats.DASH if p is None or p["value"] is None else _estimate(p) for p in known],
        span_text="; ".join(map(span_text, place["spans"])) or formats.DASH,
        evaluations=place["evaluations"], flags=flags(place, list(quantities)),
        runs=place["runs"],
    )  # fmt: skip


def _estimate(one: Mapping[str, Any]) -> str:
    return " ± ".join(filter(None, formats.estimate(one["value"], one["stderr"])))


def _prediction(one: Quantity, at: Mapping[str, Any]) -> tuple[str, str, str, str, str]:
    name, x = str(one["name"]), f"{at['x']:g}"
    if at["value"] is None or at["lower"] is None:
        return name, x, formats.DASH, formats.DASH, "the law has no value here"
    ends = " … ".join(formats.number(at[end]) for end in ("lower", "upper"))
    unit = formats.unit(one["unit"])
    outside = "extrapolated" if at["is_outside"] else ""
    return name, x, formats.number(at["value"]) + unit, ends + unit, outside


def _has_unit(one: Quantity) -> bool:
    return one["unit"] not in ("", "1")
