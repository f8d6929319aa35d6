"""Files that the pages load: our own, and Plotly out of its installed wheel. Nothing is remote."""

import gzip
import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

STATIC = Path(__file__).parent / "static"
MEDIA_TYPES = {
    ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Asset:
    """A file as it is served."""

    content: bytes
    media_type: str
    etag: str


@cache
def asset(name: str) -> Asset | None:
    """One of our own files; None if there is no such file."""
    path = STATIC / name
    if Path(name).name != name or path.suffix not in MEDIA_TYPES or not path.is_file():
        return None
    content = path.read_bytes()
    etag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
    return Asset(content, MEDIA_TYPES[path.suffix], etag)


@cache
def plotly_name() -> str:
    """Name under which Plotly is served; it changes with the version, so it may be kept forever."""
    return f"plotly-{version('plotly')}.min.js"


def plotly_file() -> Path:
    """The bundle inside the wheel. The package itself is not imported: that takes long."""
    spec = find_spec("plotly")
    assert spec is not None
    assert spec.submodule_search_locations
    return Path(spec.submodule_search_locations[0]) / "package_data" / "plotly.min.js"


@cache
def plotly_compressed() -> bytes:
    """The bundle, compressed once per process."""
    return gzip.compress(plotly_file().read_bytes(), compresslevel=6, mtime=0)
