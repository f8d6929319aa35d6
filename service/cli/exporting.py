"""`lagid export`: the identified model of a run as a file for other programs."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from service.cli.common import DEFAULT_URL, Key, Url, connected, fail, out
from service.cli.places import Places, told_at

PLACES = Places({"?format": "--format", "?pade_order": "--pade-order"})


def export(
    run: Annotated[str, typer.Argument(metavar="RUN", help="Id of a run.")],
    format: Annotated[
        Literal["json", "python", "c", "control"],
        typer.Option(help="JSON document, Python or C99 source, or a script for python-control."),
    ] = "json",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write; without it to stdout.")
    ] = None,
    pade_order: Annotated[
        int, typer.Option(min=1, max=20, help="Of the dead times' approximation in control.")
    ] = 3,
    url: Url = DEFAULT_URL,
    key: Key = None,
) -> None:
    """Write the identified model of a run for another program."""
    with connected(url, key) as client, told_at(PLACES):
        text = client.export(run, format, pade_order)
    if output is None:
        typer.echo(text, nl=False)
        return
    try:
        output.write_text(text, encoding="utf-8")
    except OSError as error:
        fail(f"{output} cannot be written: {error.strerror}")
    out.print(str(output), markup=False)
