"""Draw the trend of a batch: every quantity over the label, its law with band, and predictions."""

from typing import Any

from service.core.label_text import name_label
from service.trends.trend_schemas import LawOut, LawPointOut, PointOut, QuantityOut, TrendOut
from sysid.core.text import append_unit, format_number
from sysid.figures import theme
from sysid.figures.figure_grid import WIDE_MARGIN, PlotArea, add_axes, add_caption, wide_grid
from sysid.figures.plotly import Figure, base_layout, to_json_numbers

_BAND = "rgba(42,131,196,0.15)"
_ESTIMATES_LABEL, _LAW_LABEL, _OTHER_LABEL = (
    "estimate ± standard error",
    "chosen law, 95 % band",
    "other law",
)
_PREDICTED_LABEL, _FLAGGED_LABEL = "prediction, 95 % interval", "outlier or drift"
_EXPECTED_LABEL = "what the reference expects"

AxisNames = dict[str, str]


def plot_trend(trend: TrendOut, columns: int = 2) -> Figure:
    """Draw estimates with error bars over x, one small plot per quantity.

    Each plot has the chosen law as a line in its confidence band, and the other law dotted.
    Predictions are diamonds with their intervals. Rings mark outliers and drifted estimates.
    """
    shown = _list_drawn(trend)
    grid = wide_grid(len(shown), columns)
    figure: Figure = {
        "data": [],
        "layout": base_layout(grid.height(WIDE_MARGIN), annotations=[], margin=WIDE_MARGIN),
    }
    in_legend: set[str] = set()
    for number, quantity in enumerate(shown):
        axis_names = _add_axes(figure, number, quantity, trend.x, grid.get_area(number))
        for trace in _quantity_traces(quantity):
            name = trace["legendgroup"]
            first = name not in in_legend and trace.get("showlegend", True)
            label = name if first else f"{quantity.name}: {name}"
            in_legend.update({name} if first else ())
            figure["data"].append({**trace, "name": label, "showlegend": first, **axis_names})
    return figure


def trend_height(trend: TrendOut, columns: int = 2) -> int:
    """Compute the height (px) of the figure, so that a page can reserve its room."""
    return wide_grid(max(len(_list_drawn(trend)), 1), columns).height(WIDE_MARGIN)


def _list_drawn(trend: TrendOut) -> list[QuantityOut]:
    """List the quantities with a value; an onset delay only if it has a law."""
    return [
        quantity
        for quantity in trend.quantities
        if quantity.laws
        or (quantity.kind == "parameter" and any(p.value is not None for p in quantity.points))
    ]


def _add_axes(
    figure: Figure, number: int, quantity: QuantityOut, x: str, domain: PlotArea
) -> AxisNames:
    small = {"size": 11}
    axis_names = add_axes(
        figure,
        number,
        domain,
        {
            "nticks": 7,
            "rangemode": "tozero",
            "title": {"text": name_label(x), "font": small, "standoff": 4},
            **({} if number == 0 else {"matches": "x"}),
        },
        {"nticks": 6, "title": {"text": append_unit(quantity.name, quantity.unit), "font": small}},
    )
    add_caption(figure, _law_caption(quantity, x), domain)
    return axis_names


def _law_caption(quantity: QuantityOut, x: str) -> str:
    chosen = next((law for law in quantity.laws if law.is_chosen), None)
    if chosen is None:
        return f"<b>{quantity.name}</b>: no law"
    return f"<b>{quantity.name}</b> = {_law_formula(chosen, x)}"


def _law_formula(law: LawOut, x: str) -> str:
    a, b = (format_number(coefficient.value) for coefficient in law.coefficients)
    return f"{a} + {b}·{x}".replace("+ −", "− ") if law.law == "line" else f"{a}·{x}<sup>{b}</sup>"


def _quantity_traces(quantity: QuantityOut) -> list[dict[str, Any]]:
    estimated = [point for point in quantity.points if point.value is not None]
    return [
        *_law_traces(quantity.band),
        *_other_law_traces(quantity),
        *_reference_traces(estimated),
        *_prediction_traces(quantity.predictions),
        *_flag_traces(estimated),
        _estimate_trace(estimated),
    ]


def _scatter_trace(
    group: str, mode: str, x: list[Any], y: list[Any], **options: Any
) -> dict[str, Any]:
    return {"type": "scatter", "legendgroup": group, "mode": mode, "x": x, "y": y, **options}


def _law_traces(places: list[LawPointOut]) -> list[dict[str, Any]]:
    if not places:
        return []
    x = to_json_numbers(point.x for point in places)
    edge = {"line": {"width": 0}, "showlegend": False, "hoverinfo": "skip"}
    low, high, middle = (
        _to_json_numbers([getattr(point, name) for point in places])
        for name in ("lower", "upper", "value")
    )
    return [
        _scatter_trace(_LAW_LABEL, "lines", x, low, **edge),
        _scatter_trace(_LAW_LABEL, "lines", x, high, **edge, fill="tonexty", fillcolor=_BAND),
        _scatter_trace(
            _LAW_LABEL,
            "lines",
            x,
            middle,
            line={"color": theme.BLUE, "width": 1.8},
            hovertemplate="law at %{x:.4g}: %{y:.4g}<extra></extra>",
        ),
    ]


def _other_law_traces(quantity: QuantityOut) -> list[dict[str, Any]]:
    """Draw the law that was not chosen, over the same range."""
    law = next((law for law in quantity.laws if not law.is_chosen), None)
    if law is None:
        return []
    a, b = (coefficient.value for coefficient in law.coefficients)
    x = [point.x for point in quantity.band]
    y = [a + b * at if law.law == "line" else _power_law(a, b, at) for at in x]
    return [
        _scatter_trace(
            _OTHER_LABEL,
            "lines",
            to_json_numbers(x),
            to_json_numbers(y),
            line={"color": theme.GREY, "dash": "dot", "width": 1.4},
            hovertemplate=f"{law.formula} at %{{x:.4g}}: %{{y:.4g}}<extra></extra>",
        )
    ]


def _power_law(a: float, b: float, x: float) -> float:
    return float(a * x**b) if x > 0 else float("nan")


def _estimate_trace(points: list[PointOut]) -> dict[str, Any]:
    colour = theme.VERMILLION
    return _scatter_trace(
        _ESTIMATES_LABEL,
        "markers",
        to_json_numbers(point.x for point in points),
        _to_json_numbers([point.value for point in points]),
        error_y={
            "type": "data",
            "array": _to_json_numbers([p.stderr or 0.0 for p in points]),
            "color": colour,
            "thickness": 1.4,
            "width": 4,
        },
        marker={
            "color": colour,
            "size": 7,
            "symbol": ["circle" if p.is_used else "circle-open" for p in points],
        },
        customdata=[
            [f"{p.stderr:.3g}" if p.stderr else "–", len(p.runs), p.status] for p in points
        ],
        hovertemplate="%{x:.4g}: %{y:.5g} ± %{customdata[0]}<br>%{customdata[1]} runs, "
        "%{customdata[2]}<extra></extra>",
    )


def _prediction_traces(places: list[LawPointOut]) -> list[dict[str, Any]]:
    predicted = [point for point in places if point.value is not None and point.upper is not None]
    if not predicted:
        return []
    return [
        _scatter_trace(
            _PREDICTED_LABEL,
            "markers",
            to_json_numbers(point.x for point in predicted),
            _to_json_numbers([point.value for point in predicted]),
            error_y={
                "type": "data",
                "symmetric": True,
                "color": theme.GREEN,
                "thickness": 1.4,
                "width": 6,
                "array": _to_json_numbers([_half_width(point) for point in predicted]),
            },
            marker={"color": theme.GREEN, "size": 9, "symbol": "diamond-open"},
            hovertemplate="predicted at %{x:.4g}: %{y:.4g} ± %{error_y.array:.2g}<extra></extra>",
        )
    ]


def _half_width(point: LawPointOut) -> float:
    return 0.5 * ((point.upper or 0.0) - (point.lower or 0.0))


def _flag_traces(points: list[PointOut]) -> list[dict[str, Any]]:
    flagged = [p for p in points if p.is_outlier or any(drift.drifted for drift in p.drifts)]
    if not flagged:
        return []
    return [
        _scatter_trace(
            _FLAGGED_LABEL,
            "markers",
            to_json_numbers(p.x for p in flagged),
            _to_json_numbers([p.value for p in flagged]),
            hoverinfo="skip",
            marker={
                "color": theme.PURPLE,
                "size": 18,
                "symbol": "circle-open",
                "line": {"width": 2},
            },
        )
    ]


def _reference_traces(points: list[PointOut]) -> list[dict[str, Any]]:
    pairs = [(p.x, drift.expected) for p in points for drift in p.drifts]
    if not pairs:
        return []
    return [
        _scatter_trace(
            _EXPECTED_LABEL,
            "markers",
            to_json_numbers(x for x, _ in pairs),
            to_json_numbers(y for _, y in pairs),
            marker={
                "color": theme.GREY,
                "size": 10,
                "symbol": "x-thin",
                "line": {"width": 2, "color": theme.GREY},
            },
            hovertemplate="the reference expects %{y:.5g} at %{x:.4g}<extra></extra>",
        )
    ]


def _to_json_numbers(values: list[float | None]) -> list[float | None]:
    return [None if value is None else to_json_numbers([value])[0] for value in values]
