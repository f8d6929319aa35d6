"""The documentation that a server shows: its Markdown pages, as they are in the repository.

A page has the address of its file, so links between pages lead where they lead in the repository.
"""

import re
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.util import find_spec
from pathlib import Path
from posixpath import basename, dirname, join, normpath

from latex2mathml.converter import convert
from markdown_it import MarkdownIt
from markdown_it.token import Token
from markupsafe import Markup

from service.core.errors import NotFound
from service.pages.documentation.notebooks import to_notebook

INDEX = "README.md"
_SITE_ONLY = "index.md"  # its lists are of the site's builder
FILES = (".png", ".json")
NOTEBOOK_FOLDERS = ("tutorials", "howto", "answers", "explanation")
"""Folders whose pages are notebooks, too, if they have code."""


@dataclass(frozen=True, slots=True)
class Guide:
    """A page of the documentation; `html` is its content, `notebook` the name of its notebook."""

    title: str
    html: Markup
    is_index: bool
    notebook: str | None


@cache
def read_guide(path: str) -> Guide:
    """Read a page of the documentation.

    Parameters
    ----------
    path : str
        Of its file, from the folder of the documentation. A folder, whose path ends with one
        slash, lists its pages.

    Raises
    ------
    NotFound
        If there is no such page.
    """
    file = _list_files().get(path)
    if file is not None and file.suffix == ".md":
        text = file.read_text(encoding="utf-8")
    else:
        text = _list_folder(path)
    title = re.search(r"^# (.+)$", text, re.M)
    html = _render(text, path)
    notebook = path.removesuffix(".md") + ".ipynb"
    name = notebook.rpartition("/")[2] if notebook in list_notebooks() else None
    return Guide(title[1] if title else "lagid", Markup(html), path == INDEX, name)


def find_file(path: str) -> Path | None:
    """Find a picture or another file of a page; None if there is none."""
    file = _list_files().get(path)
    return file if file is not None and file.suffix in FILES else None


def make_notebook(path: str) -> str | None:
    """Make the notebook of a page, such as ``tutorials/first_time_lag.ipynb``; None if none is."""
    page = list_notebooks().get(path)
    return None if page is None else to_notebook(page.read_text(encoding="utf-8"))


@cache
def list_notebooks() -> dict[str, Path]:
    """List the pages that are notebooks, too, by the paths of these."""
    return {
        f"{path.removesuffix('.md')}.ipynb": file
        for path, file in _list_files().items()
        if path.startswith(tuple(f"{folder}/" for folder in NOTEBOOK_FOLDERS))
        and file.suffix == ".md"
        and re.search(r"^```(?:python|console)$", file.read_text(encoding="utf-8"), re.M)
    }


def format_formula(latex: str) -> str:
    """Format a ``math`` block of a page, which is LaTeX, as HTML with MathML.

    The converter does not escape the text of a formula, so what HTML would read is refused.

    Raises
    ------
    ValueError
        If the formula has one of the characters <, > and &.

    Examples
    --------
    >>> format_formula("a")  # doctest: +ELLIPSIS
    '<div class="equation" tabindex="0"><math aria-label="a" ...><mrow><mi>a</mi></mrow></math>...'
    """
    if refused := re.search("[<>&]", latex):
        raise ValueError(
            f"the formula {latex.strip()} has {refused[0]}; write \\lt, \\gt or words instead"
        )
    mathml = convert(latex.strip(), display="block")
    label = f'<math aria-label="{escape(latex.strip())}"'
    return f'<div class="equation" tabindex="0">{mathml.replace("<math", label, 1)}</div>\n'


def is_folder(path: str) -> bool:
    """Return whether a path is that of a folder with pages, without the slash at its end."""
    return f"{path}/" in _list_folders()


@cache
def _list_files() -> dict[str, Path]:
    """List pages and files by their paths; only what is listed is ever opened."""
    folder = _find_folder()
    return {
        path.relative_to(folder).as_posix(): path
        for suffix in (".md", *FILES)
        for path in folder.rglob(f"*{suffix}")
        if path.name != _SITE_ONLY
    }


@cache
def _list_folders() -> dict[str, list[str]]:
    """List the pages of each folder, by its path with a slash at its end."""
    folders: dict[str, list[str]] = {}
    for name in sorted(_list_files()):
        if name.endswith(".md") and dirname(name):
            folders.setdefault(f"{dirname(name)}/", []).append(name)
    return folders


def _find_folder() -> Path:
    """Find the documentation: in the installed package, or in the checkout."""
    spec = find_spec("service.guides")
    if spec is not None and spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    return Path(__file__).resolve().parents[3] / "docs"


def _list_folder(path: str) -> str:
    """List the pages of a folder as Markdown, each by its title."""
    pages = _list_folders().get(path)
    if pages is None:
        raise NotFound("page", path)
    lines = [f"* [{read_guide(name).title}]({basename(name)})" for name in pages]
    return "\n".join([f"# {path.rstrip('/').capitalize()}", "", *lines])


def _render(text: str, path: str) -> str:
    parser = MarkdownIt("commonmark").enable("table")
    tokens = parser.parse(text)
    for token, content in zip(tokens, [*tokens[1:], None], strict=True):
        if token.type == "heading_open" and content is not None:
            token.attrs["id"] = _name_anchor(content.content)
        if token.type == "fence" and token.info == "math":
            token.type, token.content = "html_block", format_formula(token.content)
        _keep_inside(token.children or [], path)
    html = str(parser.renderer.render(tokens, parser.options, {}))
    # What is wider than the page is scrolled with keys, too.
    html = re.sub("<(pre|table)>", r'<\1 tabindex="0">', html)
    return re.sub(r"<th([^>]*)></th>", r"<td\1></td>", html)  # an empty heading is none


def _name_anchor(heading: str) -> str:
    """Name a heading for links, as forges do."""
    words = re.sub(r"[^\w\- ]", "", heading.lower())
    return words.strip().replace(" ", "-")


def _keep_inside(tokens: list[Token], path: str) -> None:
    """Show links that leave the documentation as their text: a server has no repository."""
    leaves = False
    for token in tokens:
        if token.type == "link_open":
            target = str(token.attrs.get("href", ""))
            leaves = normpath(join(dirname(path), target)).startswith("..")
        if leaves and token.type in ("link_open", "link_close"):
            token.type, token.content = "text", ""
