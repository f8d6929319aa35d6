"""`lagid models`: list, show, check and add models."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli import common
from service.cli.common import (
    AsJson,
    Document,
    Key,
    Limit,
    Listing,
    complete_model_name,
    err,
    fail_usage,
    fetch_listing,
    file_origins,
    name_file,
    out,
    print_json,
    print_line,
    print_listing,
    read_file,
    read_object,
    report_faults,
    server_command,
    show_examples,
)
from service.cli.item_commands import (
    NamePart,
    Since,
    TagFilter,
    Until,
    add_item_commands,
    read_filters,
)
from service.core.bodies.user_documents import parse_yaml
from service.core.errors import InvalidRequest

if TYPE_CHECKING:
    from service.client.client import Client

app = typer.Typer(help="List, show, check and add models.", invoke_without_command=True)

ModelFile = Annotated[
    Path, typer.Argument(help="Model document, YAML or JSON; - for standard input.")
]


@app.callback()
def list_by_default(context: typer.Context) -> None:
    """Built-in models and your own; without a command, list the built-in ones."""
    if context.invoked_subcommand is None:
        list_models()


@app.command(
    "list",
    epilog=show_examples("lagid models list", "lagid models list --url http://127.0.0.1:8000"),
)
def list_models(
    url: Annotated[
        str | None,
        typer.Option("--url", envvar="LAGID_URL", help="Include the models of this server."),
    ] = None,
    name: NamePart = None,
    tag: TagFilter = None,
    since: Since = None,
    until: Until = None,
    key: Key = None,
    limit: Limit = None,
    as_json: AsJson = False,
) -> None:
    """List built-in models; with --url also those of a server, whose tags and times are known."""
    filters = read_filters(name=name, tag=tag, since=since, until=until)
    if url is None:
        if tag or since or until:
            fail_usage("--tag, --since and --until need --url: built-in models have none")
        part = (name or "").lower()
        built_in = [model for model in _list_builtin_models() if part in model["name"]]
        listing = Listing(built_in[: limit or None], len(built_in[limit:]) if limit else 0)
    else:
        with common.connect_client(url, key) as client:
            listing = fetch_listing(lambda most: client.models(most, **filters), limit, as_json)
    print_listing(
        listing,
        as_json,
        ("name", ">version", "form", "inputs", "outputs", "parameters", "title"),
        lambda model: (
            model["name"],
            model["version"] or "built in",
            model["form"],
            ", ".join(model["inputs"]),
            ", ".join(model["outputs"]),
            ", ".join(model["parameters"]),
            model["title"],
        ),
        empty="no models",
    )


@app.command(
    "show", epilog=show_examples("lagid models show tube > mine.yaml", "lagid models show mine@2")
)
def show_model(
    name: Annotated[
        str,
        typer.Argument(
            help="Name, or name@version of your own model.", autocompletion=complete_model_name
        ),
    ],
    url: Annotated[
        str | None, typer.Option("--url", envvar="LAGID_URL", help="Server of your own models.")
    ] = None,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Print a model's document as YAML, to copy and change."""
    import yaml

    from sysid.models.catalogue import load

    document: Mapping[str, Any]
    if url is None or name in load.catalogue():
        document = dict(load.copy_catalogue_document(name))
    else:
        with common.connect_client(url, key) as client:
            document = client.model(name)["document"] or {}
    if as_json:
        print_json(document)
        return
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=100)
    out.print(text, markup=False, soft_wrap=True, end="")


@app.command(
    "check",
    epilog=show_examples("lagid models check mine.yaml", "lagid models check - < mine.yaml"),
)
def check_model(
    file: ModelFile,
    as_json: AsJson = False,
) -> None:
    """Check a model document; each error has its place and, in equations, its column.

    Warnings name what is declared but used nowhere.
    """
    from service.models.catalogue import check_model as checked

    try:
        answer = checked(parse_yaml(read_file(file))).model_dump(mode="json")
    except InvalidRequest as error:
        answer = {"valid": False, "errors": [fault.to_dict() for fault in error.errors]}
    if as_json:
        print_json(answer)
    elif answer["valid"]:
        _print_faults(file, answer["warnings"], "warning: ")
        out.print(f"{name_file(file)}: the model is valid", markup=False)
    else:
        _print_faults(file, answer["errors"])
    if not answer["valid"]:
        raise typer.Exit(1)


def _print_faults(file: Path, faults: list[dict[str, Any]], kind: str = "") -> None:
    for fault in faults:
        column = f", column {fault['column']}" if fault.get("column") else ""
        where = f"{fault['pointer'] or 'document'}{column}"
        err.print(f"{name_file(file)}: {where}: {kind}{fault['detail']}", markup=False)


@app.command(
    "add", epilog=show_examples("lagid models add mine.yaml", "lagid models add - < mine.yaml")
)
@server_command(lambda stored: print_line(f"{stored['name']}@{stored['version']}"))
def add_model(client: "Client", file: ModelFile) -> Document:
    """Store your own model on a server."""
    document = read_object(file, "a model (name, equations, …)")
    with report_faults(file_origins(file)):
        return client.add_model(document)


def _list_builtin_models() -> list[dict[str, Any]]:
    from service.models.catalogue import list_catalogue

    return [model.model_dump(mode="json") for model in list_catalogue()]


add_item_commands(app, "lagid models", "model", "mine", has_name=False)
