"""Run all programs on measured records in one service: one table, free run on the test parts."""

from dataclasses import replace
from pathlib import Path

from benchmarks.real_data import (
    dryer2,
    emps,
    pneuact_tube,
    reidentify,
    silverbox,
    silverbox_narx,
    tube_reference,
)
from benchmarks.real_data.session import program
from benchmarks.table import Row
from service.client.client import Client

PROGRAMS = {
    "Silverbox": silverbox.measure,
    "Silverbox, NARX": silverbox_narx.measure,
    "EMPS": emps.measure,
    "dryer2": dryer2.measure,
    "pneuact": pneuact_tube.measure,
    "tube reference": tube_reference.measure,
    "tubes re-identified": reidentify.measure,
}


def measure(client: Client, folder: Path) -> list[Row]:
    """Rows of every program, each with the name of its data."""
    return [
        replace(row, name=f"{data}, {row.name}")
        for data, measure_data in PROGRAMS.items()
        for row in measure_data(client, folder)
    ]


if __name__ == "__main__":
    program("Measured records, free run on the test parts", __doc__ or "", measure)
