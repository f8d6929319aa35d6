"""`lagid datasets` and `lagid dataset …`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.common import (
    AsJson,
    FieldOrigins,
    Key,
    SampleTime,
    Segments,
    Url,
    connect_client,
    fail,
    parse_number,
    parse_pairs,
    print_json,
    print_line,
    print_listing,
    read_document,
    read_object,
    report_faults,
)
from service.client.calls import DEFAULT_URL
from sysid.core.text import append_unit

app = typer.Typer(help="Add, simulate and derive recordings.", no_args_is_help=True)

UPLOAD_OPTIONS = {"?name": "--name", "?segments": "--segments", "?sample_time": "--sample-time"}
DOCUMENT_HELP = "YAML or JSON file with the body of the request."


def list_datasets(url: Url = DEFAULT_URL, key: Key = None, as_json: AsJson = False) -> None:
    """List the recordings of the server."""
    with connect_client(url, key) as client:
        datasets = client.datasets()
    print_listing(
        datasets,
        as_json,
        ("id", "name", "kind", ">samples", ">duration [s]", "channels"),
        lambda dataset: (
            dataset["id"],
            dataset["name"],
            dataset["kind"],
            dataset["samples"],
            dataset["duration"],
            _format_channels(dataset),
        ),
        empty="no datasets; add one: lagid dataset add recording.csv",
    )


@app.command("add")
def add_dataset(
    file: Annotated[Path, typer.Argument(help="CSV or MCAP file.")],
    name: Annotated[str | None, typer.Option(help="Name; by default that of the file.")] = None,
    segments: Segments = None,
    sample_time: SampleTime = None,
    url: Url = DEFAULT_URL,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Store a recording."""
    if not file.is_file():
        fail(f"there is no file {file}")
    with (
        connect_client(url, key) as client,
        report_faults(FieldOrigins(UPLOAD_OPTIONS, rest=str(file))),
    ):
        stored = client.add_dataset(file, name, segments=segments, sample_time=sample_time)
    _print_dataset(stored, as_json)


@app.command("simulate")
def simulate_dataset(
    file: Annotated[Path | None, typer.Argument(help=DOCUMENT_HELP)] = None,
    plant: Annotated[
        str | None, typer.Option(help="Reference plant instead of a model: actuator or tube.")
    ] = None,
    sets: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A parameter, such as length_m=30."),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the dataset.")] = None,
    url: Url = DEFAULT_URL,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Simulate a recording from a model or a reference plant, parameters, inputs and noise.

    Inputs that jump (step, binary) are stored as held between samples. Waves and expressions are
    stored as linearly interpolated. A channel of a dataset keeps its own hold.
    """
    if file is None and plant is None:
        fail("need a file with the request, or --plant actuator or --plant tube")
    body = {} if file is None else read_object(file)
    if plant is not None:
        body["plant"] = plant
    if name is not None:
        body["name"] = name
    if sets:
        values = {
            name: parse_number(f"--set {name}={value}", value)
            for name, value in parse_pairs("--set", sets).items()
        }
        body["parameters"] = {**(body.get("parameters") or {}), **values}
    with connect_client(url, key) as client, report_faults(_field_origins(file, sets)):
        stored = client.simulate_dataset(body)
    _print_dataset(stored, as_json)


@app.command("derive")
def derive_dataset(
    dataset: Annotated[str, typer.Argument(help="Id or name of the parent.")],
    file: Annotated[Path, typer.Argument(help="YAML or JSON file with the list of steps.")],
    name: Annotated[str | None, typer.Option(help="Name of the new dataset.")] = None,
    url: Url = DEFAULT_URL,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Derive a recording from another: add noise, resample, trim, select, pool etc."""
    steps = read_document(file)
    if isinstance(steps, dict):
        steps = steps.get("steps")
    if not isinstance(steps, list):
        fail(f"{file} has no list of steps, such as - detrend: {{}}")
    with (
        connect_client(url, key) as client,
        report_faults(FieldOrigins({"/name": "--name"}, rest=f"{file} …")),
    ):
        stored = client.derive(dataset, steps, name)
    _print_dataset(stored, as_json)


def _field_origins(file: Path | None, sets: list[str] | None) -> FieldOrigins:
    """Map the fields of a simulation to options; all other fields are in the file."""
    pointers = {
        f"/parameters/{change.partition('=')[0].strip()}": "--set {}" for change in sets or ()
    }
    named = {
        pointer: option.format(pointer.rpartition("/")[2]) for pointer, option in pointers.items()
    }
    options = {"/plant": "--plant", "/name": "--name", **named}
    return FieldOrigins(options, rest="--set {}" if file is None else f"{file} …")


def _print_dataset(stored: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print_json(stored)
        return
    period = stored["sample_time"]
    sampling = "irregular sampling" if period is None else f"sampling period {period:.6g} s"
    before = stored["details"].get("known_before")
    history = f"known for {before:.6g} s before, " if before else ""
    print_line(
        f"{stored['id']}  {stored['name']}: {stored['samples']} samples, {sampling}, {history}"
        f"channels {_format_channels(stored)}"
    )
    for warning in stored["warnings"]:
        print_line(f"note: {warning}")


def _format_channels(dataset: dict[str, Any]) -> str:
    return ", ".join(
        append_unit(channel["name"], channel["unit"]) for channel in dataset["channels"]
    )
