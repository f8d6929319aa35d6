"""`lagid paper`: reproduce the paper's tables and figures by jobs, as tables and one report."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.common import (
    SERVER_PANEL,
    Force,
    Key,
    Quiet,
    err,
    out,
    protect_file,
    write_file,
)
from service.core.extras import check_extra

if TYPE_CHECKING:
    from service.client.client import Client


def reproduce_paper(
    output: Annotated[Path, typer.Option(help="File of the report.")] = Path("paper.html"),
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer replicates; under a minute.")
    ] = False,
    only: Annotated[
        str | None,
        typer.Option(help="Parts, such as table1,figure15 (default: all).", show_default=False),
    ] = None,
    url: Annotated[
        str | None,
        typer.Option(
            help="Server that runs the jobs (default: start one).",
            show_default=False,
            rich_help_panel=SERVER_PANEL,
        ),
    ] = None,
    key: Key = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Reproduce tables and figures of the paper that the method is from, by real jobs."""
    check_extra("server", "this command")
    from service.paper.bench import StudyBench
    from service.paper.document import to_markdown
    from service.paper.report import render_report
    from service.paper.study import choose_parts, conduct_study

    names = choose_parts(only)
    protect_file(output, force)
    start = time.monotonic()
    sections = []
    with _client(url, key) as client:
        bench = StudyBench(client, quick, lambda text: err.print(f"… {text}", markup=False))
        for section in conduct_study(bench, names):
            sections.append(section)
            out.print(to_markdown(section), markup=False, soft_wrap=True)
    write_file(output, render_report(sections, quick=quick))
    out.print(f"report {output.resolve()} ({time.monotonic() - start:.0f} s)", soft_wrap=True)


@contextmanager
def _client(url: str | None, key: str | None) -> "Iterator[Client]":
    """Open a client of the named server, or of one that runs until the command ends."""
    from service.client.client import Client
    from service.client.embedded import run_embedded_service
    from sysid.identification.warmup import compile_search

    if url is not None:
        with Client(url, key) as client:
            yield client
        return
    compile_search()  # here a line can tell it; a worker would be silent for a minute
    with (
        TemporaryDirectory(prefix="lagid-paper-") as folder,
        run_embedded_service(Path(folder), cpus=os.cpu_count()) as own_url,
        Client(own_url) as client,
    ):
        yield client
