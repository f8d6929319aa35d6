"""A page of the documentation as a Jupyter notebook: its blocks of code are the cells."""

import json
import re
from collections.abc import Iterator
from typing import Any

from markdown_it import MarkdownIt
from markdown_it.token import Token

_WAIT = "until lagid health web; do sleep 1; done 2> /dev/null"
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!https?://)[^)]*\)")
"""A link to another page, which is not where the notebook is."""


def to_notebook(markdown: str) -> str:
    """Write a page as a notebook without outputs, in the format 4.5 of Jupyter.

    ``python`` blocks are cells. So are ``console`` blocks, whose commands Bash carries out, and
    ``yaml`` blocks that begin with the name of a file, ``# tank.yaml``. What they print and draw
    on the page is left out, as the cell shows it again. All other text stays as it is.

    Examples
    --------
    >>> page = "# Add" + chr(10) + "```python" + chr(10) + "1 + 1" + chr(10) + "```" + chr(10)
    >>> [cell["source"] for cell in json.loads(to_notebook(page))["cells"]]
    ['# Add', '1 + 1']
    """
    cells = [
        {"id": f"cell-{number}", "metadata": {}, **cell}
        for number, cell in enumerate(_list_cells(markdown), 1)
    ]
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook = {
        "cells": cells,
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"


def _list_cells(markdown: str) -> Iterator[dict[str, Any]]:
    lines = markdown.splitlines(keepends=True)
    start, is_behind_code = 0, False
    for token in MarkdownIt("commonmark").parse(markdown):
        if token.type != "fence" or token.map is None:
            continue
        first, end = token.map
        text = "".join(lines[start:first]).strip()
        is_output = token.info == "text" and is_behind_code and not text
        sources = [] if is_output else _list_sources(token)
        if not sources and not is_output:
            continue  # it belongs to the text
        yield from _list_texts(text)
        yield from map(_write_code, sources)
        start, is_behind_code = end, True
    yield from _list_texts("".join(lines[start:]).strip())


def _list_sources(block: Token) -> list[str]:
    """List the cells of a block; none if it is only to be read."""
    match block.info:
        case "python":
            return [block.content]
        case "console":
            commands = re.findall(r"^\$ ((?:.*\\\n)*.*)\n", block.content, re.M)
            return [cell for command in commands for cell in _list_command_cells(command)]
        case "yaml" if name := re.match(r"# (\S+\.yaml)\n", block.content):
            return [f"%%writefile {name[1]}\n{block.content}"]
        case _:
            return []


def _list_command_cells(command: str) -> list[str]:
    """List the cells of a command: a service starts in the background, and is waited for."""
    if command.endswith("&"):
        return [f"%%bash --bg\n{command.rstrip('& ')}", f"%%bash\n{_WAIT}"]
    return [f"%%bash --no-raise-error\n{command}"]  # a page may show a command that fails


def _list_texts(text: str) -> Iterator[dict[str, Any]]:
    """List the text between two cells, without pictures and links to other pages."""
    plain = _LINK.sub(lambda link: f"*{link[1]}*", re.sub(r"^!\[.*\n?", "", text, flags=re.M))
    plain = re.sub(r"^```math\n(.*?)^```", r"$$\n\1$$", plain, flags=re.M | re.S)
    if plain.strip():
        yield {"cell_type": "markdown", "source": plain.strip()}


def _write_code(source: str) -> dict[str, Any]:
    return {
        "cell_type": "code",
        "execution_count": None,
        "outputs": [],
        "source": source.rstrip("\n"),
    }
