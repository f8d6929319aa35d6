"""How each model of the catalogue answers: a figure of its input and its outputs."""

from typing import Any

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from sysid.core.text import bracket_unit
from sysid.data.records import Channel
from sysid.figures.theme import plotly_template, series_style
from sysid.models.catalogue.load import load_model
from tests.support.library.catalogue_cases import CASES, make_record

MAX_SAMPLES = 500
INK = "#7f8890"  # readable on white and on black


def draw_response(name: str) -> Any:
    """Draw the record on which the model is tested, outputs above, inputs below."""
    model = load_model(name)
    case = CASES[name]
    record = make_record(model, case)
    rows = [group for group in (record.outputs, record.inputs) if group]
    figure = make_subplots(len(rows), 1, shared_xaxes=True, vertical_spacing=0.08)
    for row, channels in enumerate(rows, 1):
        for number, channel in enumerate(channels):
            figure.add_trace(_draw_channel(channel, 2 * (row - 1) + number), row=row, col=1)
        title = ", ".join(_name_axis(channel) for channel in channels)
        figure.update_yaxes(title_text=title, row=row, col=1)
    figure.update_xaxes(title_text="time [s]", row=len(rows), col=1)
    figure.update_layout(
        template=plotly_template("light"),
        font_color=INK,
        width=720,
        height=150 + 130 * len(rows),
        margin={"l": 70, "r": 15, "t": 12, "b": 48},
        showlegend=False,
    )
    grid = {"gridcolor": "rgba(127,136,144,.25)", "linecolor": INK, "tickcolor": INK}
    figure.update_xaxes(**grid)
    figure.update_yaxes(nticks=5, **grid)
    return figure


def describe_case(name: str) -> str:
    """Name the values at which the model is drawn; those that are not 0."""
    values = {**CASES[name].truth, **CASES[name].initial}
    return ", ".join(f"{parameter} = {value:.4g}" for parameter, value in values.items() if value)


def _draw_channel(channel: Channel, number: int) -> go.Scatter:
    times, values = channel.times[:MAX_SAMPLES], channel.values[:MAX_SAMPLES]
    style = {**series_style(number), "shape": "hv" if channel.hold == "zero" else "linear"}
    return go.Scatter(x=times, y=values, mode="lines", line=style, name=channel.name)


def _name_axis(channel: Channel) -> str:
    return f"{channel.name}{bracket_unit(channel.unit)}"
