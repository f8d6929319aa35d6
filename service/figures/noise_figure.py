"""Draw Figure 15: errors of the response and of each parameter against the noise, by method."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from service.core.bodies.job_fields import SIGMA_PATH
from service.core.label_text import format_value
from service.sweeps.group_cramer_rao import scale_to_median
from service.sweeps.sweep_schemas import GroupOut, ParameterSummaryOut, SummaryOut
from sysid.core.text import append_unit, bracket_unit
from sysid.figures import theme
from sysid.figures.figure_grid import WIDE_MARGIN, PlotArea, add_axes, add_caption, wide_grid
from sysid.figures.plotly import Figure, base_layout, to_json_numbers

METHOD_PATH = "/algorithm/method"
MAX_SERIES = 12
QUANTILE_95 = 1.6449  # standard deviations from the median to the 95 % quantile

_METHOD_STYLES: Mapping[str, dict[str, Any]] = {
    "simple": {"color": theme.VERMILLION, "dash": "dashdot", "width": 1.6},
    "improved-paper": {"color": theme.PURPLE, "dash": "dot", "width": 1.8},
    "improved": {"color": theme.BLUE, "dash": "solid", "width": 2},
}
_OTHER_STYLES = ((theme.GREEN, "solid"), (theme.OCHRE, "dashdot"), (theme.PURPLE, "solid"))
_BOUND_STYLE = {"color": theme.GREY, "dash": "dash", "width": 1.6}


@dataclass(slots=True)
class _Band:
    """Quantiles of one quantity over σ: 5, 50 and 95 %."""

    x: list[float] = field(default_factory=list)
    low: list[float] = field(default_factory=list)
    middle: list[float] = field(default_factory=list)
    high: list[float] = field(default_factory=list)

    def add_quantiles(self, sigma: float, quantiles: Sequence[float]) -> None:
        self.x.append(sigma)
        for values, index in ((self.low, 0), (self.middle, 2), (self.high, 4)):
            values.append(quantiles[index])


@dataclass(slots=True)
class _Panel:
    """One pair of axes: a band for each series, and the Cramér–Rao bound by σ."""

    caption: str
    title: str
    is_signed: bool
    bands: dict[str, _Band] = field(default_factory=dict)
    cramer_rao: dict[float, float] = field(default_factory=dict)


def noise_group_keys(axes: Sequence[Mapping[str, Any]]) -> list[str] | None:
    """Return the keys to group runs by: σ and all axes but seeds; None if σ is no axis."""
    paths = [axis["path"] for axis in axes]
    return [path for path in paths if not path.endswith("/seed")] if SIGMA_PATH in paths else None


def plot_noise_sweep(summary: SummaryOut, unit: str, columns: int = 2) -> Figure:
    """Draw medians and 5 to 95 % bands over σ, one line per method, and the Cramér–Rao bound.

    The first plot shows the RMS between the identified response and the record without noise. The
    others show each parameter's estimate minus its reference. Quantiles are of the runs that
    succeeded.
    """
    panels = _build_panels(summary, unit)
    grid = wide_grid(len(panels), columns)
    figure: Figure = {
        "data": [],
        "layout": base_layout(grid.height(WIDE_MARGIN), annotations=[], margin=WIDE_MARGIN),
    }
    in_legend: set[str] = set()
    for number, panel in enumerate(panels):
        _add_panel(figure, number, panel, grid.get_area(number), unit, in_legend)
    return figure


def noise_sweep_height(n_panels: int, columns: int = 2) -> int:
    """Compute the height (px) of the figure, so that a page can reserve its room."""
    return wide_grid(n_panels, columns).height(WIDE_MARGIN)


def _build_panels(summary: SummaryOut, unit: str) -> list[_Panel]:
    suffix = bracket_unit(unit)
    response = _Panel("<b>RMS error</b> of the response", f"RMS error{suffix}", is_signed=False)
    panels = {"": response}
    for group in summary.groups:
        name = _series_name(group)
        if group.sigma is None or not _is_shown(name, response):
            continue
        if group.rms_noise_free is not None:
            _get_band(response, name).add_quantiles(group.sigma, group.rms_noise_free)
        bound = scale_to_median(group.model_dump())
        if bound is not None:
            response.cramer_rao[group.sigma] = bound
        for parameter in group.parameters:
            _add_parameter_error(
                panels.setdefault(parameter.name, _parameter_panel(parameter)),
                name,
                group.sigma,
                parameter,
            )
    return [panel for panel in panels.values() if panel.bands]


def _add_parameter_error(
    panel: _Panel, name: str, sigma: float, parameter: ParameterSummaryOut
) -> None:
    if parameter.error is not None:
        _get_band(panel, name).add_quantiles(sigma, parameter.error)
    if parameter.cramer_rao_bound is not None:
        panel.cramer_rao[sigma] = parameter.cramer_rao_bound


def _parameter_panel(parameter: ParameterSummaryOut) -> _Panel:
    suffix = bracket_unit(parameter.unit)
    reference = (
        "" if parameter.reference is None else f" − {parameter.reference:.6g}".replace("−-", "+")
    )
    return _Panel(
        f"<b>{parameter.name}</b>{reference}", f"error of {parameter.name}{suffix}", is_signed=True
    )


def _get_band(panel: _Panel, name: str) -> _Band:
    return panel.bands.setdefault(name, _Band())


def _is_shown(name: str, panel: _Panel) -> bool:
    return name in panel.bands or len(panel.bands) < MAX_SERIES


def _series_name(group: GroupOut) -> str:
    """Name a group by its keys other than σ."""
    rest = {key: value for key, value in group.key.items() if key != SIGMA_PATH}
    if list(rest) == [METHOD_PATH]:
        return str(rest[METHOD_PATH])
    return ", ".join(map(format_value, rest.values())) or "all runs"


def _line_style(name: str, number: int) -> dict[str, Any]:
    if name in _METHOD_STYLES:
        return dict(_METHOD_STYLES[name])
    if number >= len(_OTHER_STYLES):
        return theme.series_style(number)
    colour, dash = _OTHER_STYLES[number]
    return {"color": colour, "dash": dash, "width": 1.6}


def _add_panel(
    figure: Figure, number: int, panel: _Panel, domain: PlotArea, unit: str, in_legend: set[str]
) -> None:
    small = {"size": 11}
    axis_names = add_axes(
        figure,
        number,
        domain,
        {
            "rangemode": "tozero",
            "nticks": 7,
            "title": {"text": append_unit("σ", unit), "font": small, "standoff": 4},
            **({} if number == 0 else {"matches": "x"}),
        },
        {
            "nticks": 6,
            "zeroline": True,
            **({} if panel.is_signed else {"rangemode": "tozero"}),
            "title": {"text": panel.title, "font": small},
        },
    )
    for place_in_order, (name, band) in enumerate(panel.bands.items()):
        first = name not in in_legend
        in_legend.add(name)
        label = name if number == 0 else f"{panel.title}: {name}"
        figure["data"] += _band_traces(
            band, label, name, _line_style(name, place_in_order), axis_names, first
        )
    figure["data"] += _bound_traces(panel, axis_names, in_legend)
    add_caption(figure, panel.caption, domain)


def _band_traces(
    band: _Band,
    label: str,
    group: str,
    line: dict[str, Any],
    axis_names: dict[str, str],
    first: bool,
) -> list[dict[str, Any]]:
    """Draw the band between its two edges, and the median over it."""
    order = sorted(range(len(band.x)), key=band.x.__getitem__)
    x = to_json_numbers(band.x[i] for i in order)
    low, middle, high = (
        to_json_numbers(values[i] for i in order) for values in (band.low, band.middle, band.high)
    )
    shared = {"type": "scatter", "x": x, "legendgroup": group, **axis_names}
    edge = {
        **shared,
        "mode": "lines",
        "line": {"width": 0},
        "showlegend": False,
        "hoverinfo": "skip",
    }
    return [
        {**edge, "name": f"{label}, 5 %", "y": low},
        {
            **edge,
            "name": f"{label}, 95 %",
            "y": high,
            "fill": "tonexty",
            "fillcolor": theme.fade(line["color"], 0.15),
        },
        {
            **shared,
            "mode": "lines+markers",
            "name": label,
            "y": middle,
            "line": line,
            "marker": {"size": 5, "color": line["color"]},
            "showlegend": first,
            "hovertemplate": f"{group}<br>σ %{{x:.4g}}: %{{y:.4g}}<extra></extra>",
        },
    ]


def _bound_traces(
    panel: _Panel, axis_names: dict[str, str], in_legend: set[str]
) -> list[dict[str, Any]]:
    """Draw the Cramér–Rao bound: for parameters, the 5 and 95 % quantiles that it implies."""
    x = sorted(panel.cramer_rao)
    if not x:
        return []
    signs = (-QUANTILE_95, QUANTILE_95) if panel.is_signed else (1.0,)
    name = "Cramér–Rao bound (median; 5 and 95 %)"
    lines = []
    for sign in signs:
        lines.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": name,
                "legendgroup": name,
                "showlegend": name not in in_legend,
                "x": to_json_numbers(x),
                "y": to_json_numbers(sign * panel.cramer_rao[sigma] for sigma in x),
                "line": dict(_BOUND_STYLE),
                **axis_names,
                "hovertemplate": "bound, σ %{x:.4g}: %{y:.4g}<extra></extra>",
            }
        )
        in_legend.add(name)
    return lines
