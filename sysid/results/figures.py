"""Draw the figures of a result, and convert channels and correlations to the data of figures."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import (
    TYPE_CHECKING,
    Any,
    Literal,
    NamedTuple,
    Protocol,
    TypeAlias,
    get_args,
)

import numpy as np

from sysid.core.errors import InvalidSettings, suggest_name
from sysid.core.lazy_names import load_library
from sysid.core.settings import LossKind
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.figures import plotly
from sysid.figures.data import (
    BandTraces,
    CorrelationTrace,
    DisturbanceTraces,
    ExperimentTraces,
    OutputTraces,
    SearchTraces,
    SignalTrace,
)
from sysid.figures.plotly import Abscissa, Figure, apply_theme, empty_figure, has_points
from sysid.figures.posterior_figures import plot_posterior
from sysid.figures.residual_figures import plot_residuals
from sysid.figures.signal_figures import plot_disturbances, plot_response
from sysid.figures.stack import stack_figures
from sysid.figures.theme import Theme
from sysid.models.parameters import Parameter, ParameterScale
from sysid.residuals.residual_tests import CorrelationFunction
from sysid.results.result import FullResult, Result, find_output_unit

if TYPE_CHECKING:
    from sysid.uncertainty.disturbances import Disturbance
    from sysid.uncertainty.output_bands import OutputBands

FigureName = Literal[
    "history",
    "convergence",
    "response",
    "disturbances",
    "residuals",
    "correlation",
    "waterfall",
    "posterior",
]
FIGURES: tuple[FigureName, ...] = get_args(FigureName)
RecordTraces: TypeAlias = tuple[tuple[OutputTraces, ...], tuple[SignalTrace, ...]]
"""Outputs and inputs of a record."""
TITLES: Mapping[FigureName, str] = {
    "history": "Progress of every island",
    "convergence": "Convergence of the parameters",
    "response": "Measured against identified",
    "disturbances": "Estimated disturbances",
    "residuals": "Correlation of the residuals",
    "correlation": "Correlation of the estimates",
    "waterfall": "What each island found",
    "posterior": "Posterior",
}
_USUAL: tuple[FigureName, ...] = (
    "response",
    "disturbances",
    "residuals",
    "correlation",
    "waterfall",
)


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
    if name == "disturbances":
        return "no noise acts inside the plant, or the result has no standard errors"
    return f"the result has no data for the figure {name!r}"


def draw_figures(
    found: FullResult, names: Sequence[FigureName], experiment: int = 0
) -> list[tuple[str, Figure]]:
    """Draw figures of a result that have data, each with its title.

    `experiment` is one of the records, of which those of the validation data come last. Of
    residuals the nearest tested record is drawn, and of disturbances the nearest fitted one.

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
    source = ResultFigures(found)
    tested = () if source.residuals is None else source.residuals.experiments
    disturbed = [one.name for one in source.disturbances] if "disturbances" in names else []
    numbers = {
        "disturbances": max(min(experiment, len(disturbed) - 1), 0),
        "residuals": max(experiment - len(experiments) + len(tested), 0),
    }
    recorded: dict[FigureName, Sequence[str]] = {
        "response": [one.name for one in experiments],
        "disturbances": disturbed,
        "residuals": tested,
    }
    drawn = []
    for name in names:
        number, listed = numbers.get(name, experiment), recorded.get(name, ())
        title = TITLES[name] if len(listed) < 2 else f"{TITLES[name]}: {listed[number]}"
        drawn.append((title, draw_run_figure(source, name, number)))
    return [(title, figure) for title, figure in drawn if has_points(figure)]


@dataclass(frozen=True, slots=True)
class FigureLook:
    """How figures of a run are drawn.

    Attributes
    ----------
    abscissa : {"generations", "evaluations"}
        Of the history.
    columns : int
        Small plots in a row; 1 on a narrow page.
    start, stop : float or None
        Time window of the response and of the disturbances, s.
    """

    abscissa: Abscissa = "generations"
    columns: int = 3
    start: float | None = None
    stop: float | None = None


class TestedResiduals(NamedTuple):
    """Correlation functions of residuals, and the names of the experiments that were tested."""

    correlations: Sequence[CorrelationFunction]
    experiments: Sequence[str]


class RunFigures(Protocol):
    """What the figures of a run are drawn from, each part read when a figure needs it.

    Until the run has a result it is None, and there are no `experiments`, `disturbances` and
    `residuals`.
    """

    @property
    def result(self) -> Result | None:
        """The result."""

    @property
    def search(self) -> SearchTraces:
        """The search."""

    @property
    def experiments(self) -> Sequence[ExperimentTraces]:
        """The records with outputs and bands."""

    @property
    def disturbances(self) -> Sequence[DisturbanceTraces]:
        """The estimated disturbances of each record that was fitted."""

    @property
    def residuals(self) -> TestedResiduals | None:
        """The residuals that were tested."""


_DEFAULT_LOOK = FigureLook()


def draw_run_figure(
    run: RunFigures, name: FigureName, experiment: int = 0, look: FigureLook = _DEFAULT_LOOK
) -> Figure:
    """Draw a figure of a run; it is empty as long as the run has no data for it.

    `experiment` is the number of the record, or of the tested record, from 0.
    """
    result = run.result
    correlation = None if result is None else result.correlation
    match name:
        case "response":
            return _draw_response(run.experiments, experiment, look)
        case "disturbances":
            return _draw_disturbances(run.disturbances, experiment, look)
        case "residuals":
            return _draw_residuals(run.residuals, experiment, min(look.columns, 2))
        case "correlation":
            return plotly.plot_correlation(correlation)
        case "posterior":
            posterior, estimates = (result.posterior, result.parameters) if result else (None, ())
            return plot_posterior(posterior, estimates, correlation, is_narrow=look.columns == 1)
        case _:
            return _draw_search(run, name, look)


def _draw_search(run: RunFigures, name: FigureName, look: FigureLook) -> Figure:
    search, result = run.search, run.result
    if name == "history":
        return plotly.plot_history(search, look.abscissa)
    if name == "convergence":
        return plotly.plot_convergence(search, look.columns)
    islands = () if result is None else result.islands
    return plotly.plot_waterfall(islands, search.unit, search.fitness_label)


def list_report_figures(
    run: RunFigures, most_experiments: int, *, names_each: bool
) -> list[tuple[str, Figure]]:
    """Draw the figures of a report, each with its title.

    A title names the record if there are several, or if it `names_each`.
    """
    tested = run.residuals
    recorded: dict[FigureName, Sequence[str]] = {
        "response": [experiment.name for experiment in run.experiments],
        "disturbances": [record.name for record in run.disturbances],
        "residuals": () if tested is None else tested.experiments,
    }
    each = [
        (
            f"{TITLES[name]}: {listed[number]}" if names_each or len(listed) > 1 else TITLES[name],
            draw_run_figure(run, name, number),
        )
        for name, listed in recorded.items()
        for number in range(min(len(listed), most_experiments))
    ]
    first: tuple[FigureName, ...] = ("history",)
    last: tuple[FigureName, ...] = ("convergence", "correlation", "posterior", "waterfall")
    before, after = (
        [(TITLES[name], draw_run_figure(run, name)) for name in names] for names in (first, last)
    )
    return [*before, *each, *after]


def _draw_response(
    experiments: Sequence[ExperimentTraces], number: int, look: FigureLook
) -> Figure:
    if not experiments:
        return empty_figure()
    figure = plot_response(experiments[number], look.start, look.stop)
    figure["layout"]["meta"]["experiments"] = [experiment.name for experiment in experiments]
    return figure


def _draw_disturbances(
    records: Sequence[DisturbanceTraces], number: int, look: FigureLook
) -> Figure:
    if not records:
        return empty_figure()
    figure = plot_disturbances(records[number], look.start, look.stop)
    figure["layout"]["meta"]["experiments"] = [record.name for record in records]
    return figure


def _draw_residuals(tested: TestedResiduals | None, number: int, columns: int) -> Figure:
    if tested is None:
        return empty_figure()
    traces = [
        to_correlation_trace(function)
        for function in tested.correlations
        if function.test.experiment == number and function.values.size
    ]
    return plot_residuals(traces, columns, tested.experiments)


@dataclass(frozen=True, eq=False)
class ResultFigures:
    """What the figures of a result in memory are drawn from; a `RunFigures`."""

    result: FullResult

    @cached_property
    def search(self) -> SearchTraces:
        """The search."""
        found, data = self.result, self.result.data
        scales = {} if data is None else {p.name: p.scale for p in data.model.parameters}
        return SearchTraces(
            unit=find_output_unit(found),
            fitness_label=label_fitness("squares" if data is None else data.loss),
            generations=found.generations,
            parameters=list_searched_parameters(found, scales),
            estimates={estimate.name: estimate for estimate in found.parameters},
            history=found.history,
        )

    @cached_property
    def experiments(self) -> Sequence[ExperimentTraces]:
        """The records with outputs and bands; none without the fitted data."""
        from sysid.results.bands import compute_record_bands  # it imports the compiler

        experiments = list_experiments(self.result)
        return add_bands(experiments, compute_record_bands(self.result)) if experiments else []

    @cached_property
    def disturbances(self) -> Sequence[DisturbanceTraces]:
        """The estimated disturbances; none without the fitted data."""
        from sysid.results.bands import compute_disturbances  # it imports the compiler

        return to_disturbance_traces(compute_disturbances(self.result))

    @cached_property
    def residuals(self) -> TestedResiduals | None:
        """The residuals that were tested; None without the fitted data."""
        data = self.result.data
        if data is None:
            return None
        names = [experiment.name for experiment in list_experiments(self.result)]
        tested = data.validation or data.records
        return TestedResiduals(data.correlations, names[len(names) - len(tested) :])


def list_searched_parameters(
    result: Result, scales: Mapping[str, ParameterScale]
) -> list[Parameter]:
    """List the free parameters of a result, in the order of the history's columns.

    A bound at zero or below has no logarithm, so its axis is linear.
    """
    return [
        Parameter(
            estimate.name,
            estimate.lower,
            estimate.upper,
            estimate.unit,
            scales.get(estimate.name, "linear") if estimate.lower > 0 else "linear",
        )
        for estimate in result.parameters
        if estimate.is_free
    ]


def label_fitness(loss: LossKind) -> str:
    """Label of the minimised fitness; with soft-l1 it is not J."""
    return "soft-l1 loss, as RMS" if loss == "soft-l1" else "RMS"


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
    channel = channel.acting
    held, before = channel.effective_hold == "zero", None
    if channel.history is not None:  # including the first sample, so that the lines meet
        pairs = zip(channel.history, (channel.times, channel.values), strict=True)
        times, values = (np.append(history, samples[0]) for history, samples in pairs)
        before = SignalTrace(channel.name, channel.unit, times, values, held)
    return SignalTrace(channel.name, channel.unit, channel.times, channel.values, held, before)


def to_disturbance_traces(
    records: Sequence[Sequence["Disturbance"]],
) -> list[DisturbanceTraces]:
    """Convert the estimated disturbances of each record to the data of their figure."""
    return [
        DisturbanceTraces(
            f"record {number}",
            tuple(
                (SignalTrace(describe_place(one), one.unit, one.times, one.values), one.band)
                for one in disturbances
            ),
        )
        for number, disturbances in enumerate(records, 1)
    ]


def describe_place(disturbance: "Disturbance") -> str:
    """Say what a disturbance is, and where it acts."""
    kind = "load at" if disturbance.kind == "load" else "state"
    return f"{kind} {disturbance.place}"


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
