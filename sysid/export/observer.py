"""An identified model as observer: a filter that is given inputs and outputs sample by sample.

Its program is that of the free run on a window of the last samples, which moves by one sample at a
time. The window is as long as the longest time lag, so it needs a fixed memory.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil

from sysid.control.linear_form import IdentifiedModel, IdentifiedValue
from sysid.core.settings import FILTERED
from sysid.export.program import GeneratedProgram
from sysid.kernels.signals.past_reads import is_difference, list_delayed_values
from sysid.language.delays import has_varying_delay, mentions_time
from sysid.language.evaluation import evaluate_expression
from sysid.language.tree import Expression
from sysid.models.kalman_filter import NoiseScales, add_kalman_filter
from sysid.models.model import Model, replace_substeps
from sysid.results.parts import find_sensor_weights
from sysid.results.result import Result

_MARGIN = 4  # samples beyond the longest lag: for interpolation


@dataclass(frozen=True, slots=True)
class Observer:
    """A filter with values for all its parameters, for samples of one period.

    Attributes
    ----------
    identified : IdentifiedModel
        The model with its filter.
    sensors : mapping of str to float
        Variance of each output's sensor, over that which sizes of noise are relative to.
    sample_time : float
        Period, s.
    samples : int
        Samples of the window.
    """

    identified: IdentifiedModel
    sensors: Mapping[str, float]
    sample_time: float
    samples: int

    @property
    def steps(self) -> int:
        """Integration steps of the window."""
        return (self.samples - 1) * self.substeps

    @property
    def substeps(self) -> int:
        """Integration steps in a sampling period."""
        return self.identified.model.solver.substeps

    @property
    def longest_lag(self) -> float:
        """Longest time lag that the window has room for, s."""
        return (self.samples - _MARGIN) * self.sample_time


def build_observer(identified: IdentifiedModel, result: Result) -> Observer | None:
    """Build the observer of a result; None if no noise acts inside the plant, or it has none.

    It has none if the model is a recursion, if samples are irregular, if the model has a grid, a
    history or switches of its own time, or if a lag follows an input.
    """
    noise, period = result.noise_model, identified.sample_time
    if result.plant_noise is None or noise not in FILTERED or period is None:
        return None
    if is_difference(identified.model):
        return None
    # of bounds, which an observer does not have
    scales = NoiseScales({}, period, 1e3 * period, period)
    plain = replace_substeps(identified.model, result.substeps)
    model = add_kalman_filter(plain, noise, scales, {})
    if _has_own_time(model):
        return None
    values = tuple(
        IdentifiedValue(one.name, one.value, one.unit, one.stderr, one.status)
        for one in result.parameters
    )
    filtered = replace(identified, model=model, values=values, covariance=None)
    lags = [
        evaluate_expression(past.delay, filtered.parameter_values)
        for kind in ("input", "state")
        for past in list_delayed_values(model, kind)
        if past.delay is not None
    ]
    samples = ceil(max([0.0, *lags]) / period) + _MARGIN
    weights = find_sensor_weights(result.plant_noise, filtered.parameter_values)
    sensors = {
        output.name: weights[output.name] ** -2.0 if len(model.outputs) > 1 else 1.0
        for output in model.outputs
    }
    return Observer(filtered, sensors, period, samples)


def _has_own_time(model: Model) -> bool:
    """Whether a model depends on the time since its start, or on lags without a bound."""
    return (
        model.solver.step is not None
        or bool(model.histories)
        or any(mentions_time(tree, "time", "index") for tree in _list_trees(model))
        or any(map(has_varying_delay, list_delayed_values(model, "input")))
    )


def _list_trees(model: Model) -> Iterator[Expression]:
    yield from model.equations
    yield from (output.expression for output in model.outputs)


def list_window_arrays(program: GeneratedProgram) -> list[str]:
    """List the arrays of a program that move with its window: states, then rises of their steps."""
    arrays = [program.array_names[state.name] for state in program.identified.model.states]
    return [*arrays, *(name for rises in program.rise_names.values() for name in rises)]


def pair_arguments(program: GeneratedProgram, names: Mapping[str, str]) -> list[tuple[str, str]]:
    """Pair each signal's name in the program with that of its present sample."""
    return [(name, program.name_argument(name, "now")) for name in names.values()]


def list_used_lines(named: Sequence[tuple[str, str]], body: Sequence[str]) -> list[str]:
    """List the lines whose names a body uses, or another such line after them."""
    used: list[str] = []
    for name, line in reversed(named):
        if any(re.search(rf"\b{name}\b", text) for text in (*body, *used)):
            used.insert(0, line)
    return used
