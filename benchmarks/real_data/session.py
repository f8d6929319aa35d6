"""Shared parts of the programs on measured records: the folder, a service, a job over REST."""

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.family import members, pss_bytes
from benchmarks.table import Row, Skipped, parser, report
from service.client.client import Client
from service.client.embedded import run_embedded_service

ROOT = Path(__file__).resolve().parents[2]


def data_folder() -> Path | None:
    """Return the folder of measured records (`LAGID_DATA`), or None when it is absent."""
    folder = Path(os.environ.get("LAGID_DATA", ROOT.parent / "shared" / "data"))
    return folder if folder.is_dir() else None


Measure = Callable[[Client, Path], list[Row]]
"""A program's work: from a client and the folder of records to its rows."""


def program(title: str, description: str, measure: Measure) -> None:
    """Run one program from the command line: options, a service, its table."""
    options = parser(description).parse_args()
    folder = data_folder()
    if folder is None:
        report(title, [], [Skipped(title, "LAGID_DATA is absent")], options)
        return
    with service() as (client, _):
        rows = measure(client, folder)
    report(title, [*rows, peak_memory_row()], [], options)


@contextmanager
def service() -> Iterator[tuple[Client, Path]]:
    """Start a service in a temporary folder; give a client and that folder."""
    with (
        tempfile.TemporaryDirectory(prefix="lagid-") as folder,
        run_embedded_service(Path(folder)) as url,
        Client(url) as client,
    ):
        yield client, Path(folder)


def identify(client: Client, body: Mapping[str, Any]) -> dict[str, Any]:
    """Submit a job of one run over REST, wait for it, and return the run's result."""
    (run,) = identify_all(client, body)
    return run


def identify_all(client: Client, body: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Submit a job over REST, wait for it, and return the results of its runs in their order."""
    job = client.submit(body)
    ended = client.wait(job["id"], progress=lambda _: PEAK.sample())
    if ended["state"] != "succeeded":
        raise SystemExit(f"job {body['name']!r} {ended['state']}: {ended.get('error')}")
    return [client.run(run["id"]) for run in client.runs(job["id"])]


def print_estimates(title: str, run: Mapping[str, Any]) -> None:
    """Print the estimates with standard errors, the fit, and the warnings of a run."""
    print(f"\n### {title}: {run['evaluations']} simulations, {run['seconds']:.1f} s\n")
    print("| parameter | estimate | standard error | unit | status |")
    print("|---|--:|--:|---|---|")
    for parameter in run["parameters"]:
        error = "–" if parameter["stderr"] is None else f"{parameter['stderr']:.4g}"
        cells = [parameter["name"], f"{parameter['value']:.6g}", error]
        print(f"| {' | '.join([*cells, parameter['unit'], parameter['status']])} |")
    for warning in run["warnings"]:
        print(f"- {warning}")


def parameter(run: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the entry of one parameter."""
    return next(dict(entry) for entry in run["parameters"] if entry["name"] == name)


def peak_memory_row() -> Row:
    """Peak of the memory that this machine's processes of the service held together, in GB."""
    return Row("peak memory, all processes", PEAK.gigabytes, "GB", 1.5)


class _Peak:
    """The largest sum of the proportional set sizes of this process's descendants seen so far."""

    gigabytes = 0.0

    def sample(self) -> None:
        """Look once."""
        self.gigabytes = max(self.gigabytes, sum(map(pss_bytes, members())) / 1e9)


PEAK = _Peak()
