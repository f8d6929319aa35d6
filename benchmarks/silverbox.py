"""Measure the estimation of Silverbox (measured, 65,062 samples) through the service.

Six parameters from the catalogue's bounds, the default algorithm, two cores. The time is from the
submission to the stored result. It includes standard errors and validation on the three test parts.
"""

import argparse
import time
from typing import Any

from benchmarks.family import cpu_seconds
from benchmarks.real_data.session import data_folder, identify, parameter, service
from benchmarks.real_data.silverbox import ESTIMATION, TESTS
from benchmarks.table import Row, Skipped, parser, report
from service.client.client import Client

SECONDS = 30.0
MULTISINE_MV = 0.31
"""RMS of the free run on the multisine test that the result has to keep."""


def body(client: Client, raw: str) -> dict[str, Any]:
    """The job, its parts derived from the stored recording."""

    def part(name: str, rows: list[int]) -> str:
        steps: list[dict[str, Any]] = [{"trim": {"rows": rows}}, {"hold": {"u": "band-limited"}}]
        return str(client.derive(raw, steps, name=name)["id"])

    return {
        "name": "silverbox",
        "model": "silverbox",
        "datasets": [part("estimation", ESTIMATION)],
        "validation": {"datasets": [part(name, rows) for name, rows in TESTS.items()]},
        "skip": 50,
    }


def main(options: argparse.Namespace) -> None:
    """Measure and print."""
    title = "Silverbox, estimation on 65,062 samples"
    folder = data_folder()
    if folder is None:
        report(title, [], [Skipped(title, "LAGID_DATA is absent")], options)
        return
    with service() as (client, _):
        raw = client.add_dataset(folder / "silverbox" / "silverbox_snls80mv.csv", name="silverbox")
        job = body(client, raw["id"])
        before, start = cpu_seconds(), time.perf_counter()
        run = identify(client, job)
        wall, spent = time.perf_counter() - start, cpu_seconds()
    tests = run["agreement"]["validation"]
    lag = parameter(run, "L")
    rows = [
        Row("submission to stored result", wall, "s", SECONDS),
        Row("RMS of the free run, multisine test", 1e3 * tests[0]["rms"], "mV", MULTISINE_MV),
        Row("RMS on the estimation part", 1e3 * run["rms"], "mV"),
        Row("simulations", run["evaluations"], ""),
        Row("L", 1e6 * lag["value"], "µs"),
    ]
    rows += [
        Row(f"CPU of {name}", seconds - before.get(name, 0.0), "s")
        for name, seconds in sorted(spent.items())
        if seconds - before.get(name, 0.0) > 0.05
    ]
    report(title, rows, [], options)


if __name__ == "__main__":
    main(parser(__doc__ or "").parse_args())
