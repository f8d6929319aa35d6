"""Pages of reference that the program knows best: commands, REST, result, catalogue, Python."""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import lagid
from service.pages.documentation.guides import list_notebooks, make_notebook
from sysid.models.catalogue.load import catalogue, copy_catalogue_document, load_model
from sysid.models.equation_display import format_equations
from tests.documents.painter import CHROMIUM, open_painter
from tests.documents.responses import describe_case, draw_response
from tests.support.checkout import ROOT

Document = Mapping[str, Any]
TITLES = {
    "datasets": "Recordings",
    "models": "Models",
    "jobs": "Jobs",
    "runs": "Runs",
    "references": "References",
    "access": "Keys, projects, audit",
    "health": "Health",
}
PROJECT = ("ARCHITECTURE", "CONTRIBUTING", "SECURITY", "CHANGELOG")
"""Pages of the top level of the repository that the site has, too."""
HAS_BROWSER = CHROMIUM.exists()
LIBRARY = ("identify", "simulate", "read_recording", "load_model", "catalogue")


def write_reference(folder: Path) -> None:
    """Write all pages into a folder, those of the top level of the repository, and notebooks."""
    folder.mkdir(exist_ok=True)
    contract = json.loads((ROOT / "docs" / "openapi.json").read_text(encoding="utf-8"))
    pages = {
        "commands": _describe_commands(),
        "rest": "".join(_describe_rest(contract)),
        "result": "".join(_describe_result(contract)),
        "catalogue": "".join(_describe_catalogue()),
        "python": "".join(_describe_python()),
    }
    pages |= {name.lower(): _copy_page(name) for name in PROJECT}
    for name, text in pages.items():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
    _draw_catalogue(folder)
    for path in list_notebooks():
        target = folder / "notebooks" / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(make_notebook(path) or "", encoding="utf-8")


def _copy_page(name: str) -> str:
    """Copy a page of the top level; its links lead to the pages of the site."""
    text = (ROOT / f"{name}.md").read_text(encoding="utf-8")
    text = re.sub(r"\]\(docs/(\w+)/\)", r"](../\1/README.md)", text).replace("](docs/", "](../")
    return follow_top_level(text, "")


def follow_top_level(text: str, folder: str) -> str:
    """Let links to pages of the top level lead to their copies in `folder`."""
    names = "|".join(PROJECT)
    return re.sub(
        rf"\]\((?:\.\./)*({names})\.md", lambda found: f"]({folder}{found[1].lower()}.md", text
    )


def _describe_commands() -> str:
    import typer
    from typer.cli import get_docs_for_click

    from service.cli.main import build_program

    command = typer.main.get_command(build_program())
    _shorten_help(command)
    text = get_docs_for_click(
        obj=command, ctx=typer.Context(command), name="lagid", title="The command line"
    )
    text = re.sub(r"\[bold\](.*?)\[/\]", r"**\1**", text)
    return re.sub(
        r"(?:^\[dim\]\$\[/\] .*\n\n?)+",
        lambda found: "```console\n" + re.sub(r"\[dim\]\$\[/\]", "$", found[0]).strip() + "\n```\n",
        text.replace("&#x27;", "'"),
        flags=re.M,
    )


def _shorten_help(command: Any) -> None:
    """Let a list of commands have the first sentence of each help text, not its first words."""
    for each in getattr(command, "commands", {}).values():
        each.short_help = (each.help or "").partition("\n\n")[0]
        _shorten_help(each)


def _describe_rest(contract: Document) -> Iterator[str]:
    yield (
        "# The REST interface\n\nA running service shows the same at `/docs`, with a form to try "
        "each request. `/openapi.json` is the contract, for programs that generate clients.\n"
    )
    groups: dict[str, list[tuple[str, str, Document]]] = {}
    for path, operations in contract["paths"].items():
        for method, operation in operations.items():
            [group] = operation.get("tags", ["health"])[:1]
            groups.setdefault(group, []).append((method.upper(), path, operation))
    for group, operations in groups.items():
        yield f"\n## {TITLES.get(group, group.capitalize())}\n"
        for method, path, operation in operations:
            yield from _describe_operation(method, path, operation, contract)


def _describe_operation(
    method: str, path: str, operation: Document, contract: Document
) -> Iterator[str]:
    yield f"\n### {method} `{path}`\n\n{operation['description'].strip()}\n"
    if parameters := operation.get("parameters"):
        yield "\n| parameter | in | meaning |\n|---|---|---|\n"
        for each in parameters:
            named = _follow(each, contract)
            text = _as_cell(named.get("description", ""))
            yield f"| `{named['name']}` | {named['in']} | {text} |\n"
    for kind, body in operation.get("requestBody", {}).get("content", {}).items():
        name = _name_schema(body.get("schema", {}))
        yield f"\nBody: `{kind}`" + (f", `{name}`\n" if name else "\n")
        if example := body.get("example"):
            shown = example if isinstance(example, str) else json.dumps(example, indent=2)
            yield f"\n```\n{shown}\n```\n"
    answers = [
        f"{status} `{_name_schema(content.get('schema', {})) or kind}`"
        for status, answer in operation["responses"].items()
        if status < "400"
        for kind, content in _follow(answer, contract).get("content", {}).items()
    ]
    if answers:
        yield f"\nAnswer: {', '.join(answers)}\n"


def _describe_result(contract: Document) -> Iterator[str]:
    yield (
        "# The fields of a result\n\n`GET /v1/runs/RUN` answers with these fields. A file that "
        "`lagid identify --output` writes has those of `result`.\n"
    )
    schemas = contract["components"]["schemas"]
    waiting, seen = ["RunOut"], set[str]()
    while waiting:
        name = waiting.pop(0)
        if name in seen or name not in schemas:
            continue
        seen.add(name)
        schema = schemas[name]
        fields = schema.get("properties", {})
        yield f"\n## {name}\n\n{schema.get('description', '').strip()}\n"
        if fields:
            yield "\n| field | type | meaning |\n|---|---|---|\n"
        for field, described in fields.items():
            inner = list(_list_schemas(described))
            kind = _as_cell(_describe_type(described))
            meaning = _as_cell(described.get("description", ""))
            yield f"| `{field}` | {kind} | {meaning} |\n"
            waiting += inner


def _describe_catalogue() -> Iterator[str]:
    yield (
        "# The catalogue of models\n\n`lagid models show NAME` prints the whole document. Bounds "
        "that are *data* follow from [your recording](../model.md#bounds-from-the-data).\n"
    )
    yield "\n| model | what it describes |\n|---|---|\n"
    for name in catalogue():
        title = copy_catalogue_document(name)["title"]
        yield f"| [`{name}`](#{_name_heading(name, title)}) | {_as_cell(title)} |\n"
    for name in catalogue():
        yield from _describe_model(name)


def _describe_model(name: str) -> Iterator[str]:
    document = copy_catalogue_document(name)
    yield f"\n## {name}: {document['title']}\n\n{document.get('description', '').strip()}\n"
    if source := document.get("source"):
        yield f"\nSource: {source}\n"
    for equation in format_equations(load_model(name)):
        yield f'\n<div class="equation" tabindex="0">{equation.mathml}</div>\n'
    if HAS_BROWSER:
        yield f"\n![Response of {name}](pictures/{name}.svg)\n"
        yield f"\n*With {describe_case(name)}.*\n"
    if parameters := document.get("parameters"):
        yield "\n| parameter | unit | from | to | meaning |\n|---|---|--:|--:|---|\n"
        for parameter, given in parameters.items():
            unit, meaning = given.get("unit", "1"), _as_cell(given.get("description", ""))
            lower, upper = (f"{given[end]:g}" for end in ("lower", "upper"))
            if "bounds" in given:
                lower = upper = "data"
            yield f"| `{parameter}` | {unit} | {lower} | {upper} | {meaning} |\n"


def _name_heading(name: str, title: str) -> str:
    """Name the anchor of the heading of a model."""
    words = re.sub(r"[^\w\- ]", "", f"{name} {title}".lower())
    return words.replace(" ", "-")


def _draw_catalogue(folder: Path) -> None:
    """Draw how each model answers; without a browser the page has no pictures."""
    if not HAS_BROWSER:
        return
    with open_painter() as draw:
        for name in catalogue():
            draw(folder / "pictures" / f"{name}.svg", draw_response(name))


def _describe_python() -> Iterator[str]:
    yield "# The Python library\n\n`import lagid` has all names of this page.\n"
    groups: dict[str, list[str]] = {"Functions": [], "Classes": [], "Errors": []}
    for name in vars(lagid)["__all__"]:
        found = getattr(lagid, name)
        is_error = isinstance(found, type) and issubclass(found, BaseException)
        kind = "Errors" if is_error else "Classes" if isinstance(found, type) else "Functions"
        groups[kind].append(name)
    order = {name: place for place, name in enumerate(LIBRARY)}
    groups["Functions"].sort(key=lambda name: order.get(name, len(order)))
    for title, names in groups.items():
        directive = "autofunction" if title == "Functions" else "autoclass"
        members = "   :members:\n" if title == "Classes" else ""
        yield f"\n## {title}\n"
        for name in names:
            inherited = "   :inherited-members:\n" if name.endswith("Client") else ""
            options = members + inherited
            yield f"\n```{{eval-rst}}\n.. {directive}:: lagid.{name}\n{options}```\n"


def _describe_type(schema: Document) -> str:
    if "anyOf" in schema:
        return " or ".join(_describe_type(one) for one in schema["anyOf"])
    if name := _name_schema(schema):
        return f"[`{name}`](#{name.lower()})"
    if schema.get("type") == "array":
        return f"list of {_describe_type(schema.get('items', {}))}"
    if "const" in schema:
        return f"`{schema['const']}`"
    return str(schema.get("type", "any"))


def _list_schemas(schema: Any) -> Iterator[str]:
    if isinstance(schema, Mapping):
        if name := _name_schema(schema):
            yield name
        for value in schema.values():
            yield from _list_schemas(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from _list_schemas(value)


def _name_schema(schema: Document) -> str:
    return str(schema.get("$ref", "")).rpartition("/")[2]


def _follow(entry: Document, contract: Document) -> Document:
    """Follow the reference of an entry, if it is one."""
    found: Any = contract
    if "$ref" not in entry:
        return entry
    for part in entry["$ref"].removeprefix("#/").split("/"):
        found = found[part]
    return found  # type: ignore[no-any-return]


def _as_cell(text: str) -> str:
    """Write a text into a cell of a table."""
    return " ".join(text.replace("|", "\\|").split())
