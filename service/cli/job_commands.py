"""`lagid submit`, `watch`, `jobs`, `runs`, `cancel`, `resume`, `report`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.common import (
    MODEL_SUFFIXES,
    Document,
    FieldOrigins,
    Force,
    Limit,
    Listing,
    check_succeeded,
    fail,
    fail_usage,
    fetch_listing,
    file_origins,
    format_decimals,
    format_estimate,
    format_moment,
    name_file,
    out,
    print_job,
    print_json,
    print_line,
    print_listing,
    print_note,
    print_rest,
    print_table,
    protect_file,
    read_document,
    read_object,
    report_faults,
    server_command,
    write_file,
)
from service.cli.dataset_commands import find_dataset
from service.cli.item_commands import (
    FILTER_PANEL,
    LabelFilter,
    NamePart,
    Since,
    TagFilter,
    Until,
    add_item_commands,
    read_filters,
)
from service.cli.printed_tables import (
    MAX_PRINTED,
    print_reuse_note,
    print_run,
    print_run_summary,
    run_coordinates,
)
from service.cli.watch import follow_job
from service.core.states import JobState, describe_state
from service.formats.file_kinds import SUFFIXES
from sysid.core.text import append_unit

if TYPE_CHECKING:
    from service.client.client import Client


RUN_FILTER_ORIGINS = FieldOrigins(
    {
        "?state": "--state",
        "?cell": "--cell",
        "?label": "--label",
        "?tag": "--tag",
        "?order": "--order",
    }
)
JobName = Annotated[str, typer.Argument(metavar="JOB", help="Id of a job.")]


app = typer.Typer(help="Edit and delete jobs.", no_args_is_help=True)
add_item_commands(app, "lagid job", "job", "job_1", has_name=True)


@server_command(print_job)
def submit_job(
    client: "Client",
    file: Annotated[
        Path,
        typer.Argument(metavar="JOB.yaml", help="The job, YAML or JSON; - for standard input."),
    ],
    wait: Annotated[bool, typer.Option("--wait", help="Show progress until the job ends.")] = False,
    idempotency_key: Annotated[
        str | None, typer.Option(help="The same key returns the same job.")
    ] = None,
    as_json: bool = False,
) -> Document | None:
    """Submit a job, described in a file, to the server."""
    body = read_job(file)
    with report_faults(file_origins(file)):
        job = client.submit(body, idempotency_key=idempotency_key)
    if not wait:
        return job
    _print_end(client, follow_job(client, job["id"], quiet=as_json), as_json)
    return None


@server_command()
def watch_job(client: "Client", job: JobName, as_json: bool = False) -> None:
    """Show a job's progress and RMS until it ends, then its estimates."""
    _print_end(client, follow_job(client, job, quiet=as_json), as_json)


@server_command()
def list_jobs(
    client: "Client",
    state: Annotated[
        list[JobState] | None, typer.Option(help="Only jobs in this state; may be repeated.")
    ] = None,
    name: NamePart = None,
    model: Annotated[
        str | None, typer.Option(help="Only those of this model.", rich_help_panel=FILTER_PANEL)
    ] = None,
    dataset: Annotated[
        list[str] | None,
        typer.Option(
            help="Only those that use this dataset (id or name).", rich_help_panel=FILTER_PANEL
        ),
    ] = None,
    tag: TagFilter = None,
    label: LabelFilter = None,
    since: Since = None,
    until: Until = None,
    limit: Limit = None,
    as_json: bool = False,
) -> None:
    """List the jobs of the server, latest first."""
    filters = read_filters(
        state=state,
        name=name,
        model=model,
        dataset=[find_dataset(client, text)["id"] for text in dataset or ()],
        tag=tag,
        label=label,
        since=since,
        until=until,
    )
    listing = fetch_listing(lambda most: client.jobs(most, **filters), limit, as_json)
    print_listing(
        listing,
        as_json,
        ("id", "name", "state", "model", "runs", ">RMS", "unit", "verdict", "submitted"),
        lambda job: (
            job["id"],
            job["name"],
            _describe_state(job),
            job["model"],
            _format_progress(job),
            *_single_run_rms(job),
            _describe_outcome(job),
            format_moment(job["created_at"]),
        ),
        empty=_explain_no_jobs(state, filters),
    )


def _describe_outcome(job: Mapping[str, Any]) -> str | None:
    """Describe the verdict of the run that stands for a job, and which of several that is."""
    if job["outcome"] is None:
        return None
    verdict: str = job["outcome"]["verdict"]
    if job["progress"]["runs"] == 1:
        return verdict
    failed = f"{_describe_state(job)}; " if job["progress"]["failed"] else ""
    return f"{failed}best run: {verdict}"


def _describe_state(job: Mapping[str, Any]) -> str:
    return describe_state(job["state"], job["progress"]["failed"], job["progress"]["runs"])


def _explain_no_jobs(state: list[JobState] | None, filters: dict[str, Any]) -> str:
    if state and len(filters) == 1:
        return f"no jobs are {' or '.join(state)}"
    return "no such jobs" if filters else "no jobs; submit one: lagid submit job.yaml"


@server_command()
def list_runs(
    client: "Client",
    job: Annotated[
        str | None,
        typer.Argument(metavar="[JOB|RUN]", help="Id of a job (default: the latest) or of a run."),
    ] = None,
    state: Annotated[
        list[JobState] | None,
        typer.Option(
            help="Only runs in this state; may be repeated.", rich_help_panel=FILTER_PANEL
        ),
    ] = None,
    cell: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATH=VALUE",
            help="Only those with this value of an axis: /noise/sigma=0.1; may be repeated.",
            rich_help_panel=FILTER_PANEL,
        ),
    ] = None,
    label: LabelFilter = None,
    tag: TagFilter = None,
    order: Annotated[
        str | None, typer.Option(help="Column to sort by, such as best_rms (default: number).")
    ] = None,
    descending: Annotated[
        bool, typer.Option("--descending", help="The largest value first.")
    ] = False,
    limit: Limit = None,
    as_json: bool = False,
) -> None:
    """List the runs of a job with their estimates, or show one run."""
    chosen = read_filters(state=state, cell=cell, label=label, tag=tag)
    sorting = read_filters(order=order, descending=descending)
    with report_faults(RUN_FILTER_ORIGINS):
        if job is not None and job.startswith("run_"):
            if chosen or sorting:
                fail_usage(f"{job} is one run; name a job to choose or sort its runs")
            print_run(client.run(job), as_json)
            return
        about = client.job(job or _find_latest_job(client))
        most = limit if limit is not None or as_json else MAX_PRINTED

        def fetch(at_most: int | None) -> Sequence[Mapping[str, Any]]:
            return client.runs(about["id"], at_most=at_most, **chosen, **sorting)

        if chosen:
            listing = fetch_listing(fetch, most, as_json)
        else:  # the job knows how many there are
            runs = fetch(most or None)
            others = about["progress"]["runs"] - len(runs) if len(runs) == most else 0
            listing = Listing(runs, others)
    if as_json:
        print_json(listing.entries)
    else:
        print_runs(listing.entries, about["rms_unit"])
    print_rest(listing, as_json)


def _print_state(job: Document) -> None:
    print_line(f"{job['id']} is {job['state']}")


def _print_cancelled(job: Document) -> None:
    if job["state"] == "running":
        print_line(f"{job['id']} will be cancelled")
    else:
        _print_state(job)


@server_command(_print_cancelled)
def cancel_job(client: "Client", job: JobName) -> Document:
    """Cancel a job; results so far are kept."""
    return client.cancel(job)


@server_command(_print_state)
def resume_job(
    client: "Client",
    job: JobName,
    failed: Annotated[
        bool, typer.Option("--failed", help="Of a job that has ended, its failed runs alone.")
    ] = False,
) -> Document:
    """Queue a failed or cancelled job again; it continues where it stopped."""
    return client.resume(job, failed=failed)


@server_command()
def write_report(
    client: "Client",
    job: JobName,
    file: Annotated[Path, typer.Option("--output", "--out", "-o", help="File to write.")] = Path(
        "report.html"
    ),
    force: Force = False,
) -> None:
    """Write the report of a job as one HTML file."""
    protect_file(file, force)
    write_file(file, client.report(job))
    out.print(str(file), markup=False)


def read_job(file: Path) -> dict[str, Any]:
    """Read a job file; a model file is read relative to the job file's folder."""
    body = read_object(file, "a job (model: …, datasets: […])")
    model = body.get("model")
    if isinstance(model, str) and model.endswith(MODEL_SUFFIXES):
        body["model"] = read_document(file.parent / model)
    for dataset in body.get("datasets") or []:
        if isinstance(dataset, str) and dataset.endswith(SUFFIXES):
            fail(
                f"{name_file(file)}: datasets must be ids or names on the server, but "
                f"{dataset!r} is a file. Add it first: lagid dataset add {dataset}"
            )
    return body


def print_runs(runs: Sequence[Mapping[str, Any]], rms_unit: str | None = None) -> None:
    """Print runs with their cells, fits and estimates; labels replace the ids of their data."""
    places = [run_coordinates(run) for run in runs]
    paths = list(dict.fromkeys(path for coordinates in places for path in coordinates))
    units = {
        parameter["name"]: parameter["unit"] for run in runs for parameter in run["parameters"]
    }
    rows = []
    for run, coordinates in zip(runs, places, strict=True):
        estimates = {
            parameter["name"]: format_estimate(parameter) for parameter in run["parameters"]
        }
        fit = run["fit_percent"] or {}
        rows.append(
            [
                run["id"],
                run["state"],
                *(coordinates.get(path) for path in paths),
                run["rms"],
                format_decimals(fit.get("estimation")),
                format_decimals(fit.get("validation")),
                *(estimates.get(name) for name in units),
            ]
        )
    headings = (
        "run",
        "state",
        *paths,
        f">{append_unit('RMS', rms_unit)}",
        ">fit %",
        ">validation %",
        *(f">{append_unit(*name_and_unit)}" for name_and_unit in units.items()),
    )
    print_table(headings, rows, empty="no runs")


def _print_end(client: "Client", job: Mapping[str, Any], as_json: bool) -> None:
    runs = client.runs(job["id"])
    if as_json:
        print_json({**job, "runs": runs})
    elif len(runs) > MAX_PRINTED:
        print_run_summary(client, job, runs)
    else:
        print_runs(runs, job["rms_unit"])
        for warning in dict.fromkeys(w for run in runs for w in run["warnings"]):
            print_note(warning)
    if not as_json:
        print_reuse_note(job, runs, "reuse: false in the job")
    check_succeeded(job)


def _find_latest_job(client: "Client") -> str:
    jobs = client.jobs(limit=1)
    if not jobs:
        fail("there are no jobs; submit one: lagid submit job.yaml")
    return str(jobs[0]["id"])


def _format_progress(job: Mapping[str, Any]) -> str:
    """Format the count of finished runs; for several runs also how they ended."""
    done = job["progress"]
    text = f"{done['finished']}/{done['runs']}"
    if done["runs"] == 1 or not done["finished"]:
        return text
    succeeded = done["finished"] - done["failed"]
    return f"{text}: {succeeded} succeeded, {done['failed']} failed"


def _single_run_rms(job: Mapping[str, Any]) -> tuple[float | None, str | None]:
    """RMS and its unit for a job of one run; None for several, whose RMS are not comparable."""
    best = job["progress"]["best_rms"]
    if job["progress"]["runs"] != 1 or best is None:
        return None, None
    return best, job["rms_unit"]
