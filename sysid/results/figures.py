"""Draw the figures of a result, and convert channels and correlations to the data of figures."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np

from sysid.core.errors import InvalidSettings, suggest_name
from sysid.core.lazy_names import load_library
from sysid.core.settings import LossKind
from sysid.core.text import find_shown_error
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.figures import plotly
from sysid.figures.data import (
    BandTraces,
    CornerParameter,
    CorrelationTrace,
    ExperimentTraces,
    FreeParameter,
    IslandImprovement,
    OutputTraces,
    RunFigureData,
    SignalTrace,
)
from sysid.figures.plotly import Figure, apply_theme, empty_figure, has_points
from sysid.figures.posterior import plot_posterior
from sysid.figures.residuals import plot_residuals
from sysid.figures.signals import plot_response
from sysid.figures.stack import stack_figures
from sysid.figures.theme import Theme
from sysid.residuals.residual_tests import CorrelationFunction
from sysid.results.result import FullResult, find_output_unit
from sysid.uncertainty.estimates import Estimate

if TYPE_CHECKING:
    from sysid.uncertainty.output_bands import OutputBands

FigureName = Literal[
    "history", "convergence", "response", "residuals", "correlation", "waterfall", "posterior"
]
FIGURES: tuple[FigureName, ...] = get_args(FigureName)
RecordTraces: TypeAlias = tuple[tuple[OutputTraces, ...], tuple[SignalTrace, ...]]
"""Outputs and inputs of a record."""
_USUAL: tuple[FigureName, ...] = ("response", "residuals", "correlation", "waterfall")


def plot_result(
    found: FullResult,
    names: Sequence[FigureName | Sequence[FigureName]],
    experiment: int,
    theme: Theme,
) -> Any:
    """Draw figures of a result as one figure of Plotly; without names the usual ones.

    Raises
    ------
    MissingLibrary
        If Plotly is not installed.
    InvalidSettings
        If there is no such figure, experiment or theme, or a named figure has no data.
    """
    wanted = tuple(_iterate_names(names))
    if theme not in get_args(Theme):
        raise InvalidSettings(
            "/theme", f"found {theme!r}; need one of {', '.join(get_args(Theme))}"
        )
    if isinstance(experiment, bool) or not isinstance(experiment, int | np.integer):
        raise InvalidSettings("/experiment", f"found {experiment!r}; need a whole number, from 0")
    for name in wanted:
        if not draw_figures(found, [name], experiment):
            raise InvalidSettings("/names", _describe_missing_figure(name))
    titled = draw_figures(found, wanted or _USUAL, experiment)
    if not titled:
        raise InvalidSettings("/names", "the result has no signals to draw")
    go = load_library("plotly.graph_objects", "plot()")
    figure = titled[0][1] if len(titled) == 1 else stack_figures(titled)
    layout = {key: value for key, value in figure["layout"].items() if key != "meta"}
    return go.Figure(apply_theme({"data": figure["data"], "layout": layout}, theme))


def _iterate_names(names: Sequence[FigureName | Sequence[FigureName]]) -> Iterator[FigureName]:
    """Yield checked names of figures; a list of them stands for its names."""
    for name in names:
        if isinstance(name, list | tuple):
            yield from _iterate_names(name)
        elif name in FIGURES:
            yield name
        else:
            detail = f"there is no figure {name!r}{suggest_name(str(name), FIGURES)}"
            raise InvalidSettings("/names", detail)


def _describe_missing_figure(name: FigureName) -> str:
    if name == "posterior":
        return "no posterior was sampled; call identify(…, posterior=True)"
    return f"the result has no data for the figure {name!r}"


def draw_figures(
    found: FullResult, names: Sequence[FigureName], experiment: int = 0
) -> list[tuple[str, Figure]]:
    """Draw figures of a result that have data, each with its title.

    Raises
    ------
    InvalidSettings
        If there is no such experiment.
    """
    experiments = list_experiments(found)
    if experiments and not 0 <= experiment < len(experiments):
        known = ", ".join(f"{i} ({one.name})" for i, one in enumerate(experiments))
        detail = f"found {experiment!r}; the records are {known}"
        raise InvalidSettings("/experiment", detail)
    data = to_figure_data(found)
    draw: dict[FigureName, Callable[[], tuple[str, Figure]]] = {
        "history": lambda: ("Progress of every island", plotly.plot_history(data)),
        "convergence": lambda: ("Convergence of the parameters", plotly.plot_convergence(data)),
        "response": lambda: _draw_response(found, experiments, experiment),
        "residuals": lambda: _draw_residuals(found, experiments, experiment),
        "correlation": lambda: ("Correlation of the estimates", plotly.plot_correlation(data)),
        "waterfall": lambda: ("What each island found", plotly.plot_waterfall(data)),
        "posterior": lambda: ("Posterior", _draw_posterior(found)),
    }
    drawn = [draw[name]() for name in names]
    return [(title, figure) for title, figure in drawn if has_points(figure)]


def _draw_response(
    found: FullResult, experiments: Sequence[ExperimentTraces], number: int
) -> tuple[str, Figure]:
    from sysid.results.bands import compute_record_bands  # it imports the compiler

    if not experiments:
        return "Measured against identified", empty_figure()
    title = "Measured against identified"
    if len(experiments) > 1:
        title += f": {experiments[number].name}"
    return title, plot_response(add_bands(experiments, compute_record_bands(found))[number])


def _draw_residuals(
    found: FullResult, experiments: Sequence[ExperimentTraces], number: int
) -> tuple[str, Figure]:
    title = "Correlation of the residuals"
    if found.data is None:
        return title, empty_figure()
    tested = found.data.validation or found.data.records
    first = len(experiments) - len(tested)  # separate validation records come last
    shown = max(number - first, 0)
    traces = [
        to_correlation_trace(function)
        for function in found.data.correlations
        if function.test.experiment == shown and function.values.size
    ]
    if len(tested) > 1:
        title += f": {experiments[shown + first].name}"
    return title, plot_residuals(traces)


def _draw_posterior(found: FullResult) -> Figure:
    posterior, correlation = found.posterior, found.correlation
    if posterior is None:
        return empty_figure()
    estimates = {estimate.name: estimate for estimate in found.parameters}
    parameters = [
        CornerParameter(
            **{
                name: getattr(estimates[parameter.name], name)
                for name in ("name", "unit", "lower", "upper", "value", "stderr", "interval95")
            },
            posterior95=parameter.interval95,
            samples=posterior.samples[:, column],
        )
        for column, parameter in enumerate(posterior.parameters)
    ]
    return plot_posterior(parameters, np.array([]) if correlation is None else correlation.matrix)


def to_figure_data(found: FullResult) -> RunFigureData:
    """Convert search and estimates of a result to the data of their figures."""
    return RunFigureData(
        id="",
        unit=find_output_unit(found),
        fitness_label=label_fitness("squares" if found.data is None else found.data.loss),
        generations=found.generations,
        evaluations=found.evaluations,
        parameters=[_to_free_parameter(found, one) for one in found.parameters if one.is_free],
        history=[
            [IslandImprovement(*improvement) for improvement in island] for island in found.history
        ],
        islands=[(island.champion_rms, island.refined_rms) for island in found.islands],
        correlation=None
        if found.correlation is None
        else {"names": found.correlation.names, "matrix": found.correlation.matrix},
    )


def label_fitness(loss: LossKind) -> str:
    """Label of the minimised fitness; with soft-l1 it is not J."""
    return "soft-l1 loss, as RMS" if loss == "soft-l1" else "RMS"


def _to_free_parameter(found: FullResult, estimate: Estimate) -> FreeParameter:
    scales = {} if found.data is None else {p.name: p.scale for p in found.data.model.parameters}
    return FreeParameter(
        estimate.name,
        estimate.unit,
        estimate.lower,
        estimate.upper,
        scales.get(estimate.name, "linear"),
        estimate.value,
        find_shown_error(estimate.stderr, estimate.status),
    )


def list_experiments(found: FullResult) -> list[ExperimentTraces]:
    """List the records with measured and identified outputs; none without the fitted data."""
    data = found.data
    if data is None:
        return []
    return arrange_experiments(
        list(_pair(data.records, found.simulated)),
        list(_pair(data.validation, found.simulated_validation)),
        is_part=data.is_part,
    )


def add_bands(
    experiments: Sequence[ExperimentTraces], bands: Sequence[Sequence["OutputBands"]]
) -> list[ExperimentTraces]:
    """Add the bands of the records that were fitted; they are the first experiments."""
    drawn = [
        replace(
            experiment,
            outputs=tuple(
                replace(output, bands=BandTraces(band.confidence, band.prediction))
                for output, band in zip(experiment.outputs, banded, strict=True)
            ),
        )
        for experiment, banded in zip(experiments, bands, strict=False)
    ]
    return [*drawn, *experiments[len(drawn) :]]


def arrange_experiments(
    estimation: Sequence[RecordTraces], validation: Sequence[RecordTraces], *, is_part: bool
) -> list[ExperimentTraces]:
    """Name the records of estimation and validation data.

    If validation `is_part` of the same records, each is one experiment with the inputs of both.
    """
    fitted = [
        ExperimentTraces(f"estimation {number}", outputs, inputs)
        for number, (outputs, inputs) in enumerate(estimation, 1)
    ]
    if is_part:
        return [
            _join_validation(replace(experiment, inputs=inputs), outputs)
            for experiment, (outputs, inputs) in zip(fitted, validation, strict=True)
        ]
    return fitted + [
        ExperimentTraces(f"validation {number}", outputs, inputs, -inf)
        for number, (outputs, inputs) in enumerate(validation, 1)
    ]


def _pair(
    records: Sequence[Record], simulated: Sequence[Sequence[FloatArray]]
) -> Iterator[RecordTraces]:
    for record, outputs in zip(records, simulated, strict=True):
        pairs = zip(record.outputs, outputs, strict=True)
        yield (
            tuple(OutputTraces(to_signal_trace(channel), values) for channel, values in pairs),
            tuple(to_signal_trace(channel) for channel in record.inputs),
        )


def _join_validation(
    experiment: ExperimentTraces, later: Sequence[OutputTraces]
) -> ExperimentTraces:
    """Join the parts of a record whose last part was used for validation."""
    if not later:
        return experiment
    outputs = tuple(
        OutputTraces(
            SignalTrace(
                first.measured.name,
                first.measured.unit,
                np.concatenate([first.measured.times, rest.measured.times]),
                np.concatenate([first.measured.values, rest.measured.values]),
            ),
            np.concatenate([first.identified, rest.identified]),
        )
        for first, rest in zip(experiment.outputs, later, strict=True)
    )
    since = min(float(rest.measured.times[0]) for rest in later)
    return ExperimentTraces(
        experiment.name.replace("estimation", "record"), outputs, experiment.inputs, since
    )


def to_signal_trace(channel: Channel) -> SignalTrace:
    """Convert a channel with its history to a line of a figure."""
    held, before = channel.effective_hold == "zero", None
    if channel.history is not None:  # including the first sample, so that the lines meet
        pairs = zip(channel.history, (channel.times, channel.values), strict=True)
        times, values = (np.append(history, samples[0]) for history, samples in pairs)
        before = SignalTrace(channel.name, channel.unit, times, values, held)
    return SignalTrace(channel.name, channel.unit, channel.times, channel.values, held, before)


def to_correlation_trace(correlation: CorrelationFunction) -> CorrelationTrace:
    """Convert a correlation function to the data of its figure."""
    test = correlation.test
    of = "" if test.input is None else f" with {test.input}"
    kind = "autocorrelation" if test.input is None else "correlation"
    title = f"{kind} of the residual of {test.output}{of}: {test.outcome}"
    return CorrelationTrace(
        title,
        test.input is None,
        correlation.period,
        correlation.lags,
        correlation.values,
        correlation.band95,
        correlation.band99,
    )
