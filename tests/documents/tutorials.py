"""Tutorials are programs: their blocks run in order, and their outputs are what these print.

A page is Markdown. ``python`` blocks share their names, and a ``text`` block right behind one is
what it prints. A ``console`` block has commands behind ``$`` and what they print. A ``yaml`` block
that begins with ``# NAME.yaml`` is a file. A picture right behind a ``python`` block is the figure
that its last line gives. ``python -m tests.documents.tutorials`` writes outputs and pictures anew.
"""

import ast
import io
import os
import re
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
import warnings
from collections.abc import Callable, Iterator
from contextlib import chdir, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from service.pages.documentation.guides import list_notebooks
from tests.documents.painter import open_painter
from tests.support.checkout import ROOT

WIDTH = 100
SHOWN_ADDRESS, SHOWN_FOLDER = "127.0.0.1:8000", "/home/anna/lab"
START_SECONDS, COMMAND_SECONDS = 120.0, 240.0
BLOCK = re.compile(
    r"^```(?P<kind>\w+)\n(?P<text>.*?)^```\n|^!\[[^\]]*\]\((?P<picture>\S+)\)\n", re.M | re.S
)
VARYING = (
    (re.compile(r"\b\d+ simulations in [\d.]+ s"), "# simulations in # s"),
    (re.compile(r"\b\d+ of \d+ independent starts"), "# of # independent starts"),
    (re.compile(r"\b([a-z]+)_[0-9a-hjkmnp-tv-z]{26}\b"), r"\1"),
    (re.compile(r"\b\d{4}-\d\d-\d\d[ T]\d\d:\d\d(:\d\d(\.\d+)?)?Z?"), "DATE"),
    (re.compile(r"\b[\d.]+ (s|min|h)( ago)?$", re.M), "AGE"),
)
"""Parts of an output that differ from run to run or from machine to machine."""
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
RELATIVE, ABSOLUTE = 0.02, 2e-3
"""How far a printed number may be from that of the page; other processors round differently."""


@dataclass(frozen=True, slots=True)
class Output:
    """What a block of a page prints, as written there and as seen now."""

    written: str
    seen: str

    @property
    def agrees(self) -> bool:
        """Whether both are the same, apart from what varies and the last digits of numbers."""
        pages = [_mask(self.written), _mask(self.seen)]
        if len({NUMBER.sub("#", " ".join(page.split())) for page in pages}) > 1:
            return False
        old, new = ([float(one) for one in NUMBER.findall(page)] for page in pages)
        return all(
            abs(b - a) <= ABSOLUTE + RELATIVE * abs(a) for a, b in zip(old, new, strict=True)
        )


def list_tutorials() -> list[Path]:
    """List the pages with blocks that run, by name: those that are notebooks, too."""
    return sorted(list_notebooks().values())


def check_page(page: Path) -> list[Output]:
    """Run the blocks of a page; list the outputs that are not those of the page."""
    outputs: list[Output] = []
    _run_page(page.read_text(encoding="utf-8"), outputs.append, lambda path, figure: None)
    return [one for one in outputs if not one.agrees]


def write_page(page: Path, draw: Callable[[Path, Any], None]) -> None:
    """Run the blocks of a page, and write what they print and draw."""
    outputs: list[Output] = []
    text = page.read_text(encoding="utf-8")

    def draw_beside(path: str, figure: Any) -> None:
        draw(page.parent / path, figure)

    written = _run_page(text, outputs.append, draw_beside)
    if not all(one.agrees for one in outputs):
        page.write_text(written, encoding="utf-8")


def _run_page(text: str, note: Callable[[Output], None], draw: Callable[[str, Any], None]) -> str:
    """Run the blocks of a page in an empty folder; give the page with what they print."""
    parts: list[str] = []
    end, printed, value = 0, "", None
    with TemporaryDirectory(prefix="lagid-") as folder, chdir(folder), Shell() as shell:
        names: dict[str, Any] = {}
        for block in BLOCK.finditer(text):
            parts.append(text[end : block.start()])
            end, source = block.end(), block["text"]
            follows = not parts[-1].strip()
            match block["kind"]:
                case None if follows and value is not None:
                    draw(block["picture"], value)
                case "text" if follows:
                    note(Output(source, printed))
                    parts.append(f"```text\n{printed}```\n")
                    continue
                case "python":
                    printed, value = run_cell(source, names)
                case "console":
                    seen = "".join(f"{each}{shell.run(each)}" for each in _list_commands(source))
                    note(Output(source, seen))
                    parts.append(f"```console\n{seen}```\n")
                    continue
                case "yaml" if name := re.match(r"# (\S+\.yaml)\n", source):
                    Path(name[1]).write_text(source, encoding="utf-8")
            parts.append(block[0])
    return "".join([*parts, text[end:]])


def run_cell(source: str, names: dict[str, Any]) -> tuple[str, Any]:
    """Run a cell as a notebook does; gives what it prints and the value of its last line."""
    *body, last = ast.parse(source).body
    value, printed = None, io.StringIO()
    with redirect_stdout(printed), warnings.catch_warnings(action="ignore"):
        if not isinstance(last, ast.Expr):
            body.append(last)
        exec(compile(ast.Module(body, []), "cell", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
            if value is not None and not hasattr(value, "to_plotly_json"):
                printed.write(f"{value!r}\n")
    return printed.getvalue(), value


def _list_commands(source: str) -> Iterator[str]:
    """List the commands of a block, each with its ``$`` and the lines that go on."""
    yield from re.findall(r"^\$ (?:.*\\\n)*.*\n", source, re.M)


def find_free_port() -> int:
    """Find a port for a service of a page."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


class Shell:
    """Runs commands of a page; what they start behind ``&`` ends with the page."""

    def __init__(self) -> None:
        self._port = find_free_port()
        self._url = f"http://127.0.0.1:{self._port}"
        self._before = dict(os.environ)
        os.environ["LAGID_URL"] = self._url
        self._started: list[subprocess.Popen[bytes]] = []
        self._environment = {
            **os.environ,
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "COLUMNS": str(WIDTH),
            "NO_COLOR": "1",
            "LAGID_PORT": str(self._port),
            "LAGID_URL": self._url,
        }

    def __enter__(self) -> "Shell":
        return self

    def __exit__(self, *_: object) -> None:
        os.environ.clear()
        os.environ.update(self._before)
        for process in self._started:
            process.terminate()
        for process in self._started:
            process.wait(COMMAND_SECONDS)

    def run(self, command: str) -> str:
        """Carry out a command; give what it prints."""
        words = command.removeprefix("$ ").strip()
        if words.endswith("&"):
            return self._start(words.rstrip("& "))
        done = subprocess.run(
            ["bash", "-c", words],
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=COMMAND_SECONDS,
            check=False,
        )
        printed = done.stdout.replace(str(Path.cwd()), SHOWN_FOLDER)
        printed = printed.replace(f"127.0.0.1:{self._port}", SHOWN_ADDRESS)
        lines = [line.rstrip() for line in printed.splitlines()]
        while lines and not lines[0]:
            lines.pop(0)
        while lines and not lines[-1]:
            lines.pop()
        return "".join(f"{line}\n" for line in lines)

    def _start(self, command: str) -> str:
        quiet = subprocess.DEVNULL
        words = ["bash", "-c", f"exec {command}"]
        process = subprocess.Popen(words, env=self._environment, stdout=quiet, stderr=quiet)
        self._started.append(process)
        limit = time.monotonic() + START_SECONDS
        while time.monotonic() < limit and process.poll() is None:
            try:
                with urllib.request.urlopen(f"{self._url}/readyz"):
                    return ""
            except (urllib.error.URLError, ConnectionError):
                time.sleep(0.2)
        raise RuntimeError(f"{command!r} has not started")


def _mask(text: str) -> str:
    for pattern, words in VARYING:
        text = pattern.sub(words, text)
    return text


def main() -> None:
    """Write the pages that are named, else all."""
    pages = [Path(name).resolve() for name in sys.argv[1:]] or list_tutorials()
    with open_painter() as draw:
        for page in pages:
            write_page(page, draw)


if __name__ == "__main__":
    main()
