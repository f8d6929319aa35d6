"""`lagid identify`: one identification in this process, without a server."""

import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from math import isfinite
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from service.cli.common import (
    DATA_HELP,
    ESTIMATE_HEADINGS,
    MODEL_SUFFIXES,
    OUTPUT_PANEL,
    STANDARD_INPUT,
    AsJson,
    Columns,
    Exclude,
    FieldOrigins,
    Force,
    McapClock,
    Missing,
    ModelName,
    Quiet,
    SampleTime,
    Segments,
    apply_setting,
    check_file,
    err,
    fail,
    fail_usage,
    file_origins,
    list_estimate_cells,
    name_file,
    out,
    parse_channels,
    print_json,
    print_line,
    print_table,
    protect_file,
    read_file,
    split_setting_path,
    upload_origins,
    write_file,
)
from service.core.errors import FieldError, to_field_errors
from service.core.extras import check_extra
from sysid.core.errors import (
    InvalidRecord,
    InvalidSettings,
    SysidError,
    UnknownModel,
    UnreadableFile,
    split_pointer,
)
from sysid.core.settings import NOISE_MODELS
from sysid.core.text import plain_unit

if TYPE_CHECKING:
    from service.formats.read_options import ReadOptions
    from service.jobs.job_schemas import JobIn
    from sysid.data.records import Record, Recording
    from sysid.identification.identify_arguments import ReadRecords
    from sysid.models.model import Model
    from sysid.results.identification import Identification
    from sysid.uncertainty.estimates import Posterior


# Fields of a job body that need a server, and what to use instead.
SERVER_SETTINGS = {
    "sweep": "a sweep needs a server: lagid submit job.yaml",
    "trend": "a trend needs a server: lagid reidentify",
    "warm_start": "a warm start needs a server: lagid submit job.yaml",
    "datasets": "name the recording as DATA",
    "model": "use --model",
    "validation.datasets": "use --validation FILE",
}
FIELD_ORIGINS = FieldOrigins(
    {
        "/model": "--model …",
        "/datasets": "DATA",
        "/channels": "--channels {}",
        "/loss/noise_model": "--noise-model",
    }
)


ResultFile = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="FILE",
        help="Write the result as JSON.",
        rich_help_panel=OUTPUT_PANEL,
    ),
]


def identify(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="DATA…",
            help=f"{DATA_HELP} Files of several loggers are joined on one clock.",
        ),
    ],
    model: ModelName,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="PATH=VALUE",
            help="Change a bound or a setting: parameters.L.upper=2, parameters.K.fixed=1, seed=3. "
            "May be repeated.",
        ),
    ] = None,
    channels: Annotated[
        str | None,
        typer.Option(
            metavar="SIGNAL=CHANNEL,…",
            help="Channel of each signal of the model: u=P1,y=P2. By default of the same name, "
            "else by usual names (input, output), else in their order, inputs first.",
        ),
    ] = None,
    validation: Annotated[
        Path | None,
        typer.Option(
            help="Recording for validation. To validate on the last part of DATA: "
            "--set validation.fraction=0.3."
        ),
    ] = None,
    noise_model: Annotated[
        str | None,
        typer.Option(
            metavar=f"[{'|'.join(NOISE_MODELS)}]",
            help="white: least squares. ar1: generalised least squares for first-order noise. "
            "auto (default): ar1 if nothing but noise explains coloured residuals.",
        ),
    ] = None,
    posterior: Annotated[
        bool,
        typer.Option("--posterior", help="Sample the posterior distribution; takes seconds."),
    ] = False,
    segments: Segments = None,
    sample_time: SampleTime = None,
    columns: Columns = None,
    missing: Missing = None,
    exclude: Exclude = None,
    clock: McapClock = None,
    report: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write a report as one HTML file, with tables and figures.",
            rich_help_panel=OUTPUT_PANEL,
        ),
    ] = None,
    force: Force = False,
    output: ResultFile = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Identify a model's parameters and time lags from a recording, without a server.

    Prints each estimate with its standard error, its unit and a status that says if the data
    determine it.
    """
    changes = list(changes or ())
    if noise_model is not None:
        changes.append(f"loss.noise_model={noise_model}")
    if posterior:
        changes.append("posterior=true")
    if report is not None:
        _check_report(report, force)
    protect_file(output, force)
    _refuse_file_after_json(files)
    data = _name_files(files)
    unchecked = _build_body(data, model, changes, parse_channels(channels))
    _refuse_same_file(files[0], validation)
    reading = build_file_options(
        files[0],
        sample_time=sample_time,
        segments=segments,
        columns=columns,
        missing=missing,
        exclude=exclude,
        clock=clock,
    )
    recording = read_input_files(files, reading)
    body, loaded = check_body(unchecked, _count_most_experiments(recording))
    with _report_core_faults():
        read = _extract_records(recording, data, loaded, body)
        validation_records: Sequence[Record] = ()
        if validation is not None:
            validation_records = _extract_records(
                read_input_file(validation, reading), validation, loaded, body
            ).records
    from sysid.core.jit import announce_compilation, read_clock

    printed = [*read.notes, *_print_events((*read.records, *validation_records))]
    begun = read_clock()
    with _report_core_faults(), announce_compilation(err.print):
        result = _run_identification(
            loaded, read.records, validation_records, body, printed, quiet=as_json
        )
    seconds = read_clock() - begun
    from sysid.judgement.conclusions import add_reading_notes

    result = add_reading_notes(result, read.notes)
    print_result(result, seconds, output, as_json=as_json, printed=printed)
    if report is not None:
        _write_report(report, data, loaded, result, seconds, body)


def _check_report(path: Path, force: bool) -> None:
    """End the command before the search if no report could be written after it."""
    check_extra("server", "--report", ("jinja2", "plotly"))
    protect_file(path, force, "--report")


def _write_report(
    path: Path,
    data: Path,
    model: "Model",
    result: "Identification",
    seconds: float,
    body: "JobIn",
) -> None:
    """Write the report with the figures of a job's report."""
    from service.pages.reports.identification_report import render_identification_report

    title = f"{model.title or model.name}: {data.name}"
    facts = {"Model": model.name, "Recording": data.name}
    request = json.dumps(body.to_normal_form(), indent=2, ensure_ascii=False)
    write_file(path, render_identification_report(result, title, facts, seconds, request))
    err.print(f"report written to {path}", markup=False, soft_wrap=True)


def _build_body(
    data: Path, model: str, changes: list[str], channels: dict[str, str]
) -> dict[str, Any]:
    """Build the job body from the options, unchecked."""
    body: dict[str, Any] = {"model": model, "datasets": [str(data)], "channels": channels}
    for change in changes:
        _refuse_server_settings(change, split_setting_path(change))
        apply_setting(body, change)
    return body


def check_body(body: dict[str, Any], pieces: int) -> "tuple[JobIn, Model]":
    """Validate the body and load its model; end the command with the faults of both.

    If the body has type errors, only these are reported.

    Parameters
    ----------
    pieces : int
        Number of records in the recording. Each may have its own initial states.
    """
    from pydantic import ValidationError

    from service.core.bodies.validation import explain_errors
    from service.jobs.job_schemas import JobIn
    from sysid.models.catalogue.load import resolve_model

    try:
        job = JobIn.model_validate(body)
    except ValidationError as error:
        faults = explain_errors(error.errors(), body, JobIn)
        fail_usage(FIELD_ORIGINS.describe_faults(_suggest_parameters(faults, body["model"])))
    if job.validation is not None and job.validation.datasets is not None:
        fail_usage(f"--set validation: {SERVER_SETTINGS['validation.datasets']}")
    try:
        model = resolve_model(body["model"])
    except SysidError as error:
        _refuse_model(body["model"], error)
    from service.jobs.record_checks import find_setting_faults
    from sysid.models.model import build_initial_parameters
    from sysid.models.starts import replace_starts

    try:
        started = replace_starts(model, job.initial)
    except SysidError as error:
        fail_usage(FIELD_ORIGINS.describe_faults(to_field_errors(error)))
    parameters = (*model.parameters, *build_initial_parameters(started, pieces))
    wrong = find_setting_faults(job.to_normal_form(), model, parameters)
    if wrong:
        fail_usage(FIELD_ORIGINS.describe_faults(wrong))
    return job, model


def _suggest_parameters(faults: Iterable[FieldError], name: str) -> Iterator[FieldError]:
    """Suggest ``parameters.L`` where a setting begins with the name of a parameter."""
    from sysid.models.catalogue.load import resolve_model

    try:
        names = [parameter.name for parameter in resolve_model(name).parameters]
    except SysidError:  # a fault of its own, which is reported once the settings are right
        names = []
    for fault in faults:
        parts = split_pointer(fault.pointer)
        if parts and parts[0] in names:
            yield replace(
                fault,
                detail=f"did you mean parameters.{parts[0]}, as in parameters.{parts[0]}.upper=2?",
            )
        else:
            yield fault


def _refuse_model(name: str, error: SysidError) -> NoReturn:
    """End the command with the faults of a model, at its option or in its file."""
    path = Path(name)
    if isinstance(error, UnknownModel) or not (path.is_file() and name.endswith(MODEL_SUFFIXES)):
        faults = to_field_errors(error)
        fail_usage(FIELD_ORIGINS.describe_faults(replace(f, pointer="/model") for f in faults))
    fail(file_origins(path).describe_faults(to_field_errors(error)))


@contextmanager
def _report_core_faults() -> Iterator[None]:
    """End the command with the core's errors, reported where the user typed."""
    try:
        yield
    except SysidError as error:
        is_argument = isinstance(error, InvalidSettings)
        fail(FIELD_ORIGINS.describe_faults(to_field_errors(error)), 2 if is_argument else 1)


def _refuse_server_settings(change: str, parts: list[str]) -> None:
    for setting, instead in SERVER_SETTINGS.items():
        if ".".join([*parts, ""]).startswith(f"{setting}."):
            fail_usage(f"--set {change}: {instead}")


def _refuse_same_file(data: Path, validation: Path | None) -> None:
    if validation is None or not (data.is_file() and validation.is_file()):
        return
    if read_file(data) == read_file(validation):
        fail_usage(
            f"--validation {validation}: this is the estimation recording. Name another, or use "
            "--set validation.fraction=0.3"
        )


def _refuse_file_after_json(files: Sequence[Path]) -> None:
    """End the command if the word after ``--json`` is meant as a file to write, not to read."""
    words = sys.argv[sys.argv.index("--json") + 1 :] if "--json" in sys.argv else []
    if len(files) > 1 and words and Path(words[0]).suffix == ".json" and Path(words[0]) in files:
        fail_usage(
            f"--json takes no file, it prints on standard output. To write one: --output {words[0]}"
        )


def build_file_options(path: Path, **given: Any) -> "ReadOptions":
    """Build the options of reading a file; end the command if one cannot be."""
    from service.formats.read_options import build_options

    with _report_unreadable(path):
        return build_options(**given)
    raise AssertionError  # the command has ended


def _name_files(files: Sequence[Path]) -> Path:
    """Name the files of a recording in one: ``supply + room``."""
    if len(files) == 1:
        return Path(name_file(files[0]))
    return Path(" + ".join(Path(name_file(file)).stem for file in files))


@contextmanager
def _report_unreadable(path: Path) -> Iterator[None]:
    """End the command if a file or an option of reading it cannot be used."""
    try:
        yield
    except UnreadableFile as error:
        place = Path(error.name) if error.name else path
        fail(upload_origins(place).describe_faults(to_field_errors(error)))


def read_input_file(path: Path, options: "ReadOptions") -> "Recording":
    """Read a recording from a file and print notes about it on stderr."""
    return read_input_files([path], options)


def read_input_files(paths: Sequence[Path], options: "ReadOptions") -> "Recording":
    """Read files, join them on one clock, and print notes on stderr."""
    from service.formats.recordings import read_with_notes
    from sysid.models.unit_checks import list_unknown_unit_warnings

    for path in paths:
        check_file(path)
    with _report_unreadable(_name_files(paths)):
        sources = [read_file(path) if path == STANDARD_INPUT else path for path in paths]
        recording, notes = read_with_notes(sources, options)
    for note in (*notes, *list_unknown_unit_warnings(recording.channels)):
        err.print(f"note: {note}", markup=False)
    return recording


def print_result(
    result: "Identification",
    seconds: float,
    output: Path | None,
    *,
    as_json: bool,
    printed: Sequence[str] = (),
) -> None:
    """Print the estimates, as tables or as JSON; `output` is a file of the JSON.

    Warnings that are `printed` already are in the JSON only.
    """
    from service.jobs.stored_results import write_result_document
    from sysid.results.findings import list_untold_reasons
    from sysid.results.result import find_output_unit
    from sysid.results.summary import list_evidence

    document = write_result_document(result, seconds)
    if output is not None:
        write_file(output, json.dumps(document, indent=2))
    if as_json:
        print_json(document)
        return
    print_line(f"verdict: {result.verdict.text}")
    print_table(
        ESTIMATE_HEADINGS,
        map(list_estimate_cells, document["parameters"]),
        empty="no parameters",
    )
    unit = plain_unit(find_output_unit(result))
    out.print(
        f"RMS {result.rms:.6g}{unit}, fit {_format_fit(result.fit_percent.estimation)}",
        markup=False,
        end="",
    )
    if result.rms_validation is not None and result.fit_percent.validation is not None:
        out.print(
            f"; validation RMS {result.rms_validation:.6g}{unit}, "
            f"fit {_format_fit(result.fit_percent.validation, 'it hardly moves')}",
            markup=False,
            end="",
        )
    out.print(f"; {result.evaluations} simulations in {seconds:.2f} s", markup=False)
    if result.data_bounds:
        out.print(f"bounds from the data: {_format_bounds(result)}", markup=False, soft_wrap=True)
    if any(known_before := result.known_before.estimation):
        out.print(
            f"inputs known before the record: {_format_history_span(known_before)}",
            markup=False,
        )
    for line in list_evidence(result):
        print_line(line)
    _print_posterior(result.posterior)
    _print_notes(warning for warning in result.warnings if warning not in printed)
    _print_notes(list_untold_reasons(result.parameters, result.findings))


def _count_most_experiments(recording: "Recording") -> int:
    """Count the experiments of a recording if all channels were inputs."""
    from sysid.data.outages import cut_segments, find_cuts

    return sum(max(len(find_cuts(one, one.names)), 1) for one in cut_segments(recording))


def _print_events(records: "Sequence[Record]") -> list[str]:
    """Print what happened to the recordings, and return it."""
    events = list(dict.fromkeys(one.sentences for record in records for one in record.findings))
    _print_notes(events)
    return events


def _print_notes(warnings: Iterable[str]) -> None:
    for warning in warnings:
        err.print(f"note: {FIELD_ORIGINS.rewrite_note(warning)}", markup=False)


def _print_posterior(posterior: "Posterior | None") -> None:
    if posterior is None or not posterior.parameters:
        return
    print_table(
        ("posterior", ">median", ">95 % interval", "unit", ">effective samples"),
        (
            (
                parameter.name,
                f"{parameter.median:.6g}",
                " … ".join(f"{end:.6g}" for end in parameter.interval95),
                parameter.unit,
                f"{parameter.effective_samples:.0f}",
            )
            for parameter in posterior.parameters
        ),
        empty="no parameters",
    )


def _format_bounds(result: "Identification") -> str:
    return ", ".join(
        f"{estimate.name} {estimate.lower:.3g} to {estimate.upper:.3g}"
        for estimate in result.parameters
        if estimate.name in result.data_bounds
    )


def _format_history_span(durations: Sequence[float]) -> str:
    least, most = min(durations), max(durations)
    return f"{least:.4g} s" if least == most else f"{least:.4g} to {most:.4g} s"


def _format_fit(fit: float, why: str = "the output is constant") -> str:
    return f"{fit:.2f} %" if isfinite(fit) else f"none ({why})"


def _run_identification(
    model: "Model",
    records: "Sequence[Record]",
    validation_records: "Sequence[Record]",
    body: "JobIn",
    printed: list[str],
    *,
    quiet: bool,
) -> "Identification":
    """Run the search under a bar; what is told before it is printed, and added to `printed`."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from service.jobs.to_core import read_run_settings
    from sysid.identification.identify import identify_records

    algorithm, fit, options = read_run_settings(body.to_normal_form(), in_sweep=False)
    columns = (
        BarColumn(bar_width=40),
        TextColumn("{task.percentage:>3.0f} %"),
        TextColumn("RMS {task.fields[rms]}"),
        TimeElapsedColumn(),
    )
    console = Console(stderr=True, highlight=False)
    # In a file a finished bar is an empty line.
    quiet = quiet or err.quiet or not console.is_terminal
    with Progress(*columns, console=console, disable=quiet, transient=True) as progress:
        bar = progress.add_task("", total=algorithm.generations, rms="–")

        def show(state: Any) -> None:
            progress.update(bar, completed=state.generation, rms=f"{state.rms:.6g}")

        def tell(notes: Sequence[str]) -> None:
            _print_notes(notes)
            printed.extend(notes)

        return identify_records(
            model,
            records,
            algorithm,
            fit,
            options,
            validation=validation_records or None,
            progress=show,
            tell=tell,
        )


def _write_channels_option(channels: Mapping[str, str]) -> str:
    """Write the option that gives the channel of each signal, as a shell reads it."""
    pairs = ",".join(f"{signal}={channel}" for signal, channel in channels.items())
    return f"--channels {pairs if '…' in pairs else quote(pairs)}"


def _extract_records(
    recording: "Recording", path: Path, model: "Model", body: "JobIn"
) -> "ReadRecords":
    """Return the records of a recording, with a note about channels that were guessed.

    The note is printed at once, because the search may refuse what was guessed.
    """
    from service.datasets.signal_channels import map_channels
    from sysid.identification.identify_arguments import ReadRecords, describe_assignment
    from sysid.models.channel_assignment import assign_recording

    try:
        assigned = assign_recording(model, recording, body.channels, _write_channels_option)
    except InvalidRecord as error:
        fail_usage(f"{path}: {error}")
    except InvalidSettings as error:
        fail_usage(FIELD_ORIGINS.describe_faults(to_field_errors(error)))
    channels = map_channels(model, assigned.by_signal, body.hold)
    records = channels.cut_records(recording, path.stem)
    note = describe_assignment(assigned, records)
    if note:
        err.print(f"note: {note}", markup=False)
    return ReadRecords(records, (note,) if note else (), assigned.by_signal)
