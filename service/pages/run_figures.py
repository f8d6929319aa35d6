"""Load the data of a requested figure, and draw it."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from service.core.errors import NotFound
from service.datasets.rms_unit import find_rms_unit
from service.datasets.stored_recordings import load_recording
from service.figures.noise_figure import noise_group_keys, plot_noise_sweep
from service.figures.trend_figure import plot_trend
from service.jobs.stored_run import load_run
from service.pages.figure_data import (
    StoredRunFigures,
    read_plain_experiments,
)
from service.pages.trend_views import load_trend
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.job_rows import JobRepository
from service.runs.comparison import build_titles, load_compared_runs
from service.storage.objects import ObjectStore
from service.sweeps.summary import summarise_job
from sysid.figures import plotly, signal_figures
from sysid.figures.plotly import Abscissa, Figure
from sysid.figures.theme import Theme
from sysid.inspection.inspect import inspect_recording
from sysid.results.figures import FigureLook, FigureName, draw_run_figure, to_signal_trace
from sysid.trends.trend import OutlierRule


class FigureChoice(BaseModel):
    """Options of a figure in a request."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    theme: Theme = Field(default="light", description="light or dark colours")
    format: Literal["json", "csv"] = Field(
        default="json", description="Plotly JSON, or numbers as CSV"
    )
    abscissa: Abscissa = Field(default="generations", description="abscissa of the RMS history")
    columns: int = Field(default=3, ge=1, le=8, description="small plots per row")
    experiment: int = Field(default=0, ge=0, description="index of the record, from 0")
    start: float | None = Field(default=None, allow_inf_nan=False, description="start time, s")
    stop: float | None = Field(default=None, allow_inf_nan=False, description="stop time, s")


class TrendChoice(FigureChoice):
    """Options of the figure of a trend."""

    outliers: OutlierRule = Field(
        default="exclude", description="whether the laws leave outliers out or count them"
    )


class ComparisonChoice(FigureChoice):
    """Options of a figure of several runs."""

    run: list[str] = Field(min_length=2, max_length=50, description="the runs")


def load_run_figure(
    session: Session, store: ObjectStore, run_id: str, name: FigureName, choice: FigureChoice
) -> Figure:
    """Draw a figure of a run; it is empty as long as the run has no data for it.

    Raises
    ------
    NotFound
        If the run or the requested experiment does not exist.
    """
    run = StoredRunFigures(session, store, load_run(session, run_id))
    if name == "response" and run.experiments:
        _check_experiment(choice.experiment, len(run.experiments))
    elif name == "disturbances" and run.disturbances:
        _check_experiment(choice.experiment, len(run.disturbances))
    elif name == "residuals" and run.residuals is not None:
        _check_experiment(choice.experiment, len(run.residuals.experiments))
    look = FigureLook(choice.abscissa, choice.columns, choice.start, choice.stop)
    return draw_run_figure(run, name, choice.experiment, look)


MAX_OVERLAID_RUNS = 8


def load_comparison_figure(
    session: Session, store: ObjectStore, choice: ComparisonChoice
) -> Figure:
    """Draw the identified outputs of several runs, each over what it was fitted to.

    Raises
    ------
    InvalidRequest
        If the runs cannot be compared.
    NotFound
        If the requested experiment does not exist.
    """
    ordered = load_compared_runs(session, choice.run, same_data=False)
    titles = build_titles(ordered)
    read = {
        titles[stored.run.id]: read_plain_experiments(session, store, stored)
        for stored in ordered[:MAX_OVERLAID_RUNS]
    }
    experiments = max(read.values(), key=len)
    if not experiments:
        return plotly.empty_figure()
    _check_experiment(choice.experiment, len(experiments))
    compared = [
        (title, many[choice.experiment])
        for title, many in read.items()
        if len(many) > choice.experiment
    ]
    figure = signal_figures.plot_comparison(compared, choice.start, choice.stop)
    figure["layout"]["meta"]["experiments"] = [experiment.name for experiment in experiments]
    return figure


def load_noise_figure(session: Session, job_id: str, choice: FigureChoice) -> Figure:
    """Draw a job's errors against the noise; empty if σ is no axis or no run has ended."""
    job = JobRepository(session).get(job_id)
    keys = noise_group_keys(job.spec["sweep"]["axes"])
    if keys is None:
        return plotly.empty_figure()
    summary = summarise_job(session, job.id, keys)
    return plot_noise_sweep(summary, find_rms_unit(session, job.spec), min(choice.columns, 2))


def load_trend_figure(session: Session, job_id: str, choice: TrendChoice) -> Figure:
    """Draw estimates over the label of a batch; empty if the job requests no trend."""
    trend = load_trend(session, JobRepository(session).get(job_id), choice.outliers)
    if trend is None:
        return plotly.empty_figure()
    return plot_trend(trend, min(choice.columns, 2))


def _check_experiment(number: int, count: int) -> None:
    if number >= count:
        raise NotFound("experiment", str(number), f"; the last is {count - 1}")


def load_dataset_figure(
    session: Session, store: ObjectStore, dataset_id: str, choice: FigureChoice
) -> Figure:
    """Draw the signals of a dataset."""
    dataset = DatasetRepository(session).get(dataset_id)
    recording = load_recording(store, dataset.sha256)
    return signal_figures.plot_signals(
        [to_signal_trace(channel) for channel in recording.channels],
        choice.start,
        choice.stop,
        inspect_recording(recording),
    )
