"""`lagid references`: runs that were accepted under a name."""

from typing import Annotated, Any

import typer

from service.cli.common import (
    DEFAULT_URL,
    AsJson,
    Key,
    Url,
    connected,
    estimate,
    out,
    print_json,
    print_listing,
    print_table,
)
from service.cli.places import Places, told_at

app = typer.Typer(help="List, show and accept references.", no_args_is_help=True)

PLACES = Places({"/run": "RUN", "/by": "--by", "/note": "--note", "{name}": "NAME"})

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the reference.")]


@app.command("list")
def listing(url: Url = DEFAULT_URL, key: Key = None, as_json: AsJson = False) -> None:
    """List the references in use."""
    with connected(url, key) as client:
        found = client.references()
    print_listing(
        found, as_json, ("name", "run", "accepted", "by", "labels", "estimates"),
        lambda one: (one["name"], one["run"], _when(one["at"]), one["by"], _labels(one["labels"]),
                     _estimates(one["estimates"])),
        empty="no references; accept one: lagid references accept NAME RUN",
    )  # fmt: skip


@app.command()
def show(name: Name, url: Url = DEFAULT_URL, key: Key = None, as_json: AsJson = False) -> None:
    """Show a reference with what was accepted before it."""
    with connected(url, key) as client:
        found = client.reference(name)
    if as_json:
        print_json(found)
        return
    out.print(f"{found['name']}: {_estimates(found['estimates'])}", markup=False)
    if found["labels"]:
        out.print(_labels(found["labels"]), markup=False)
    rows = [(one["run"], _when(one["at"]), one["by"], one["note"])
            for one in (found, *found["history"])]  # fmt: skip
    print_table(("run", "accepted", "by", "note"), rows, empty="")


@app.command()
def accept(
    name: Name,
    run: Annotated[str, typer.Argument(metavar="RUN", help="Id of a run that succeeded.")],
    by: Annotated[str | None, typer.Option(help="Who accepts it.")] = None,
    note: Annotated[str | None, typer.Option(help="Why.")] = None,
    url: Url = DEFAULT_URL,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Make a run the reference of a name; the one before stays in the history."""
    with connected(url, key) as client, told_at(PLACES):
        found = client.accept_reference(name, run, by=by, note=note)
    if as_json:
        print_json(found)
        return
    before = f" (before: {found['history'][0]['run']})" if found["history"] else ""
    out.print(f"{found['name']}: {found['run']}{before}", markup=False)


def _when(at: str) -> str:
    return at[:19].replace("T", " ")


def _labels(labels: dict[str, Any]) -> str:
    return ", ".join(f"{name} = {value}" for name, value in labels.items())


def _estimates(estimates: dict[str, Any]) -> str:
    return ", ".join(f"{name} = {estimate(one)}" for name, one in estimates.items())
