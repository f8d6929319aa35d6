"""Send and receive recordings over HTTP.

Objects are sent with ranges, ETags and cross-origin headers, which MCAP viewers need. An uploaded
body goes to a temporary file; its bytes are hashed and counted as they arrive.
"""

import hashlib
import re
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from service.core.bodies.text_checks import parse_digits
from service.core.errors import (
    InvalidRequest,
    StaleVersion,
    TooLarge,
    UnsatisfiableRange,
    UnsupportedMediaType,
)
from service.core.process import temporary_files
from service.core.process.concurrency import FairPlaces
from service.core.settings import Settings
from service.datasets.datasets import check_upload_size

MCAP_TYPE, FILE_TYPE = "application/x-mcap", "application/octet-stream"
# Foxglove and others read from a page of another origin; an id cannot be guessed.
CROSS_ORIGIN = {
    "Access-Control-Allow-Origin": "*",
    "Access-Control-Expose-Headers": "Accept-Ranges, Content-Length, Content-Range, ETag",
    "Cross-Origin-Resource-Policy": "cross-origin",
}
FILE_ANSWERS: dict[int | str, dict[str, Any]] = {
    206: {
        "description": "The requested range of bytes",
        "content": {MCAP_TYPE: {"schema": {"type": "string", "format": "binary"}}},
    },
    304: {"description": "The content is what the request's ETag names"},
}
"""Further statuses of an answer with a file, for the OpenAPI document."""
_RANGE_PATTERN = re.compile(r"bytes=(\d*)-(\d*)", re.ASCII)


class McapResponse(StreamingResponse):
    """A recording, or a part of it."""

    media_type = MCAP_TYPE


class CsvResponse(StreamingResponse):
    """A table that is sent while it is made."""

    media_type = "text/csv"


@dataclass(frozen=True, slots=True)
class ByteRange:
    """Bytes from `start` up to but excluding `stop`."""

    start: int
    stop: int


class ContentSource(Protocol):
    """What files are read from: an object store, or memory."""

    def get_size(self, sha256: str) -> int:
        """Return the size of an object in bytes."""
        ...

    def get_stream(self, sha256: str, start: int = 0, length: int | None = None) -> Iterator[bytes]:
        """Read an object, or a part of it."""
        ...


class MemoryContent:
    """One object in memory; a `ContentSource`."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.sha256 = hashlib.sha256(data).hexdigest()

    def get_size(self, sha256: str) -> int:
        """Return the size in bytes."""
        return len(self._data)

    def get_stream(self, sha256: str, start: int = 0, length: int | None = None) -> Iterator[bytes]:
        """Read the object, or a part of it."""
        yield self._data[start : len(self._data) if length is None else start + length]


def content_response(
    request: Request,
    store: ContentSource,
    sha256: str,
    file_name: str,
) -> Response:
    """Answer with an object, or with the requested range of it.

    Raises
    ------
    UnsatisfiableRange
        If the range lies outside the object.
    StaleVersion
        If ``If-Match`` names another version.
    """
    etag = f'"{sha256}"'
    headers = {
        **CROSS_ORIGIN,
        "Accept-Ranges": "bytes",
        "ETag": etag,
        "Cache-Control": "private, no-cache",  # kept, but not used without asking for the key
        "Content-Disposition": f'attachment; filename="{file_name}"',
    }
    if "if-match" in request.headers and not _matches_etag(request.headers["if-match"], etag):
        raise StaleVersion(
            f"the content has ETag {etag}; If-Match asks for {request.headers['if-match']}"
        )
    if _matches_etag(request.headers.get("if-none-match", ""), etag):
        return Response(status_code=304, headers=headers)
    size = store.get_size(sha256)
    part = _parse_range(request, size, etag)
    status, wanted = (200, ByteRange(0, size)) if part is None else (206, part)
    if part is not None:
        headers["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{size}"
    headers["Content-Length"] = str(wanted.stop - wanted.start)
    if request.method == "HEAD":
        return Response(status_code=status, headers=headers, media_type=MCAP_TYPE)
    blocks = store.get_stream(sha256, wanted.start, wanted.stop - wanted.start)
    first = next(blocks, b"")  # a damaged object is told before the answer begins, or breaks it off
    return McapResponse(chain((first,), blocks), status, headers)


def preflight_response() -> Response:
    """Answer a CORS preflight: pages of other origins may request ranges."""
    headers = {
        **CROSS_ORIGIN,
        "Access-Control-Allow-Methods": "GET, HEAD",
        "Access-Control-Allow-Headers": "Authorization, Range, If-None-Match",
        "Access-Control-Max-Age": "86400",
    }
    return Response(status_code=204, headers=headers)


def _parse_range(request: Request, size: int, etag: str) -> ByteRange | None:
    """Parse the Range header; None for the whole file, also if the client's version is stale."""
    text = request.headers.get("range")
    if text is None or request.headers.get("if-range", etag) != etag:
        return None
    match = _RANGE_PATTERN.fullmatch(text.strip())
    if match is None or match[0] == "bytes=-":
        return None  # several ranges, or another unit: RFC 9110 lets a server send the whole
    first, last = match.groups()
    if not first:
        start, stop = max(size - parse_digits(last), 0), size
    else:
        start, stop = parse_digits(first), min(parse_digits(last) + 1 if last else size, size)
    if start >= stop:
        raise UnsatisfiableRange(text, size)
    return ByteRange(start, stop)


def _matches_etag(header: str, etag: str) -> bool:
    etags = [text.strip().removeprefix("W/") for text in header.split(",")]
    return etag in etags or etags == ["*"]


MCAP_TYPES = ("application/x-mcap", "application/mcap", "application/vnd.mcap")
FILE_TYPES = frozenset(
    (
        *MCAP_TYPES,
        *("text/csv", "application/csv", "text/plain", "text/tab-separated-values"),
        *("application/octet-stream", "application/gzip", "application/x-gzip"),
        *("application/zip", "application/x-zip-compressed", "application/x-npz"),
        *("application/x-matlab-data", "application/matlab-mat"),
        *("application/vnd.apache.parquet", "application/x-parquet"),
        *("application/vnd.ms-excel", "application/vnd.oasis.opendocument.spreadsheet"),
        "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet",
    )
)
"""Media types of files that may hold a recording; which kind it is, its bytes say."""
MULTIPART = "multipart/form-data"
PIECE_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Upload:
    """A received file: its path, the hash of its bytes, and its name if the sender gave one."""

    path: Path
    sha256: str
    name: str | None = None
    suffix: str = ""


@asynccontextmanager
async def receive_upload(
    request: Request, settings: Settings, places: FairPlaces, project: str
) -> AsyncIterator[Upload]:
    """Receive the body as a file that exists until the block ends.

    The block has one of the `places` of its project. A body that waits for one is not read yet: it
    waits with its sender, and needs neither disk nor thread.

    Raises
    ------
    ServiceBusy
        If no place became free in time.
    TooLarge
        As soon as the announced or received bytes exceed the limit.
    UnsupportedMediaType
        If the body is said to be something else than a file.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind not in (*FILE_TYPES, MULTIPART):
        raise UnsupportedMediaType(
            f"found {kind!r}; need application/octet-stream or text/csv for the bytes of a file, "
            "or a form with a file"
        )
    announced = request.headers.get("content-length", "")
    if announced.isdecimal():
        check_upload_size(parse_digits(announced), settings)
    elif kind == MULTIPART:
        raise TooLarge("a form needs a Content-Length header, so that its size can be checked")
    async with places.hold_awaiting(project):
        with TemporaryDirectory(prefix=temporary_files.make_temporary_prefix()) as folder:
            path = Path(folder) / "upload"
            if kind == MULTIPART:
                yield await _receive_form(request, path, settings)
            else:
                digest = await _save_body(request.stream(), path, settings)
                yield Upload(path, digest, suffix=".mcap" if kind in MCAP_TYPES else "")


async def _receive_form(request: Request, path: Path, settings: Settings) -> Upload:
    async with _read_form(request) as form:
        file = next((value for value in form.values() if isinstance(value, UploadFile)), None)
        if file is None or not file.filename:
            raise InvalidRequest.from_fault("/file", "the form has no file; need one recording")
        digest = await _save_body(_read_pieces(file), path, settings)
        name = Path(file.filename)
        return Upload(path, digest, _find_stem(name), name.suffix)


@asynccontextmanager
async def _read_form(request: Request) -> AsyncIterator[FormData]:
    try:
        form = await request.form(max_files=1, max_fields=20)
    except HTTPException as error:
        raise InvalidRequest.from_fault(
            "", f"the form cannot be read: {error.detail} Need multipart/form-data with one file"
        ) from None
    try:
        yield form
    finally:
        await form.close()


async def _read_pieces(file: UploadFile) -> AsyncIterator[bytes]:
    while piece := await file.read(PIECE_BYTES):
        yield piece


async def _save_body(pieces: AsyncIterator[bytes], path: Path, settings: Settings) -> str:
    digest, size = hashlib.sha256(), 0
    with path.open("wb") as file:
        async for piece in pieces:
            size += len(piece)
            check_upload_size(size, settings)
            digest.update(piece)
            await run_in_threadpool(file.write, piece)
    return digest.hexdigest()


def _find_stem(name: Path) -> str:
    """Return the name without its suffix, and without that of the text that it compresses."""
    return Path(name.stem).stem if name.suffix.lower() == ".gz" else name.stem
