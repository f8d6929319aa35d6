"""Render the page that simulates an identified model; its address contains the whole request."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any
from urllib.parse import urlencode

from pydantic import ValidationError
from sqlalchemy.orm import Session

from service.control import run_simulation
from service.control.control_schemas import RunSimulationIn, RunSimulationOut, StepMetricsOut
from service.control.loop_answer import suggest_controller
from service.core.bodies.validation import explain_errors
from service.core.errors import (
    FieldError,
    InvalidRequest,
    ServiceError,
    Unavailable,
    to_field_errors,
)
from service.core.process.concurrency import ReaderPlaces
from service.figures.csv import to_csv
from service.figures.embed import strip_template, templates_json, to_script_json
from service.figures.simulation_figure import apply_units, begin_near_step, plot_simulation
from service.jobs.stored_run import StoredRun, load_run
from service.pages.forms.simulation_form import (
    CHOICES,
    SIMULATION_KINDS,
    TUNINGS,
    SimulationKind,
    SimulationQuery,
    field_label,
    has_request,
    parse_query,
    read_kind,
    to_form_fault,
)
from service.pages.render import render_template
from service.repositories.dataset_rows import DatasetRepository
from service.runs import validation_run
from service.runs.run_schemas import FreeRunIn
from service.runs.validation_run import FreeRun
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from service.storage.storage_errors import StorageError
from service.storage.tables import Dataset
from sysid.core.errors import SysidError
from sysid.core.text import bracket_unit
from sysid.core.units import multiply_units
from sysid.data.records import Record
from sysid.figures.data import ExperimentTraces, OutputTraces, SignalTrace
from sysid.figures.plotly import Figure
from sysid.figures.signal_figures import plot_response
from sysid.figures.theme import MAX_POINTS
from sysid.models.model import Model

MAX_LISTED_DATASETS = 200
MAX_LISTED_RECORDS = 50
MAX_DEFAULT_SAMPLES = 5000
IMPLIED_VALUES = {"amplitude": "1", "offset": "0", "time": "0"}
"""Values of fields that an address omits; an empty form suggests other values."""


@dataclass(frozen=True, slots=True)
class _FormContext:
    """Data for the form: run, model, datasets, units and defaults."""

    run: str
    title: str
    job: str
    job_name: str
    model: Model
    datasets: Sequence[Dataset]
    has_estimates: bool
    units: Mapping[str, str]
    defaults: Mapping[str, str]
    suggested_controller: Mapping[str, str]

    @property
    def input_choices(self) -> list[tuple[str, str]]:
        """Choices of the controlled input."""
        return [(signal.name, signal.name) for signal in self.model.inputs]

    @property
    def output_choices(self) -> list[tuple[str, str]]:
        """Choices of the controlled output."""
        return [(output.name, output.name) for output in self.model.outputs]

    @property
    def gain_unit(self) -> str:
        """Unit of the gain, if the model has one input and one output."""
        if len(self.model.inputs) != 1 or len(self.model.outputs) != 1:
            return ""
        above, below = (
            self.units[signals[0].name] for signals in (self.model.inputs, self.model.outputs)
        )
        if "1" in (above, below):
            return above if below == "1" else f"1/{below}"
        return "" if above == below else f"{above}/({below})"

    @property
    def recording_choices(self) -> list[tuple[str, str]]:
        """Choices of a stored recording."""
        return [("", "choose one…"), *((dataset.id, dataset.name) for dataset in self.datasets)]


@dataclass(frozen=True, slots=True)
class SimulationAnswer:
    """Answer to a request: a page, or the numbers of its figure as CSV."""

    text: str
    is_csv: bool
    status: int = 200


def simulate_page(
    database: Database,
    store: ObjectStore,
    readers: ReaderPlaces,
    run_id: str,
    query: Mapping[str, str],
    base_url: str,
) -> SimulationAnswer:
    """Render the form, and the simulation if the query requests one.

    Raises
    ------
    NotFound
        If there is no such run.
    """
    with database.read_session() as session:
        form = _load_form_context(session, run_id, query)
    kind: SimulationKind = "loop"
    context: dict[str, Any] = {}
    faults: list[FieldError] = []
    status = 200
    try:
        kind = read_kind(query)
        if has_request(query):
            wanted = parse_query(form.model, query)
            figure, context = _simulate_query(database, store, readers, form, wanted)
            if query.get("format") == "csv":
                return SimulationAnswer(to_csv(figure), is_csv=True)
            if wanted.kind == "loop":
                begin_near_step(figure, wanted.body["control"]["reference"]["time"])
            context |= _figure_context(figure) | _request_context(form.run, wanted, base_url)
    except (ServiceError, StorageError, SysidError) as error:
        faults = [to_form_fault(fault) for fault in _to_field_errors(error)]
        status = error.status if isinstance(error, Unavailable) else 422
    page = render_template(
        "simulate.html",
        form=form,
        kind=kind,
        kinds=SIMULATION_KINDS,
        tunings=TUNINGS,
        choices=CHOICES,
        values={
            **form.defaults,
            **(_shift_step_time(form.defaults) if kind == "loop" else {}),
            **(IMPLIED_VALUES if has_request(query) else form.suggested_controller),
            **query,
            **_controller_values(context.get("result")),
        },
        faults={f.pointer[1:]: f.detail for f in faults},
        lines=[_format_fault(fault) for fault in faults],
        query=_encode_query(query),
        times=multiply_units,
        bracket=bracket_unit,
        **{"result": None, "free": None, "figure": None, **context},
    )
    return SimulationAnswer(page, is_csv=False, status=status)


def _load_form_context(session: Session, run_id: str, query: Mapping[str, str]) -> _FormContext:
    stored = load_run(session, run_id)
    run, job, fitted_to = stored.run, stored.job, stored.body["datasets"][0]
    datasets = list(DatasetRepository(session).list_page(limit=MAX_LISTED_DATASETS).items)
    for wanted in (query.get("dataset"), fitted_to):
        if wanted and wanted not in [dataset.id for dataset in datasets]:
            datasets += _find_dataset(session, wanted)
    fitted = next((dataset for dataset in datasets if dataset.id == fitted_to), None)
    return _FormContext(
        run=run.id,
        title=f"run {run.number + 1}",
        job=job.id,
        job_name=job.name,
        model=stored.model,
        datasets=datasets,
        has_estimates=bool(stored.estimates),
        units=_signal_units(stored, fitted),
        defaults=_default_values(stored, fitted) | _default_step(stored),
        suggested_controller=_suggest_controller(stored),
    )


def _suggest_controller(stored: StoredRun) -> dict[str, str]:
    """Suggest the PI controller that SIMC tunes for the model, if it does."""
    model, values = stored.model, {e.name: e.value for e in stored.estimates}
    if not values or not model.inputs:
        return {}
    tuned = suggest_controller(model, values, model.inputs[0].name, model.outputs[0].name)
    if tuned is None:
        return {}
    return {"tuning": "simc PI", **{name: f"{value:.6g}" for name, value in tuned.items()}}


def _find_dataset(session: Session, dataset: str) -> list[Dataset]:
    try:
        return [DatasetRepository(session).get(dataset)]
    except StorageError:  # deleted, or never stored: the form reports it at its field
        return []


def _signal_units(stored: StoredRun, fitted: Dataset | None) -> dict[str, str]:
    """Unit of every signal: the model's, or the recording's if the model declares none."""
    recorded = {
        channel["name"]: str(channel["unit"]) for channel in (fitted.channels if fitted else [])
    }
    model, by_signal = stored.model, stored.channels.by_signal
    declared = {channel.name: channel.unit for channel in model.inputs} | {
        o.name: o.unit for o in model.outputs
    }
    return {
        name: recorded.get(by_signal[name], unit) if unit == "1" else unit
        for name, unit in declared.items()
    }


def _default_values(stored: StoredRun, fitted: Dataset | None) -> dict[str, str]:
    model = stored.model
    period = (fitted.sample_time or _mean_period(fitted)) if fitted else None
    period = period or model.solver.step or 0.01
    duration = min(fitted.duration if fitted else 10.0, MAX_DEFAULT_SAMPLES * period)
    return {
        "input": model.inputs[0].name if model.inputs else "",
        "output": model.outputs[0].name,
        "gain": "1",
        "amplitude": "1",
        "time": "0",
        "offset": "0",
        "skip": "0",
        "duration": f"{duration:.6g}",
        "sample_time": f"{period:.6g}",
        **{f"channel.{name}": channel for name, channel in stored.channels.by_signal.items()},
    }


def _mean_period(irregular: Dataset) -> float | None:
    """Mean sampling period (s) of an irregular recording."""
    if irregular.n_samples < 2 or not irregular.duration > 0:
        return None
    return float(f"{irregular.duration / (irregular.n_samples - 1):.2g}")


def _default_step(stored: StoredRun) -> dict[str, str]:
    """Suggest a step of the reference inside the measured range: half the first output's span.

    A step from 0 to 1 would lie outside this range for most plants, such as outputs in Pa.
    """
    agreement = () if stored.result is None else stored.result.agreement.estimation
    of_output = (entry for entry in agreement if entry.output == stored.model.outputs[0].name)
    spans = [entry.span for entry in of_output if all(map(isfinite, entry.span))]
    if not spans:
        return {}
    low, high = min(span[0] for span in spans), max(span[1] for span in spans)
    return {
        "offset": _round_text(low + (high - low) / 4),
        "amplitude": _round_text((high - low) / 2),
    }


def _shift_step_time(defaults: Mapping[str, str]) -> dict[str, str]:
    """Shift the step by one record: the model first settles at the reference before the step."""
    if defaults["offset"] == "0":
        return {}
    duration = float(defaults["duration"])
    return {"time": f"{duration:.6g}", "duration": f"{2 * duration:.6g}"}


def _round_text(value: float) -> str:
    """Round to two significant digits; avoid a power of ten."""
    return f"{float(f'{value:.2g}'):.10g}"


def _simulate_query(
    database: Database,
    store: ObjectStore,
    readers: ReaderPlaces,
    form: _FormContext,
    wanted: SimulationQuery,
) -> tuple[Figure, dict[str, Any]]:
    if wanted.kind == "recording":
        body = _validate_body(FreeRunIn, wanted.body)
        free = validation_run.simulate_free_run(database, store, form.run, body)
        name = next((d.name for d in form.datasets if d.id == free.dataset), free.dataset)
        return plot_response(_to_experiment_traces(free)), {
            "free": free,
            "dataset_name": name,
            "records": MAX_LISTED_RECORDS,
        }
    body = _validate_body(RunSimulationIn, wanted.body)
    simulation = run_simulation.simulate_run(database, store, readers, form.run, body, MAX_POINTS)
    with_units = apply_units(simulation, form.units)
    since = wanted.body["control"]["reference"]["time"] if wanted.kind == "loop" else None
    entered = form.units.get(wanted.body["control"]["input"], "1") if since is not None else "1"
    return plot_simulation(with_units, since), {
        "result": with_units,
        "verdict": _step_verdict(with_units),
        "command_unit": entered,
    }


def _validate_body(kind: type[Any], body: Mapping[str, Any]) -> Any:
    try:
        return kind.model_validate(body)
    except ValidationError as error:
        raise InvalidRequest(explain_errors(error.errors(), body, kind)) from None


def _controller_values(simulation: RunSimulationOut | None) -> dict[str, str]:
    """Return a rule's settings as values of the form, as a start for tuning by hand."""
    if simulation is None or simulation.tuning is None or simulation.controller is None:
        return {}
    used = simulation.controller
    chosen = {
        "gain": used.gain,
        "integral_time": used.integral_time,
        "derivative_time": used.derivative_time or None,
    }
    return {name: "" if value is None else f"{value:.6g}" for name, value in chosen.items()}


def _step_verdict(simulation: RunSimulationOut) -> tuple[str, str]:
    """Judge a step response: style class and text."""
    metrics: StepMetricsOut | None = simulation.metrics
    if metrics is None:
        return "", ""
    if metrics.runs_away:
        return "failed", "diverges"
    if metrics.swing is not None:
        return "failed", "keeps oscillating"
    return ("passed", "settles") if metrics.is_settled else ("apart", "does not settle")


def _to_experiment_traces(free: FreeRun) -> ExperimentTraces:
    """Return the traces of the first record; a table shows the agreement of all records."""
    record, simulated = free.records[0], free.simulated[0]
    outputs = tuple(
        OutputTraces(SignalTrace(output.name, output.unit, output.times, output.values), values)
        for output, values in zip(record.outputs, simulated, strict=True)
    )
    return ExperimentTraces("record 1", outputs, _to_input_traces(record))


def _to_input_traces(record: Record) -> tuple[SignalTrace, ...]:
    return tuple(
        SignalTrace(
            signal.name,
            signal.unit,
            signal.times,
            signal.values,
            signal.effective_hold == "zero",
        )
        for signal in (channel.acting for channel in record.inputs)
    )


def _figure_context(figure: Figure) -> dict[str, Any]:
    return {
        "figure": to_script_json(strip_template(figure)),
        "height": figure["layout"]["height"],
        "templates": templates_json(),
    }


def _request_context(run: str, wanted: SimulationQuery, base_url: str) -> dict[str, str]:
    """Build the same request as a curl command."""
    verb = "validate" if wanted.kind == "recording" else "simulate"
    body = json.dumps(wanted.body, indent=2, ensure_ascii=False)
    url = f"{base_url.rstrip('/')}/v1/runs/{run}:{verb}"
    return {
        "curl": f"curl -X POST {url} -H 'Content-Type: application/json' "
        f"--data-binary @- <<'LAGID'\n{body}\nLAGID"
    }


def _to_field_errors(error: ServiceError | StorageError | SysidError) -> Iterator[FieldError]:
    if isinstance(error, SysidError):
        yield from to_field_errors(error)
    elif isinstance(error, ServiceError) and error.errors:
        yield from error.errors
    else:
        yield FieldError("", str(error))


def _format_fault(fault: FieldError) -> str:
    field = fault.pointer.removeprefix("?")
    column = f" (column {fault.column})" if fault.column else ""
    return f"{field_label(field)}: {fault.detail}{column}" if field else f"{fault.detail}{column}"


def _encode_query(query: Mapping[str, str]) -> str:
    return urlencode({name: value for name, value in query.items() if name != "format"})
