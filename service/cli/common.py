"""Shared parts of the commands: options, consoles, tables, and one-line errors.

A server reports faults at pointers into the body. Here they are reported where the user typed:
at an option or in a file.
"""

import inspect
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import wraps
from math import isfinite
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.table import Table

from service.client.calls import DEFAULT_URL, NotFinite, ProblemError
from service.core.bodies.text_checks import escape_controls
from service.core.bodies.user_documents import parse_yaml
from service.core.errors import FieldError, InvalidRequest
from service.core.label_text import format_value
from sysid.core.errors import join_pointer, split_pointer
from sysid.core.files import open_replacement
from sysid.core.text import (
    DASH,
    plain_estimate,
    plain_interval,
    rewrite_settings,
    split_estimate,
)

if TYPE_CHECKING:
    from service.client.client import Client


Document = Mapping[str, Any]
"""An answer of the server."""
MODEL_SUFFIXES = (".yaml", ".yml", ".json")
PIPE_WIDTH = 200  # in a pipe or a file, lines are not folded at 80 columns
STANDARD_INPUT = Path("-")
LISTED_ENTRIES = 50
"""Entries of a table, if the user names no other number."""
COUNTED_ENTRIES = 500
"""Entries beyond those shown that are counted."""


class PlainConsole(Console):  # type: ignore[misc]  # rich's types are not read
    """Console that shows control characters as codes: names and labels come from others."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print texts and tables; a terminal obeys nothing in a text."""
        plain = (escape_controls(o, but="\n") if isinstance(o, str) else o for o in objects)
        super().print(*plain, **options)


out = PlainConsole(highlight=False, width=None if sys.stdout.isatty() else PIPE_WIDTH)
err = PlainConsole(stderr=True, highlight=False, soft_wrap=True)
"""For notes and progress; ``--quiet`` silences it."""
_errors = PlainConsole(stderr=True, highlight=False, soft_wrap=True)


def _silence_notes(context: typer.Context, is_quiet: bool) -> bool:
    if is_quiet:
        err.quiet = True
        context.call_on_close(_restore_notes)
    return is_quiet


def _restore_notes() -> None:
    err.quiet = False


def complete_model_name(incomplete: str) -> list[str]:
    """List the built-in models that a shell may complete a name to; files are its own task."""
    from sysid.models.catalogue.load import catalogue

    return [name for name in catalogue() if name.startswith(incomplete)]


ModelName = Annotated[
    str,
    typer.Option(
        "--model",
        help="Built-in model (`lagid models` lists them), or the YAML file of your own.",
        autocompletion=complete_model_name,
    ),
]
DOCUMENT_HELP = "YAML or JSON file with the body of the request; - for standard input."
SERVER_PANEL, OUTPUT_PANEL = "Server", "Output"
Url = Annotated[
    str,
    typer.Option(
        "--url", envvar="LAGID_URL", help="Address of the server.", rich_help_panel=SERVER_PANEL
    ),
]
Key = Annotated[
    str | None,
    typer.Option(
        "--key",
        envvar=["LAGID_API_KEY", "LAGID_KEY"],
        help="API key.",
        show_default=False,
        rich_help_panel=SERVER_PANEL,
    ),
]
Segments = Annotated[
    str | None,
    typer.Option(help="Columns of labels that divide the rows into experiments: run,repeat."),
]
SampleTime = Annotated[
    float | None, typer.Option(help="Sampling period in s, for a file without a time column.")
]
Columns = Annotated[
    str | None,
    typer.Option(
        metavar="NAME,…",
        help="Names of the columns of a file without a header: t,u,,y. A column with an empty "
        "name is left out.",
    ),
]
Missing = Annotated[
    str | None,
    typer.Option(
        metavar="MARKER,…",
        help="Words and numbers that mark bad data: -9999,Offline. none: no number does. By "
        "default words such as Bad do, and numbers such as -9999 that stand apart.",
    ),
]
Exclude = Annotated[
    str | None,
    typer.Option(
        metavar="RANGE,…",
        help="Times (s), values or words to leave out: t=100:200,flow=90:,state=Bad. What follows "
        "rows that are cut out is an experiment of its own.",
    ),
]
McapClock = Annotated[
    str | None,
    typer.Option(
        "--clock",
        metavar="[log|publish|stamp]",
        help="Times of an MCAP file: when a message was logged (default) or sent, or the stamp in "
        "its header.",
    ),
]
DATA_HELP = "Recording: text (CSV), Excel, Parquet, NumPy, MATLAB or MCAP; - for standard input."
AsJson = Annotated[
    bool,
    typer.Option("--json", help="Print JSON on standard output.", rich_help_panel=OUTPUT_PANEL),
]
Quiet = Annotated[
    bool,
    typer.Option(
        "--quiet",
        "-q",
        callback=_silence_notes,
        help="Print results and errors only: no progress, no notes.",
        rich_help_panel=OUTPUT_PANEL,
    ),
]
"""Takes effect by its callback; a command need not look at its value."""
Limit = Annotated[
    int | None,
    typer.Option(
        "--limit",
        "-n",
        min=0,
        help=f"Most entries, 0 for all (default: {LISTED_ENTRIES}; with --json all).",
        show_default=False,
        rich_help_panel=OUTPUT_PANEL,
    ),
]
Force = Annotated[
    bool,
    typer.Option("--force", "-f", help="Overwrite what is there.", rich_help_panel=OUTPUT_PANEL),
]


def show_examples(*commands: str) -> str:
    """Return the end of a command's help: examples that can be copied."""
    lines = (f"[dim]$[/] {command.replace('[', chr(92) + '[')}" for command in commands)
    return "\n\n".join(("[bold]Examples[/]", *lines))


@contextmanager
def connect_client(url: str, key: str | None = None) -> "Iterator[Client]":
    """Open a client until the command ends."""
    from service.client.client import Client  # a late import: other commands start faster

    with Client(url, key) as client:
        yield client


_SHARED_OPTIONS = {
    "url": (Url, DEFAULT_URL),
    "key": (Key, None),
    "as_json": (AsJson, False),
    "quiet": (Quiet, False),
}


def server_command(
    show: Callable[[Any], None] | None = None,
) -> Callable[[Callable[..., Any]], Callable[..., None]]:
    """Make a command of a function that asks a server: ``--url``, ``--key``, ``--json``, ``-q``.

    The function takes a client and its own options, and returns what the server answered. That is
    printed as JSON, or by `show` for people. A function that prints by itself returns None, and
    takes `as_json` where it needs that. One without either has no ``--json``.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., None]:
        signature = inspect.signature(function)
        takes_json = "as_json" in signature.parameters
        own = [p for p in signature.parameters.values() if p.name not in ("client", "as_json")]
        shared = [
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind
            )
            for name, (kind, default) in _SHARED_OPTIONS.items()
            if name != "as_json" or takes_json or show is not None
        ]

        @wraps(function)
        def run_command(url: str, key: str | None, quiet: bool, **options: Any) -> None:
            as_json = options.get("as_json", False)
            if not takes_json:
                options.pop("as_json", None)
            with connect_client(url, key) as client:
                answer = function(client, **options)
                if answer is not None:
                    (print_json if as_json or show is None else show)(answer)

        parameters = [*own, *shared]
        # Typer reads the options of a command from these two.
        run_command.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        run_command.__annotations__ = {p.name: p.annotation for p in parameters}
        return run_command

    return decorate


def fail(message: str, code: int = 1) -> NoReturn:
    """End the command with one readable line on stderr."""
    print_error(message)
    raise typer.Exit(code)


def print_error(message: str) -> None:
    """Print an error as one line on stderr."""
    _errors.print(f"lagid: {' '.join(message.split())}", markup=False)


def check_succeeded(job: Mapping[str, Any]) -> None:
    """End the command with the reason if a finished job has no result; tell of failed runs."""
    if job["state"] == "incomplete":
        print_error(f"{job['id']}: {job['error']}")
    elif job["state"] != "succeeded":
        reason = f": {job['error']}" if job["error"] else ""
        fail(f"{job['id']} {job['state']}{reason}")


def fail_usage(message: str) -> NoReturn:
    """End the command with exit code 2: it was called with wrong arguments."""
    fail(message, 2)


def split_setting_path(change: str) -> list[str]:
    """Split the path of a ``--set path=value`` at its dots; end the command if it has no ``=``."""
    path, equals, value = change.partition("=")
    if not equals:
        fail_usage(f"--set {change}: need path=value, such as algorithm.population=100")
    parts = [part for part in path.replace("/", ".").split(".") if part]
    if parts[:1] == ["initial"] and len(parts) > 1:
        fail_usage(f"--set {change}: {_advise_start(parts[1], parts[2:], value)}")
    return parts


def _advise_start(state: str, fields: Sequence[str], value: str) -> str:
    """Return what sets the start of a state: its parameter, or the document of the model."""
    document = "write it into the model's document, which lagid models show prints"
    given = parse_yaml(value.encode())
    if not fields and not isinstance(given, int | float | Mapping):
        return f"no option sets how one state starts; {document}"
    if not fields and not isinstance(given, Mapping):
        fields = ["fixed"]
    wanted = ".".join(["parameters", f"{state.removesuffix('(0)')}(0)", *fields])
    return (
        f"a start value that is searched is a parameter: --set '{wanted}={value}'. If the model "
        f"does not search it, add --set initial=free, or {document}"
    )


def apply_setting(body: dict[str, Any], change: str) -> None:
    """Set the value of a ``--set path=value`` in a body; the value is read as YAML."""
    parts, target = split_setting_path(change), body
    for part in parts[:-1]:
        target = target.setdefault(part, {})
        if not isinstance(target, dict):
            fail_usage(f"--set {change}: {part} has no fields")
    target[parts[-1] if parts else ""] = parse_yaml(change.partition("=")[2].encode())


def print_json(value: Any) -> None:
    """Print a value as JSON, without styles or folding."""
    out.print(json.dumps(value, indent=2, ensure_ascii=False), markup=False, soft_wrap=True)


def print_line(text: str) -> None:
    """Print a line without styles or folding."""
    out.print(text, markup=False, soft_wrap=True)


def print_note(text: str) -> None:
    """Print a note among the results; ``--quiet`` hides it."""
    if not err.quiet:
        print_line(f"note: {text}")


def print_job(job: Mapping[str, Any]) -> None:
    """Print a submitted job."""
    n_runs = job["progress"]["runs"]
    runs = f"{n_runs} runs, " if n_runs > 1 else ""
    print_line(f"{job['id']}  {job['name']}: {runs}{job['state']}")


def print_table(
    headings: Sequence[str], rows: Iterable[Sequence[object]], *, empty: str, title: str = ""
) -> None:
    """Print rows under headings; a heading that begins with ``>`` is right-aligned."""
    table = Table(title=title or None, box=None, pad_edge=False, title_justify="left")
    for number, heading in enumerate(headings):
        table.add_column(
            format_cell(heading.removeprefix(">")),
            justify="right" if heading.startswith(">") else "left",
            overflow="fold",
            no_wrap=number == 0,
        )
    for row in rows:
        table.add_row(*(format_cell(value) for value in row))
    if table.row_count:
        out.print(table)
    else:
        out.print(empty)


@dataclass(frozen=True, slots=True)
class Listing:
    """Entries of a list on the server that are shown, and how many more there are.

    Attributes
    ----------
    entries : list of dict
    more : int
    has_more_than_counted : bool
        Whether `more` is where counting stopped.
    """

    entries: Sequence[Mapping[str, Any]]
    more: int = 0
    has_more_than_counted: bool = False

    def describe_rest(self) -> str | None:
        """Describe what is not shown, in one line; None if all is."""
        if not self.more:
            return None
        count = f"{self.more} or more others" if self.has_more_than_counted else f"{self.more} more"
        return f"… and {count}; --limit 0 lists all"


def fetch_listing(
    fetch: Callable[[int | None], Sequence[Mapping[str, Any]]], limit: int | None, as_json: bool
) -> Listing:
    """Fetch the entries of a list that ``--limit`` asks for.

    Parameters
    ----------
    fetch : callable
        Returns at most so many entries; all for None.
    limit : int or None
        None: `LISTED_ENTRIES` for a table, all for JSON. 0: all.
    """
    most = limit if limit is not None or as_json else LISTED_ENTRIES
    if not most:
        return Listing(fetch(None))
    entries = fetch(most + COUNTED_ENTRIES)
    more = max(0, len(entries) - most)
    return Listing(entries[:most], more, more == COUNTED_ENTRIES)


def print_listing(
    listing: Listing,
    as_json: bool,
    headings: Sequence[str],
    row: Callable[[Mapping[str, Any]], Sequence[object]],
    *,
    empty: str,
) -> None:
    """Print a server's listing as JSON, or as a table with one `row` per entry."""
    if as_json:
        print_json(listing.entries)
    else:
        print_table(headings, map(row, listing.entries), empty=empty)
    print_rest(listing, as_json)


def print_rest(listing: Listing, as_json: bool) -> None:
    """Print how many entries are not shown; beside JSON on stderr."""
    rest = listing.describe_rest()
    if rest is not None and as_json:
        err.print(rest, markup=False)
    elif rest is not None:
        print_line(rest)


def format_cell(value: object) -> str:
    """Format a cell: a dash for None, six digits for a number."""
    if value is None:
        return DASH
    return escape_controls(format_value(value)).replace("[", "\\[")


def format_estimate(estimate: Mapping[str, Any]) -> str:
    """Format an estimate, ``0.1193 ± 0.0004``, from an entry of a run's parameters."""
    status = str(estimate.get("status", ""))
    return plain_estimate(estimate["value"], estimate["stderr"], status=status)


ESTIMATE_HEADINGS = ("parameter", ">estimate", "95 % interval", ">standard error", "unit", "status")
"""Columns of a table of estimates: those of `sysid.results.summary`."""


def list_estimate_cells(estimate: Mapping[str, Any]) -> tuple[str, ...]:
    """List what is shown of an estimate under `ESTIMATE_HEADINGS`."""
    stderr, status = estimate["stderr"], str(estimate["status"])
    value, error = split_estimate(estimate["value"], stderr, status=status)
    interval = plain_interval(
        estimate["interval95"], stderr, status=status, open_ends=estimate["open_ends"]
    )
    shown = (value, interval or DASH, error or DASH)
    return estimate["name"], *shown, estimate["unit"], status


def read_file(path: Path) -> bytes:
    """Read a file that the user names, or standard input for ``-``; end the command on failure."""
    try:
        return sys.stdin.buffer.read() if path == STANDARD_INPUT else path.read_bytes()
    except OSError as error:
        fail(f"{name_file(path)} cannot be read: {error.strerror}")


def check_file(path: Path) -> None:
    """End the command if a file that the user names is none."""
    if path != STANDARD_INPUT and not path.is_file():
        fail(f"{path} is a folder; name a file" if path.is_dir() else f"there is no file {path}")


def name_file(path: Path) -> str:
    """Name a file in a message."""
    return "standard input" if path == STANDARD_INPUT else str(path)


def read_document(path: Path) -> Any:
    """Parse a YAML or JSON file; end the command if this fails."""
    try:
        return parse_yaml(read_file(path))
    except InvalidRequest as error:
        fail(f"{name_file(path)}: {error}")


def read_object(path: Path, form: str = "an object (name: value)") -> dict[str, Any]:
    """Read an object from a YAML or JSON file; end the command if it holds something else."""
    document = read_document(path)
    if not isinstance(document, dict):
        fail(f"{name_file(path)} does not hold {form}")
    return document


def read_model(name: str) -> Any:
    """Return a model as a body needs it: its document if the name is a file, else its name."""
    return read_document(Path(name)) if name.endswith(MODEL_SUFFIXES) else name


def write_file(path: Path, text: str) -> None:
    """Write a file that the user names; end the command if this fails."""
    with replace_file(path) as stream:
        stream.write(text.encode())


@contextmanager
def replace_file(path: Path) -> Iterator[IO[bytes]]:
    """Open a file that takes the place of one that the user names, which stays whole till then.

    End the command if it cannot be written.
    """
    try:
        with open_replacement(path) as stream:
            yield stream
    except OSError as error:
        fail(f"{path} cannot be written: {error.strerror}")


def protect_file(path: Path | None, force: bool, option: str = "--output") -> None:
    """Ask before a file is overwritten; end the command where nobody can answer.

    This is done before the work, so that nothing is computed in vain. `option` names the file.
    """
    if path is None:
        return
    if path.is_dir():
        fail_usage(f"{option} {path}: this is a folder; name a file")
    if not path.parent.is_dir():
        fail_usage(f"{option} {path}: there is no folder {path.parent}")
    if not force and path.is_file():
        ask_to_go_on(
            f"{path} exists. Overwrite it?",
            f"{path} exists, and nothing was written. Add --force, or name another by {option}",
        )


def ask_to_go_on(question: str, refusal: str) -> None:
    """Ask on the terminal; end the command at a no, and with `refusal` where there is none."""
    if not sys.stdin.isatty():
        fail(refusal)
    if not typer.confirm(question, err=True):
        raise typer.Exit(1)


def split_names(text: str | None) -> list[str]:
    """Split names at commas."""
    return [name.strip() for name in (text or "").split(",") if name.strip()]


def parse_pairs(option: str, texts: Iterable[str], form: str = "NAME=VALUE") -> dict[str, str]:
    """Parse texts of the form ``name=value``; end the command if one has another form."""
    pairs = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (equals and name and value):
            fail_usage(f"{option} {text}: need {form}")
        pairs[name] = value
    return pairs


def parse_channels(text: str | None) -> dict[str, str]:
    """Parse the channel of each signal from ``u=P1,y=P2``."""
    return parse_pairs("--channels", split_names(text), "signal=channel, such as u=P1")


def parse_number(argument: str, text: str) -> float:
    """Parse a finite number; end the command if the text at this place is none."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        fail_usage(f"{argument}: found {text!r}; need a number")
    return value


def format_moment(text: str) -> str:
    """Format a time stamp to the second, ``2026-01-31 12:00:00``."""
    return text[:19].replace("T", " ")


def format_decimals(value: float | None) -> str | None:
    """Format a number with two decimals; None stays None."""
    return None if value is None else f"{value:.2f}"


INVALID_STATUS = 422
UPLOAD_OPTIONS = {
    f"?{name}": f"--{name.replace('_', '-')}"
    for name in ("name", "segments", "sample_time", "columns", "missing", "exclude", "clock")
}
POINTER_PATTERN = re.compile(r"(?<=; there is )/\S+|^/[^ :]+(?=: )")
"""Pointers in a message: to a field of that name elsewhere, or to a fault in an axis value."""


@dataclass(frozen=True, slots=True)
class FieldOrigins:
    """Origins of the fields of a body: the options or files where the user typed them.

    Attributes
    ----------
    options : mapping
        Pointer of a field → the option that sets it. ``{}`` at the end stands for the name below
        the field: ``/truth/parameters/K`` is ``--true K``. ``…`` at the end stands for the rest of
        the pointer, which is a place in a file.
    rest : str
        The same for all other fields; in ``--set {}`` the braces stand for the whole path.
    """

    options: Mapping[str, str] = field(default_factory=dict)
    rest: str = "--set {}"

    def locate(self, pointer: str) -> str:
        """Return the option or file where the field of a pointer was typed."""
        for above in _iterate_parents(pointer):
            if above in self.options:
                return _format_option(self.options[above], pointer.removeprefix(above))
        return _format_option(self.rest, pointer, is_whole=True)

    @property
    def file(self) -> str:
        """The file that the whole body was read from; empty if options made it."""
        return "" if "{}" in self.rest else self.rest.removesuffix(" …")

    def describe_faults(self, faults: Iterable[FieldError]) -> str:
        """Describe faults in one line."""
        return "; ".join(self._describe_fault(fault) for fault in faults)

    def rewrite_note(self, note: str) -> str:
        """Rewrite a note so that it names options instead of job fields."""
        return rewrite_settings(note, self._format_setting)

    def _format_setting(self, place: Sequence[str], entries: Mapping[str, str]) -> str:
        origins = {
            self.locate(join_pointer(*place, name)): value for name, value in entries.items()
        }
        return " ".join(
            f"{origin}{'=' if origin.startswith('--set ') else ' '}{value}"
            for origin, value in origins.items()
        )

    def _describe_fault(self, fault: FieldError) -> str:
        origin = self.locate(fault.pointer) if fault.pointer else self.file
        column = "" if fault.column is None else f", column {fault.column}"
        detail = fault.detail
        if not self.rest.endswith("…"):
            detail = POINTER_PATTERN.sub(lambda match: self.locate(match[0]), detail)
        if fault.option is not None:  # the detail ends with advice that names it
            before, _, after = detail.rpartition(fault.option)
            detail = before + UPLOAD_OPTIONS.get(f"?{fault.option}", fault.option) + after
        return f"{origin}{column}: {detail}" if origin else detail


def file_origins(path: Path, options: Mapping[str, str] | None = None) -> FieldOrigins:
    """Return the origins of a body that is read from a file, except fields that options set."""
    return FieldOrigins(options or {}, rest=f"{name_file(path)} …")


def upload_origins(path: Path) -> FieldOrigins:
    """Return the origins of an upload: options, and the file for all faults in it."""
    return FieldOrigins(UPLOAD_OPTIONS, rest=name_file(path))


@contextmanager
def report_faults(origins: FieldOrigins) -> Iterator[None]:
    """End the command with the server's faults, reported where the user typed."""
    try:
        yield
    except NotFinite as error:
        fail(f"{origins.locate(error.pointer)}: {error.reason}", 2)
    except ProblemError as error:
        entries = error.document.get("errors") or ()
        if error.status != INVALID_STATUS or not entries:
            raise
        fail(
            origins.describe_faults(
                FieldError(
                    str(entry.get("pointer") or ""),
                    str(entry.get("detail")),
                    entry.get("column"),
                    entry.get("option"),
                )
                for entry in entries
            )
        )


def _iterate_parents(pointer: str) -> Iterator[str]:
    """Yield a pointer and its parents, longest first."""
    while pointer:
        yield pointer
        pointer = pointer.rpartition("/")[0]


def _format_option(option: str, below: str, *, is_whole: bool = False) -> str:
    parts = split_pointer(below)
    if option.endswith("…"):
        return option.replace(" …", f": {below}" if below else "")
    name = ".".join(parts) if is_whole else "".join(parts[:1])
    return option.replace("{}", name).rstrip()
