"""`lagid reidentify` and `lagid references`.

The first runs a warm-started batch over a label as one job with one table. The second lists and
accepts reference runs by name.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.common import (
    OUTPUT_PANEL,
    Document,
    FieldOrigins,
    Force,
    Limit,
    ModelName,
    apply_setting,
    check_succeeded,
    fail,
    fail_usage,
    fetch_listing,
    format_estimate,
    format_moment,
    out,
    parse_channels,
    parse_number,
    print_job,
    print_json,
    print_listing,
    print_table,
    protect_file,
    read_model,
    report_faults,
    server_command,
    show_examples,
    split_names,
    upload_origins,
    write_file,
)
from service.cli.item_commands import (
    NamePart,
    Since,
    TagFilter,
    Until,
    add_item_commands,
    read_filters,
)
from service.cli.printed_tables import print_reuse_note, print_trend
from service.cli.watch import follow_job
from service.core.label_text import format_labels
from service.formats.file_kinds import SUFFIXES

if TYPE_CHECKING:
    from service.client.client import Client


Experiments = Annotated[
    list[str],
    typer.Argument(
        metavar="X=DATA[,DATA] …",
        help="Recordings for each value of the label: files or datasets on the server. Those "
        "joined by a comma are fitted together.",
    ),
]
Label = Annotated[str, typer.Option("--label", help="What X is, such as length_m.")]
Reference = Annotated[
    str | None,
    typer.Option(help="Run (run_…) or accepted reference to start from and to compare with."),
]
Parameters = Annotated[
    str, typer.Option(help="Parameters to report, separated by commas (default: all free ones).")
]
Predict = Annotated[str, typer.Option(help="Values of X to predict at, separated by commas.")]
WarmStart = Annotated[
    str | None, typer.Option(help="Starting point of each run: reference, previous or none.")
]
Channels = Annotated[str, typer.Option(help="Which channel is which signal: u=P1,y=P2.")]
Changes = Annotated[
    list[str] | None,
    typer.Option("--set", help="path=value of the job: parameters.L.upper=0.5."),
]
JobNameOption = Annotated[str | None, typer.Option(help="Name of the job.")]
Wait = Annotated[bool, typer.Option("--wait", help="Show progress, then the table.")]
Accept = Annotated[
    str | None, typer.Option(metavar="NAME", help="Accept a run of the batch as this reference.")
]
AcceptRun = Annotated[
    str | None, typer.Option(metavar="X", help="Value of the label of the run to accept.")
]
KeepOutliers = Annotated[
    bool, typer.Option("--keep-outliers", help="Let the laws of the trend count outliers.")
]
TrendFile = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="FILE",
        help="Wait, and write the trend as JSON.",
        rich_help_panel=OUTPUT_PANEL,
    ),
]


@server_command(print_job)
def reidentify(
    client: "Client",
    experiments: Experiments,
    model: ModelName,
    label: Label,
    reference: Reference = None,
    parameters: Parameters = "",
    predict: Predict = "",
    warm_start: WarmStart = None,
    channels: Channels = "",
    changes: Changes = None,
    name: JobNameOption = None,
    wait: Wait = False,
    accept: Accept = None,
    accept_run: AcceptRun = None,
    output: TrendFile = None,
    keep_outliers: KeepOutliers = False,
    force: Force = False,
    as_json: bool = False,
) -> Document | None:
    """Identify one model on each recording of a batch: a trend over a label such as length.

    Each run starts at the reference, or at the result of its neighbour.
    """
    protect_file(output, force)
    batch = [_parse_experiments(text) for text in experiments]
    chosen = _choose_label_value([x for x, _ in batch], label, accept, accept_run)
    body: dict[str, Any] = {
        "model": read_model(model),
        "label": label,
        "trend_parameters": split_names(parameters),
        "predict": [parse_number("--predict", text) for text in split_names(predict)],
        "channels": parse_channels(channels),
        **_drop_missing(reference=reference, warm_start=warm_start, name=name),
    }
    for change in changes or []:
        apply_setting(body, change)
    body["batch"] = _upload_batch(client, batch)
    with report_faults(_field_origins(experiments)):
        job = client.reidentify(body)
    if not (wait or accept or output):
        return job
    ended = follow_job(client, job["id"], quiet=as_json)
    _print_outcome(client, ended, output, keep_outliers=keep_outliers, as_json=as_json)
    if accept is not None:
        _accept_run(client, ended, accept, label, chosen, quiet=as_json)
    return None


def _field_origins(experiments: list[str]) -> FieldOrigins:
    """Map the fields of the body to options; entries of the batch are named as typed."""
    batch = {f"/batch/{number}": text for number, text in enumerate(experiments)}
    return FieldOrigins(
        {
            "/model": "--model …",
            "/label": "--label",
            "/trend_parameters": "--parameters",
            "/predict": "--predict",
            "/reference": "--reference",
            "/warm_start": "--warm-start",
            "/name": "--name",
            "/channels": "--channels {}",
            **batch,
        }
    )


def _print_outcome(
    client: "Client",
    job: Mapping[str, Any],
    output: Path | None,
    *,
    keep_outliers: bool,
    as_json: bool,
) -> None:
    trend = client.trend(job["id"], "include" if keep_outliers else None)
    if as_json:
        print_json(trend)
    else:
        print_trend(trend, FieldOrigins())
        print_reuse_note(job, (), "--set reuse=false")
    if output is not None:
        write_file(output, json.dumps(trend, indent=2, ensure_ascii=False))
    check_succeeded(job)


def _choose_label_value(
    values: list[float], label: str, accept: str | None, accept_run: str | None
) -> float:
    """Choose the label value of the run to accept, before anything is computed."""
    choices = f"there are {', '.join(f'{x:g}' for x in sorted(set(values)))}"
    if accept is None:
        if accept_run is not None:
            fail_usage("--accept-run needs --accept NAME, the name of the reference")
        return values[0]
    if accept_run is None and len(set(values)) > 1:
        fail_usage(f"--accept needs --accept-run, a value of {label}; {choices}")
    if accept_run is not None and accept_run.startswith("run_"):
        fail_usage(
            f"--accept-run {accept_run}: need a value of {label}; {choices}. For a run of another "
            f"batch: lagid references accept {accept} {accept_run}"
        )
    x = values[0] if accept_run is None else parse_number("--accept-run", accept_run)
    if values.count(x) != 1:
        count = f"{values.count(x)} experiments have {label} = {x:g}; {choices}"
        several = f". Accept one of their runs afterwards: lagid references accept {accept} RUN"
        fail_usage(f"--accept-run {x:g}: {count}{several if x in values else ''}")
    return x


def _accept_run(
    client: "Client", job: Mapping[str, Any], name: str, label: str, x: float, *, quiet: bool
) -> None:
    """Accept a run of the batch as the reference of a name."""
    (run,) = client.runs(job["id"], label=f"{label}={json.dumps(x)}")
    accepted = client.accept_reference(name, run["id"])
    if not quiet:
        _print_accepted(accepted)


def _upload_batch(client: "Client", batch: list[tuple[float, list[str]]]) -> list[dict[str, Any]]:
    """Replace the files of a batch by dataset ids; each file is uploaded once."""
    dataset_ids: dict[str, str] = {}
    for source in (name for _, sources in batch for name in sources):
        if source in dataset_ids:
            continue
        path = Path(source)
        if not path.is_file() and source.endswith(SUFFIXES):
            fail(f"there is no file {source}")
        dataset_ids[source] = source
        if path.is_file():
            with report_faults(upload_origins(path)):
                dataset_ids[source] = client.add_dataset(path)["id"]
    return [{"x": x, "datasets": [dataset_ids[name] for name in sources]} for x, sources in batch]


def _parse_experiments(text: str) -> tuple[float, list[str]]:
    x, equals, sources = text.partition("=")
    names = split_names(sources)
    if not (equals and names):
        fail_usage(f"{text}: need X=DATA, the value of the label and a recording, such as 5=a.csv")
    return parse_number(text, x), names


def _drop_missing(**options: str | None) -> dict[str, str]:
    return {name: value for name, value in options.items() if value is not None}


app = typer.Typer(
    help="Runs that later batches are compared with: list, show, accept.", no_args_is_help=True
)

REFERENCE_ORIGINS = FieldOrigins(
    {"/run": "RUN", "/by": "--by", "/note": "--note", "{name}": "NAME"}
)

ReferenceName = Annotated[str, typer.Argument(metavar="NAME", help="Name of the reference.")]


@app.command("list", epilog=show_examples("lagid references list"))
@server_command()
def list_references(
    client: "Client",
    name: NamePart = None,
    tag: TagFilter = None,
    since: Since = None,
    until: Until = None,
    limit: Limit = None,
    as_json: bool = False,
) -> None:
    """List the current references."""
    filters = read_filters(name=name, tag=tag, since=since, until=until)
    listing = fetch_listing(lambda most: client.references(most, **filters), limit, as_json)
    print_listing(
        listing,
        as_json,
        ("name", "run", "accepted", "by", "labels", "estimates"),
        lambda reference: (
            reference["name"],
            reference["run"],
            format_moment(reference["at"]),
            reference["by"],
            format_labels(reference["labels"]),
            _format_estimates(reference["estimates"]),
        ),
        empty="no such references"
        if filters
        else "no references; accept one: lagid references accept NAME RUN",
    )


def _print_reference(reference: Mapping[str, Any]) -> None:
    out.print(f"{reference['name']}: {_format_estimates(reference['estimates'])}", markup=False)
    if reference["labels"]:
        out.print(format_labels(reference["labels"]), markup=False)
    rows = [
        (version["run"], format_moment(version["at"]), version["by"], version["note"])
        for version in (reference, *reference["history"])
    ]
    print_table(("run", "accepted", "by", "note"), rows, empty="")


@app.command("show", epilog=show_examples("lagid references show tube"))
@server_command(_print_reference)
def show_reference(client: "Client", name: ReferenceName) -> Mapping[str, Any]:
    """Show a reference and the runs accepted before it."""
    return client.reference(name)


def _print_accepted(reference: Mapping[str, Any]) -> None:
    before = f" (before: {reference['history'][0]['run']})" if reference["history"] else ""
    out.print(f"{reference['name']}: {reference['run']}{before}", markup=False)


@app.command(
    "accept",
    epilog=show_examples("lagid references accept tube run_1 --by 'A. Engineer' --note spring"),
)
@server_command(_print_accepted)
def accept_reference(
    client: "Client",
    name: ReferenceName,
    run: Annotated[str, typer.Argument(metavar="RUN", help="Id of a run that succeeded.")],
    by: Annotated[str | None, typer.Option(help="Who accepts it.")] = None,
    note: Annotated[str | None, typer.Option(help="Why.")] = None,
) -> Mapping[str, Any]:
    """Accept a run as the reference of a name; the previous run stays in the history."""
    with report_faults(REFERENCE_ORIGINS):
        return client.accept_reference(name, run, by=by, note=note)


def _format_estimates(estimates: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{name} = {format_estimate(estimate)}" for name, estimate in estimates.items()
    )


add_item_commands(app, "lagid references", "reference", "tube", has_name=True)
