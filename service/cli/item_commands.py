"""Commands that all kinds of items have: edit, delete, and the filters of their lists."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from service.cli.common import (
    OUTPUT_PANEL,
    Document,
    ask_to_go_on,
    fail,
    fail_usage,
    print_line,
    server_command,
    show_examples,
)
from service.client.calls import ProblemError

if TYPE_CHECKING:
    from service.client.client import Client

FILTER_PANEL = "Filter"
NamePart = Annotated[
    str | None,
    typer.Option(
        "--name", help="Only those with this in their name.", rich_help_panel=FILTER_PANEL
    ),
]
TagFilter = Annotated[
    list[str] | None,
    typer.Option(
        "--tag", help="Only those with this tag; may be repeated.", rich_help_panel=FILTER_PANEL
    ),
]
LabelFilter = Annotated[
    list[str] | None,
    typer.Option(
        "--label",
        metavar="NAME=VALUE",
        help="Only those with this label; may be repeated.",
        rich_help_panel=FILTER_PANEL,
    ),
]
Since = Annotated[
    str | None,
    typer.Option(
        help="Only those stored from then on, such as 2026-01-31.", rich_help_panel=FILTER_PANEL
    ),
]
Until = Annotated[
    str | None, typer.Option(help="Only those stored before.", rich_help_panel=FILTER_PANEL)
]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask.", rich_help_panel=OUTPUT_PANEL)]
Cascade = Annotated[
    bool, typer.Option("--cascade", help="Also delete everything that was made from it.")
]
EditedNote = Annotated[
    str | None, typer.Option("--note", help="New note; an empty text removes it.")
]
EditedTags = Annotated[
    list[str] | None,
    typer.Option("--tag", help="New tag; may be repeated, and replaces the tags there are."),
]
NoTags = Annotated[bool, typer.Option("--no-tags", help="Remove all tags.")]
Resolve = Callable[["Client", str], str]


def add_item_commands(
    app: typer.Typer,
    words: str,
    kind: str,
    example: str,
    *,
    has_name: bool,
    resolve: Resolve | None = None,
) -> None:
    """Add the commands `edit` and `delete` of a kind of items.

    Parameters
    ----------
    words : str
        Words of the group, such as ``lagid dataset``.
    example : str
        An item for the examples.
    has_name : bool
        Whether the items have names that can be changed.
    resolve : callable, optional
        Returns the identifier of an item that the user names.
    """
    argument = typer.Argument(metavar=kind.upper(), help=f"The {kind}, as lists show it.")

    @server_command(_print_edited)
    def edit(
        client: "Client",
        item: Annotated[str, argument],
        name: Annotated[str | None, typer.Option(help="New name.", hidden=not has_name)] = None,
        note: EditedNote = None,
        tags: EditedTags = None,
        no_tags: NoTags = False,
    ) -> Document:
        changes = _collect_changes(name, note, tags, no_tags)
        identity = resolve(client, item) if resolve else item
        edited: Document = getattr(client, f"edit_{kind}")(identity, changes)
        return edited

    @server_command(_print_deleted)
    def delete(
        client: "Client",
        item: Annotated[str, argument],
        cascade: Cascade = False,
        yes: Yes = False,
    ) -> Document:
        identity = resolve(client, item) if resolve else item
        if not yes:
            others = ", with everything that was made from it" if cascade else ""
            ask_to_go_on(
                f"Delete {kind} {item}{others}?",
                "nothing was deleted, because nobody can answer here; add --yes",
            )
        try:
            deleted: Document = getattr(client, f"delete_{kind}")(identity, cascade=cascade)
        except ProblemError as error:
            _explain_refusal(error)
        return deleted

    edit.__doc__ = f"Change {'name, ' if has_name else ''}note or tags of a {kind}."
    delete.__doc__ = f"Delete a {kind}; what was made from it is listed, and deleted by --cascade."
    changed = f"{words} edit {example}"
    app.command(
        "edit",
        epilog=show_examples(
            f"{changed} --note 'valve stuck' --tag suspect",
            f"{changed} --name 'tube 40 m'" if has_name else f"{changed} --no-tags",
        ),
    )(edit)
    app.command(
        "delete",
        epilog=show_examples(
            f"{words} delete {example}", f"{words} delete {example} --cascade --yes"
        ),
    )(delete)


def read_filters(**values: Any) -> dict[str, Any]:
    """Return the filters of a list that the user gave."""
    return {name: value for name, value in values.items() if value}


def _collect_changes(
    name: str | None, note: str | None, tags: list[str] | None, no_tags: bool
) -> dict[str, Any]:
    if tags and no_tags:
        fail_usage("--tag and --no-tags exclude each other")
    changes: dict[str, Any] = {}
    if name is not None:
        changes["name"] = name
    if note is not None:
        changes["note"] = note or None
    if tags or no_tags:
        changes["tags"] = tags or []
    if not changes:
        fail_usage("nothing to change; need --name, --note, --tag or --no-tags")
    return changes


def _print_edited(answer: Document) -> None:
    tags = f"  [{', '.join(answer['tags'])}]" if answer["tags"] else ""
    note = f"  {answer['note']}" if answer["note"] else ""
    names = [str(answer[field]) for field in ("id", "name") if field in answer]
    print_line(f"{'  '.join(names)}{tags}{note}")


def _print_deleted(answer: Document) -> None:
    for entry in answer["deleted"]:
        print_line(f"deleted {entry['kind']} {entry['id']}  {entry['name']}")


def _explain_refusal(error: ProblemError) -> NoReturn:
    """End the command; the option of the command replaces that of the address."""
    if "dependents" in error.document:
        fail(error.reason.replace("?cascade=true", "--cascade"))
    raise error
