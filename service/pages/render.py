"""Render templates, and load the static files of pages and reports.

The files are the package's own, and bundles from installed wheels. Nothing is loaded from other
servers.
"""

import base64
import gzip
import hashlib
from collections.abc import Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from service.core.label_text import TEMPLATE_FILTERS
from service.core.root_path import get_root_path, to_address
from service.pages.result_filters import RESULT_FILTERS
from sysid.core.settings import GeneticAlgorithm

if TYPE_CHECKING:
    from service.access.callers import Caller

shown_account: "ContextVar[Caller | None]" = ContextVar("shown_account", default=None)
"""Who is signed in, in the head of each page of a request; None shows nothing."""
STATIC_FOLDER = Path(__file__).parent / "static"
MEDIA_TYPES = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}


@dataclass(frozen=True, slots=True)
class Asset:
    """A static file with its media type and ETag."""

    content: bytes
    media_type: str
    etag: str


@cache
def load_asset(name: str) -> Asset | None:
    """Load a static file of the package; None if it does not exist."""
    path = STATIC_FOLDER / name
    if Path(name).name != name or path.suffix not in MEDIA_TYPES or not path.is_file():
        return None
    content = path.read_bytes()
    etag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
    return Asset(content, MEDIA_TYPES[path.suffix], etag)


@dataclass(frozen=True, slots=True)
class Bundle:
    """A file for browsers in an installed package, which is not imported, since that is slow.

    Attributes
    ----------
    package : str
        Module of the package.
    path : str
        Of the file, inside the package.
    name : str
        Name under which it is served; it contains the version, so browsers may cache it.
    """

    package: str
    path: str
    name: str

    @property
    def file(self) -> Path:
        """Path of the file."""
        spec = find_spec(self.package)
        assert spec is not None
        assert spec.submodule_search_locations
        return Path(spec.submodule_search_locations[0]) / self.path

    @property
    def media_type(self) -> str:
        """Its media type."""
        return MEDIA_TYPES[self.file.suffix]


@cache
def get_bundles() -> Mapping[str, Bundle]:
    """Return the bundles by what pages call them: ``plotly``, ``swagger`` and its style."""
    drawing, interface = version("plotly"), version("swagger-ui-py")
    return {
        "plotly": Bundle("plotly", "package_data/plotly.min.js", f"plotly-{drawing}.min.js"),
        "swagger": Bundle(
            "swagger_ui", "static/swagger-ui-bundle.js", f"swagger-ui-{interface}.js"
        ),
        "swagger-style": Bundle(
            "swagger_ui", "static/swagger-ui.css", f"swagger-ui-{interface}.css"
        ),
    }


def find_bundle(name: str) -> Bundle | None:
    """Find a bundle by the name under which it is served."""
    return next((one for one in get_bundles().values() if one.name == name), None)


@cache
def compress_bundle(bundle: Bundle) -> bytes:
    """Compress a bundle once per process."""
    return gzip.compress(bundle.file.read_bytes(), compresslevel=6, mtime=0)


@cache
def template_environment() -> Environment:
    """Load the templates; users' texts are escaped, and an undefined variable is an error."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(TEMPLATE_FILTERS | RESULT_FILTERS)
    environment.tests["finite"] = isfinite
    environment.globals["default_algorithm"] = GeneticAlgorithm()
    environment.globals["get_account"] = shown_account.get
    environment.globals.update(
        root=get_root_path,
        static=lambda name: to_address(f"/static/{name}"),
        bundle=lambda name: to_address(f"/static/{get_bundles()[name].name}"),
    )
    return environment


def render_template(template: str, **context: Any) -> str:
    """Render a template with its context and the present time as `now`."""
    return template_environment().get_template(template).render(now=datetime.now(UTC), **context)


@cache
def load_stylesheet() -> Markup:
    """Load the style sheet of pages and reports."""
    return Markup((STATIC_FOLDER / "lagid.css").read_text(encoding="utf-8"))


@cache
def security_policy() -> str:
    """Content security policy: only the report's two scripts, identified by hashes."""
    hashes = " ".join(
        f"'sha256-{_script_hash(script)}'" for script in (plotly_script(), draw_script())
    )
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data: blob:"
    )


@cache
def plotly_script() -> Markup:
    """Load the Plotly bundle as the content of a script element."""
    return _to_script(get_bundles()["plotly"].file.read_text(encoding="utf-8"))


@cache
def draw_script() -> Markup:
    """Load the script that draws the figures, as the content of a script element."""
    return _to_script((STATIC_FOLDER / "report.js").read_text(encoding="utf-8"))


def _to_script(text: str) -> Markup:
    # In a string or a regular expression, <\/ means </ and does not end the element.
    return Markup(text.replace("</script", "<\\/script"))


def _script_hash(script: str) -> str:
    return base64.b64encode(hashlib.sha256(str(script).encode()).digest()).decode()
