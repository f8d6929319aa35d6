"""`lagid runs` and `lagid export`.

The first lists the runs of a job and analyses single runs. The second writes the identified model
of a run for other programs.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperGroup

from service.cli.common import (
    DOCUMENT_HELP,
    Document,
    FieldOrigins,
    Force,
    fail_usage,
    file_origins,
    format_decimals,
    format_estimate,
    out,
    print_note,
    print_table,
    protect_file,
    read_object,
    report_faults,
    server_command,
    show_examples,
    write_file,
)
from service.cli.item_commands import add_item_commands
from service.cli.job_commands import list_runs as listing
from sysid.core.text import format_p_value
from sysid.core.units import multiply_units

if TYPE_CHECKING:
    from service.client.client import Client

LIST_COMMAND = "list"
PROFILE_ORIGINS = FieldOrigins({"/parameters": "PARAMETER", "/points": "--points"})

_MARGINS = (
    ("gain margin", "gain_margin", ""),
    ("phase margin", "phase_margin", "°"),
    ("delay margin", "delay_margin", " s"),
    ("M_s", "sensitivity_peak", ""),
)

RunName = Annotated[str, typer.Argument(metavar="RUN", help="Id of a run.")]


class _RunsGroup(TyperGroup):
    """Group of commands on runs; without a command it lists the runs of a job."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args or args[0] not in (*self.commands, *ctx.help_option_names):
            args = [LIST_COMMAND, *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_RunsGroup,
    add_completion=False,
    help="List the runs of a job with their estimates: lagid runs [JOB]. Show one run: "
    "lagid runs RUN. Or analyse a run with one of the commands.",
)
app.command(
    LIST_COMMAND,
    epilog=show_examples(
        "lagid runs",
        "lagid runs job_1 --state failed --tag suspect",
        "lagid runs job_1 --order best_rms",
        "lagid runs run_1",
    ),
)(listing)


def _print_residuals(residuals: Document) -> None:
    headings = (
        "test",
        "experiment",
        "output",
        "input",
        ">samples",
        ">inside 95 %",
        ">inside 99 %",
        ">p",
        "verdict",
    )
    print_table(headings, map(_test_row, residuals["tests"]), empty="no tests")
    verdict = {True: "passed", False: "failed", None: "not tested"}[residuals["passed"]]
    out.print(f"residuals on {residuals['data']} data: {verdict}", markup=False)
    if residuals["note"]:
        print_note(residuals["note"])


@app.command("residuals", epilog=show_examples("lagid runs residuals run_1"))
@server_command(_print_residuals)
def fetch_residuals(client: "Client", run: RunName) -> Document:
    """Test whether a run's residuals are white and independent of the inputs."""
    return client.residuals(run)


def _print_simulation(simulation: Document) -> None:
    for output in simulation["outputs"]:
        values = [value for value in output["values"] if value is not None]
        out.print(
            f"{output['name']} [{output['unit']}]: {output['samples']} samples, "
            f"from {min(values):.6g} to {max(values):.6g}, at the end {values[-1]:.6g}",
            markup=False,
            soft_wrap=True,
        )
    _print_step(simulation["metrics"])
    _print_controller(simulation["controller"], simulation["tuning"], simulation["margins"])
    for note in simulation["notes"]:
        print_note(note)
    if simulation["dataset"]:
        out.print(f"stored as {simulation['dataset']['id']}", markup=False)


@app.command("simulate", epilog=show_examples("lagid runs simulate run_1 loop.yaml"))
@server_command(_print_simulation)
def simulate_run(
    client: "Client",
    run: RunName,
    file: Annotated[Path, typer.Argument(help=DOCUMENT_HELP)],
    max_points: Annotated[int, typer.Option(min=2, help="Most points per line.")] = 1000,
) -> Document:
    """Simulate the identified model on a new input or under P, PI or PID control."""
    body = read_object(file)
    with report_faults(file_origins(file, {"?max_points": "--max-points"})):
        return client.simulate_run(run, body, max_points)


def _print_profiles(answer: Document) -> None:
    rows = [
        [
            profile["name"],
            profile["unit"],
            f"{profile['estimate']:.6g}",
            *("open" if end is None else f"{end:.6g}" for end in profile["interval95"]),
        ]
        for profile in answer["profiles"]
    ]
    print_table(("parameter", "unit", ">estimate", ">from", ">to"), rows, empty="no parameters")


@app.command("profile", epilog=show_examples("lagid runs profile run_1 L T --points 41"))
@server_command(_print_profiles)
def profile_run(
    client: "Client",
    run: RunName,
    parameters: Annotated[
        list[str] | None,
        typer.Argument(metavar="PARAMETER…", help="Parameters (default: all free ones)."),
    ] = None,
    points: Annotated[int, typer.Option(min=3, max=101, help="Values per parameter.")] = 21,
) -> Document:
    """Compute profile likelihoods: 95 % intervals, all other parameters re-estimated."""
    with report_faults(PROFILE_ORIGINS):
        return client.profile(run, *(parameters or ()), points=points)


def _print_comparison(comparison: Document) -> None:
    headings = (
        "run",
        "model",
        ">parameters",
        ">samples",
        f">RMS [{comparison['unit']}]",
        ">fit %",
        ">validation %",
        ">AIC",
        ">BIC",
        "residuals",
        *(f">{parameter['name']}" for parameter in comparison["parameters"]),
    )
    print_table(
        headings,
        [_comparison_row(run, comparison["parameters"]) for run in comparison["runs"]],
        empty="no runs",
    )
    for note in comparison["notes"]:
        print_note(note)


@app.command("compare", epilog=show_examples("lagid runs compare run_1 run_2"))
@server_command(_print_comparison)
def compare_runs(
    client: "Client",
    runs: Annotated[list[str], typer.Argument(metavar="RUN RUN…", help="Ids of two runs or more.")],
) -> Document:
    """Compare runs of several models on the same data."""
    with report_faults(FieldOrigins({"/runs": "RUN"})):
        return client.compare(*runs)


def _print_step(metrics: Mapping[str, Any] | None) -> None:
    if metrics is None:
        return
    if metrics["runs_away"]:
        out.print(
            f"the loop diverges: {metrics['output']} drifts or oscillates ever farther from the "
            "reference. "
            "Choose a smaller gain.",
            markup=False,
        )
        return
    lines = (
        ("rise time (10 to 90 %)", metrics["rise_time"], "s"),
        ("overshoot of the reference", metrics["overshoot_percent"], "%"),
        ("overshoot of the final value", metrics["overshoot_of_final_percent"], "%"),
        ("settling time (2 %)", metrics["settling_time"], "s"),
        ("steady error", metrics["steady_error"], metrics["unit"]),
        ("IAE", metrics["iae"], multiply_units(metrics["unit"], "s")),
        ("ITAE", metrics["itae"], multiply_units(metrics["unit"], "s²")),
    )
    for name, value, unit in lines:
        missing = "not in this record: it has not settled" if "settling" in name else "never"
        shown = missing if value is None else f"{value:.4g} {unit}"
        out.print(f"{name}: {shown}", markup=False)


def _print_controller(
    used: Mapping[str, Any] | None,
    tuning: Mapping[str, Any] | None,
    margins: Mapping[str, Any] | None,
) -> None:
    """Print the controller's settings, their tuning rule, and the stability margins."""
    if used is None:
        return
    parts = [f"K = {used['gain']:.6g}"]
    if used["integral_time"] is not None:
        parts.append(f"T_i = {used['integral_time']:.6g} s")
    if used["derivative_time"]:
        parts.append(f"T_d = {used['derivative_time']:.6g} s, N = {used['derivative_filter']:.4g}")
    rule = "" if tuning is None else f" by {tuning['rule'].upper()} ({tuning['reference']})"
    out.print(f"controller{rule}: {', '.join(parts)}", markup=False, soft_wrap=True)
    limited = (
        ""
        if used["lower"] is used["upper"] is None
        else (f", {used['saturated_percent']:.3g} % of the time at a limit")
    )
    out.print(
        f"command: {used['command_min']:.6g} to {used['command_max']:.6g}{limited}", markup=False
    )
    if margins is not None and margins["is_stable"]:
        shown = [
            f"{name} {margins[key]:.3g}{unit}"
            for name, key, unit in _MARGINS
            if margins[key] is not None
        ]
        out.print(f"without limits: stable, {', '.join(shown)}", markup=False)


def _test_row(test: Mapping[str, Any]) -> tuple[object, ...]:
    reason = f": {test['reason']}" if test["reason"] else ""
    return (
        test["test"],
        test["experiment"] + 1,
        test["output"],
        test["input"],
        test["samples"],
        _format_percent(test["inside95"]),
        _format_percent(test["inside99"]),
        format_p_value(test["p"]),
        f"{test['outcome']}{reason}",
    )


def _comparison_row(
    run: Mapping[str, Any], parameters: Sequence[Mapping[str, Any]]
) -> tuple[object, ...]:
    values = [
        next(
            (format_estimate(value) for value in parameter["values"] if value["run"] == run["run"]),
            None,
        )
        for parameter in parameters
    ]
    passed = {True: "passed", False: "failed", None: None}[run["residuals_passed"]]
    return (
        *(run[name] for name in ("run", "title", "parameters", "samples", "rms")),
        *(
            format_decimals(run[name])
            for name in ("fit_estimation", "fit_validation", "aic", "bic")
        ),
        passed,
        *values,
    )


def _format_percent(part: float | None) -> str | None:
    return None if part is None else f"{100 * part:.0f}"


EXPORT_ORIGINS = FieldOrigins({"?format": "--format", "?pade_order": "--pade-order"})


@server_command()
def export_model(
    client: "Client",
    run: Annotated[str, typer.Argument(metavar="RUN", help="Id of a run.")],
    format: Annotated[
        Literal["json", "python", "c", "control"] | None,
        typer.Option(
            help="JSON document (default), Python or C99 source, or a script for python-control."
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write (default: stdout).")
    ] = None,
    pade_order: Annotated[
        int,
        typer.Option(
            min=1, max=20, help="Order of the Padé approximation of dead times (control)."
        ),
    ] = 3,
    force: Force = False,
    as_json: bool = False,
) -> None:
    """Write the identified model of a run for another program."""
    if as_json and format not in (None, "json"):
        fail_usage(f"--json prints the JSON document; leave out --format {format}")
    protect_file(output, force)
    with report_faults(EXPORT_ORIGINS):
        text = client.export(run, format or "json", pade_order)
    if output is None or as_json:
        typer.echo(text, nl=False)
    if output is None:
        return
    write_file(output, text)
    if not as_json:
        out.print(str(output), markup=False)


add_item_commands(app, "lagid runs", "run", "run_1", has_name=False)
