"""The figure of a control loop begins near the step of its reference."""

import numpy as np

from service.figures.simulation_figure import begin_near_step
from sysid.figures.plotly import Figure


def _cut(step_time: float) -> list[float]:
    figure: Figure = {"data": [{"x": np.arange(0.0, 101.0), "y": np.zeros(101)}], "layout": {}}
    begin_near_step(figure, step_time)
    assert len(figure["data"][0]["x"]) == len(figure["data"][0]["y"])
    return [float(value) for value in figure["data"][0]["x"]]


def test_a_tenth_of_the_time_after_the_step_is_shown_before_it() -> None:
    assert _cut(50.0) == list(range(45, 101))


def test_without_a_time_after_the_step_all_is_shown() -> None:
    assert _cut(100.0) == _cut(500.0) == list(range(101))
