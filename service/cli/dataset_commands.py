"""`lagid datasets` and `lagid dataset …`."""

import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any, Literal

import typer

from service.cli.common import (
    DATA_HELP,
    DOCUMENT_HELP,
    LISTED_ENTRIES,
    STANDARD_INPUT,
    AsJson,
    Columns,
    Exclude,
    FieldOrigins,
    Force,
    Limit,
    McapClock,
    Missing,
    Quiet,
    SampleTime,
    Segments,
    check_file,
    fail,
    fail_usage,
    fetch_listing,
    file_origins,
    name_file,
    parse_number,
    parse_pairs,
    print_json,
    print_line,
    print_listing,
    print_note,
    print_table,
    protect_file,
    read_document,
    read_file,
    read_object,
    replace_file,
    report_faults,
    server_command,
    show_examples,
    upload_origins,
)
from service.cli.item_commands import (
    LabelFilter,
    NamePart,
    Since,
    TagFilter,
    Until,
    add_item_commands,
    read_filters,
)
from service.core.label_text import format_subtracted
from sysid.core.errors import suggest_name
from sysid.core.text import append_unit

if TYPE_CHECKING:
    from service.client.client import Client


app = typer.Typer(
    help="Add, show, download, simulate, derive and join recordings.", no_args_is_help=True
)

DATASET_ID = "ds_"


DatasetName = Annotated[str, typer.Argument(metavar="DATASET", help="Id or name of a dataset.")]


def _print_dataset(stored: Mapping[str, Any]) -> None:
    period = stored["sample_time"]
    sampling = "irregular sampling" if period is None else f"sampling period {period:.6g} s"
    before = stored["details"].get("known_before")
    history = f"known for {before:.6g} s before, " if before else ""
    started = f"started at {stored['started_at']}, " if stored["started_at"] else ""
    print_line(
        f"{stored['id']}  {stored['name']}: {stored['samples']} samples, {sampling}, "
        f"{started}{history}channels {_format_channels(stored)}"
    )
    for trend in stored["details"].get("subtracted") or ():
        print_note(f"subtracted from {format_subtracted(trend)}")
    for warning in stored["warnings"]:
        print_note(warning)


@server_command()
def list_datasets(
    client: "Client",
    name: NamePart = None,
    tag: TagFilter = None,
    label: LabelFilter = None,
    since: Since = None,
    until: Until = None,
    limit: Limit = None,
    as_json: bool = False,
) -> None:
    """List the recordings of the server, latest first."""
    filters = read_filters(name=name, tag=tag, label=label, since=since, until=until)
    listing = fetch_listing(lambda most: client.datasets(most, **filters), limit, as_json)
    print_listing(
        listing,
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
        empty="no such datasets"
        if filters
        else "no datasets; add one: lagid dataset add recording.csv",
    )


@app.command(
    "add",
    epilog=show_examples(
        "lagid dataset add recording.csv",
        "lagid dataset add tube-5m.csv tube-10m.csv",
        "zcat recording.csv.gz | lagid dataset add - --name recording",
    ),
)
@server_command()
def add_datasets(
    client: "Client",
    files: Annotated[list[Path], typer.Argument(metavar="FILE…", help=DATA_HELP)],
    name: Annotated[
        str | None, typer.Option(help="Name of a single one; by default that of the file.")
    ] = None,
    segments: Segments = None,
    sample_time: SampleTime = None,
    columns: Columns = None,
    missing: Missing = None,
    exclude: Exclude = None,
    clock: McapClock = None,
    as_json: bool = False,
) -> None:
    """Store recordings."""
    if name is not None and len(files) > 1:
        fail_usage(f"--name names one recording; found {len(files)} files")
    for file in files:
        check_file(file)
    stored = []
    for file in files:
        source = read_file(file) if file == STANDARD_INPUT else file
        with report_faults(upload_origins(file)):
            stored.append(
                client.add_dataset(
                    source,
                    name,
                    segments=segments,
                    sample_time=sample_time,
                    columns=columns,
                    missing=missing,
                    exclude=exclude,
                    clock=clock,
                )
            )
        if not as_json:
            _print_dataset(stored[-1])
    if as_json:
        print_json(stored[0] if len(files) == 1 else stored)


def _print_whole_dataset(stored: Mapping[str, Any]) -> None:
    _print_dataset(stored)
    rows = [
        [channel[field] for field in ("name", "unit", "samples", "missing", "hold")]
        for channel in stored["channels"]
    ]
    print_table(("channel", "unit", ">samples", ">missing", "hold"), rows, empty="none")


@app.command(
    "check",
    epilog=show_examples(
        "lagid dataset check recording.csv",
        "lagid dataset check logger.txt --sample-time 0.1 --json",
    ),
)
def check_dataset(
    file: Annotated[Path, typer.Argument(metavar="FILE", help=DATA_HELP)],
    segments: Segments = None,
    sample_time: SampleTime = None,
    columns: Columns = None,
    missing: Missing = None,
    exclude: Exclude = None,
    clock: McapClock = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Check what happened to a recording, without a model and without a server.

    Gaps, stamps, repeated and coarse values, limits, means, resampled logs, changes of a unit.
    """
    from service.cli.identify_command import build_file_options, read_input_file
    from sysid.core.value_documents import encode
    from sysid.inspection.inspect import check_recording

    options = build_file_options(
        file,
        sample_time=sample_time,
        segments=segments,
        columns=columns,
        missing=missing,
        exclude=exclude,
        clock=clock,
    )
    recording = read_input_file(file, options)
    findings = check_recording(recording)
    if as_json:
        print_json([encode(finding) for finding in findings])
        return
    print_line(str(recording))
    for finding in findings:
        print_line(f"{finding.explanation}: {finding.sentences}")
    if not findings:
        print_line("nothing was found")


@app.command("show", epilog=show_examples("lagid dataset show recording"))
@server_command(_print_whole_dataset)
def show_dataset(client: "Client", dataset: DatasetName) -> Mapping[str, Any]:
    """Show one recording: its samples and its channels."""
    return find_dataset(client, dataset)


@app.command(
    "download",
    epilog=show_examples(
        "lagid dataset download recording",
        "lagid dataset download recording --format csv --output - | head",
    ),
)
@server_command()
def download_dataset(
    client: "Client",
    dataset: DatasetName,
    file: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="File to write (default: name of the dataset); - for stdout."
        ),
    ] = None,
    format: Annotated[
        Literal["mcap", "csv"] | None,
        typer.Option(
            help="Default: as the file's name says, else MCAP, which keeps units and holds."
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Download a recording."""
    if format is None:
        format = "csv" if file is not None and file.suffix.lower() == ".csv" else "mcap"
    found = find_dataset(client, dataset)
    if file == STANDARD_INPUT:
        _write_pieces(client.download(found["id"], format), sys.stdout.buffer)
        return
    target = file or Path(f"{found['name'].replace('/', '_')}.{format}")
    protect_file(target, force)
    with replace_file(target) as sink:
        _write_pieces(client.download(found["id"], format), sink)
    print_line(str(target))


@app.command(
    "simulate",
    epilog=show_examples(
        "lagid dataset simulate --plant tube --set length_m=30 --name tube-30m",
        "lagid dataset simulate simulation.yaml",
    ),
)
@server_command(_print_dataset)
def simulate_dataset(
    client: "Client",
    file: Annotated[Path | None, typer.Argument(help=DOCUMENT_HELP)] = None,
    plant: Annotated[
        str | None, typer.Option(help="Reference plant instead of a model: actuator or tube.")
    ] = None,
    sets: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A parameter, such as length_m=30."),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the dataset.")] = None,
) -> Mapping[str, Any]:
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
    with report_faults(_field_origins(file, sets)):
        return client.simulate_dataset(body)


@app.command("join", epilog=show_examples("lagid dataset join supply room --name heating"))
@server_command(_print_dataset)
def join_datasets(
    client: "Client",
    datasets: Annotated[
        list[str], typer.Argument(metavar="DATASET…", help="Ids or names of the recordings.")
    ],
    name: Annotated[str | None, typer.Option(help="Name of the new dataset.")] = None,
) -> Mapping[str, Any]:
    """Join recordings of several loggers on one clock; nothing is resampled."""
    if len(datasets) < 2:
        fail_usage(f"need two or more recordings to join; found {datasets[0]}")
    with report_faults(FieldOrigins({"/datasets": "DATASET", "/name": "--name"})):
        return client.join(datasets, name)


@app.command(
    "derive", epilog=show_examples("lagid dataset derive recording steps.yaml --name trimmed")
)
@server_command(_print_dataset)
def derive_dataset(
    client: "Client",
    dataset: Annotated[str, typer.Argument(help="Id or name of the parent.")],
    file: Annotated[
        Path,
        typer.Argument(help="YAML or JSON file with the list of steps; - for standard input."),
    ],
    name: Annotated[str | None, typer.Option(help="Name of the new dataset.")] = None,
) -> Mapping[str, Any]:
    """Derive a recording from another: add noise, resample, trim, select, pool etc."""
    steps = read_document(file)
    if isinstance(steps, dict):
        steps = steps.get("steps")
    if not isinstance(steps, list):
        fail(f"{name_file(file)} has no list of steps, such as - detrend: {{}}")
    with report_faults(file_origins(file, {"/name": "--name"})):
        return client.derive(dataset, steps, name)


def find_dataset(client: "Client", name: str) -> Mapping[str, Any]:
    """Find a dataset by its id or name; end the command if none or several have it."""
    if name.startswith(DATASET_ID):
        return client.dataset(name)
    found = [dataset for dataset in client.datasets(name=name) if dataset["name"] == name]
    if not found:
        latest = client.datasets(LISTED_ENTRIES)
        hint = suggest_name(name, {dataset["name"] for dataset in latest})
        fail(f"there is no dataset {name!r}{hint}")
    if len(found) > 1:
        ids = ", ".join(dataset["id"] for dataset in found)
        fail_usage(f"{len(found)} datasets are named {name!r}; choose one by its id: {ids}")
    return found[0]


def _write_pieces(pieces: Iterable[bytes], sink: IO[bytes]) -> None:
    for piece in pieces:
        sink.write(piece)
    sink.flush()


def _field_origins(file: Path | None, sets: list[str] | None) -> FieldOrigins:
    """Map the fields of a simulation to options; all other fields are in the file."""
    pointers = {
        f"/parameters/{change.partition('=')[0].strip()}": "--set {}" for change in sets or ()
    }
    named = {
        pointer: option.format(pointer.rpartition("/")[2]) for pointer, option in pointers.items()
    }
    options = {"/plant": "--plant", "/name": "--name", **named}
    return FieldOrigins(options) if file is None else file_origins(file, options)


def _format_channels(dataset: Mapping[str, Any]) -> str:
    return ", ".join(
        append_unit(channel["name"], channel["unit"]) for channel in dataset["channels"]
    )


add_item_commands(
    app,
    "lagid dataset",
    "dataset",
    "recording",
    has_name=True,
    resolve=lambda client, name: str(find_dataset(client, name)["id"]),
)
