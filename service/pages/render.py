"""Files that the pages load: our own, and Plotly out of its installed wheel. Nothing is remote.

Templates with their context: the one environment of pages and reports.

What every report carries inside: the sheet of the pages.
"""

import gzip
import hashlib
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from service.core.text import TEMPLATE_FILTERS
from sysid.core.settings import GeneticAlgorithm

STATIC_FOLDER = Path(__file__).parent / "static"
MEDIA_TYPES = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}


@dataclass(frozen=True, slots=True)
class Asset:
    """A file as it is served."""

    content: bytes
    media_type: str
    etag: str


@cache
def load_asset(name: str) -> Asset | None:
    """One of our own files; None if there is no such file."""
    path = STATIC_FOLDER / name
    if Path(name).name != name or path.suffix not in MEDIA_TYPES or not path.is_file():
        return None
    content = path.read_bytes()
    etag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
    return Asset(content, MEDIA_TYPES[path.suffix], etag)


@cache
def plotly_file_name() -> str:
    """Name under which Plotly is served; it changes with the version, so it may be kept forever."""
    return f"plotly-{version('plotly')}.min.js"


def plotly_path() -> Path:
    """The bundle inside the wheel. The package itself is not imported: that takes long."""
    spec = find_spec("plotly")
    assert spec is not None
    assert spec.submodule_search_locations
    return Path(spec.submodule_search_locations[0]) / "package_data" / "plotly.min.js"


@cache
def compress_plotly() -> bytes:
    """The bundle, compressed once per process."""
    return gzip.compress(plotly_path().read_bytes(), compresslevel=6, mtime=0)


@cache
def template_environment() -> Environment:
    """The templates. Every text of a user is escaped, and a name that is not given is an error."""
    made = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters.update(TEMPLATE_FILTERS)
    made.globals["default_algorithm"] = GeneticAlgorithm()
    made.globals.update(
        static=lambda name: f"/static/{name}", plotly=f"/static/{plotly_file_name()}"
    )
    return made


def render_template(template: str, **context: Any) -> str:
    """A template with its context, as of now."""
    return template_environment().get_template(template).render(now=datetime.now(UTC), **context)


@cache
def load_stylesheet() -> Markup:
    """The sheet of pages and reports."""
    return Markup((STATIC_FOLDER / "lagid.css").read_text(encoding="utf-8"))
