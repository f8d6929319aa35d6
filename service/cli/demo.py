"""`lagid demo`: run the paper's Example 1 through the whole service and compare with Table 1."""

import os
import shlex
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from service.cli.common import format_estimate
from service.cli.server_processes import load_settings
from service.client.client import Client
from service.client.embedded import run_embedded_service
from sysid.identification import warmup

# Example 1 of the paper: Eq. 13-16 with the parameters and the input of its section 4.
TRUE_PARAMETERS = {"c": 0.2, "L": 0.5, "b": 5.0, "a": 1.0}
NOISE_SD = 0.01
DATASET_BODY: dict[str, Any] = {
    "name": "paper example 1",
    "model": "duffing-eq16",
    "parameters": TRUE_PARAMETERS,
    "inputs": {"q": {"kind": "cosine", "amplitude": 10.0, "omega": 5.0}},
    "samples": 300,
    "sample_time": 0.02,
    "noise": {"sigma": NOISE_SD, "seed": 1},
}
METHODS = ("simple", "improved-paper", "improved")
# Table 1 of the paper: its simple GA and its proposed GA.
PAPER_SIMPLE = {"c": 0.143109, "L": 0.393939, "b": 5.171065, "a": 1.018573}
PAPER_PROPOSED = {"c": 0.195112, "L": 0.497556, "b": 5.004888, "a": 1.012708}


FOLDER = Path("lagid-demo")
DEFAULT_PORT = 8000


def run_demo(data_dir: Path | None, port: int | None, console: Console) -> None:
    """Start a service, identify Example 1 with three methods, print the table, stop the service.

    Without a folder or a port, those of the settings are used, else `FOLDER` and a free port.
    """
    settings = load_settings(data_dir=data_dir, port=port)
    data_dir = settings.data_dir if "data_dir" in settings.model_fields_set else FOLDER
    own_port = settings.port if settings.port and "port" in settings.model_fields_set else None
    warmup.compile_search()  # here a line can tell it; a worker would be silent for a minute
    console.print(
        "[bold]lagid[/] starts: web process, dispatcher, local Ray, SQLite", highlight=False
    )
    with run_embedded_service(data_dir, port=own_port, cpus=settings.cpus or os.cpu_count()) as url:
        console.print(f"service ready on {url}", highlight=False)
        report = run_example(url, data_dir, console)
    _print_locations(console, data_dir, report)
    command = [_name_program(), "serve", "--data-dir", str(data_dir)]
    command += [] if own_port is None else ["--port", str(own_port)]
    address = f"http://{settings.host}:{own_port or DEFAULT_PORT}/"
    console.print(
        f"Look at it again: {shlex.join(command)}, then open {address}",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )


def run_example(url: str, data_dir: Path, console: Console) -> Path:
    """Run Example 1 on a service, print its table, and write the report into a folder.

    Returns
    -------
    Path
        The file of the report.
    """
    with Client(url) as client:
        dataset = client.simulate_dataset(DATASET_BODY)
        job = client.submit(
            {
                "name": "paper example 1",
                "model": "duffing-eq16",
                "datasets": [dataset["id"]],
                "sweep": {"axes": [{"path": "/algorithm/method", "values": list(METHODS)}]},
            }
        )
        finished = _watch_job(client, job["id"], console)
        runs = {run["cell"]["/algorithm/method"]: run for run in client.runs(job["id"])}
        if finished["state"] != "succeeded":
            console.print(f"the job {finished['state']}: {finished['error']}")
            raise typer.Exit(1)
        _print_table(console, runs)
        report = data_dir / "report.html"
        report.write_text(client.report(job["id"]), encoding="utf-8")
    return report


def _name_program() -> str:
    """Name the program as this user can type it."""
    return "lagid" if shutil.which("lagid") else sys.argv[0]


def _watch_job(client: Client, job: str, console: Console) -> Mapping[str, Any]:
    columns = (
        TextColumn("{task.description:>16}"),
        BarColumn(bar_width=40),
        TextColumn("{task.percentage:>3.0f} %"),
        TextColumn("RMS {task.fields[rms]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as progress:
        bars: dict[str, TaskID] = {}

        def show(state: Mapping[str, Any]) -> None:
            for run in client.runs(job):
                method = run["cell"]["/algorithm/method"]
                if method not in bars:
                    bars[method] = progress.add_task(method, total=1.0, rms="–")
                rms = run["rms"]
                progress.update(
                    bars[method],
                    completed=run["progress"],
                    rms="–" if rms is None else f"{rms:.6f} m",
                )

        return client.wait(job, progress=show)


def _print_table(console: Console, runs: Mapping[str, Mapping[str, Any]]) -> None:
    table = Table(title="Example 1 (Eq. 13-16): estimates and the paper's Table 1")
    for heading in ("", "true", "paper, simple GA", "paper, proposed GA"):
        table.add_column(heading, justify="right")
    for method in METHODS:
        table.add_column(f"lagid, {method}", justify="right")
    for name, true in TRUE_PARAMETERS.items():
        cells = [_format_estimate(runs[method], name) for method in METHODS]
        unit = next(p["unit"] for p in runs["improved"]["parameters"] if p["name"] == name)
        table.add_row(
            f"{name} \\[{unit}]",
            f"{true:g}",
            f"{PAPER_SIMPLE[name]:.6f}",
            f"{PAPER_PROPOSED[name]:.6f}",
            *cells,
        )
    table.add_section()
    table.add_row("RMS \\[m]", f"{NOISE_SD:g}", "", "", *(f"{runs[m]['rms']:.6f}" for m in METHODS))
    table.add_row("simulations", "", "", "", *(str(runs[m]["evaluations"]) for m in METHODS))
    console.print(table)
    console.print(
        f"Estimate ± standard error. Measurement noise with sd {NOISE_SD:g} m was added. "
        "The paper does not publish its noise draw, so its columns are for orientation.",
        highlight=False,
    )


def _format_estimate(run: Mapping[str, Any], name: str) -> str:
    return format_estimate(next(p for p in run["parameters"] if p["name"] == name))


def _print_locations(console: Console, data_dir: Path, report: Path) -> None:
    folder = data_dir.resolve()
    console.print(f"report    {report.resolve()}", highlight=False, soft_wrap=True)
    console.print(f"MCAP      {folder / 'objects'}", highlight=False, soft_wrap=True)
    console.print(f"database  {folder / 'lagid.db'}", highlight=False, soft_wrap=True)
