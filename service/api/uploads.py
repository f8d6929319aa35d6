"""Receiving a recording: the body goes to a temporary file, hashed and counted on the way."""

import hashlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import UploadFile
from starlette.requests import Request

from service import temporary
from service.datasets import Format, check_size
from service.errors import InvalidRequest, TooLarge, UnsupportedMediaType
from service.settings import Settings

CSV_TYPES = ("text/csv", "application/csv", "text/plain")
MCAP_TYPES = ("application/x-mcap", "application/mcap", "application/vnd.mcap")
MULTIPART = "multipart/form-data"
PIECE = 1 << 20


@dataclass(frozen=True, slots=True)
class Upload:
    """A received file: where it lies, what it is, and the hash of its bytes."""

    path: Path
    form: Format
    sha256: str
    name: str | None


@asynccontextmanager
async def received(request: Request, settings: Settings) -> AsyncIterator[Upload]:
    """The body as a file that is there for the length of the block.

    Raises
    ------
    TooLarge
        As soon as more bytes are announced or have come than are allowed.
    UnsupportedMediaType
        If it is neither CSV nor MCAP.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != MULTIPART:
        _format(kind, None)  # refused before the body is read
    announced = request.headers.get("content-length", "")
    if announced.isdecimal():
        check_size(int(announced), settings)
    elif kind == MULTIPART:
        raise TooLarge("a form needs a Content-Length header, to be known as small enough")
    with TemporaryDirectory(prefix=temporary.prefix()) as folder:
        path = Path(folder) / "upload"
        if kind == MULTIPART:
            yield await _from_form(request, path, settings)
        else:
            digest = await _save(request.stream(), path, settings)
            yield Upload(path, _format(kind, None), digest, None)


async def _from_form(request: Request, path: Path, settings: Settings) -> Upload:
    async with request.form(max_files=1, max_fields=20) as form:
        file = next((one for one in form.values() if isinstance(one, UploadFile)), None)
        if file is None or not file.filename:
            raise InvalidRequest.at("/file", "the form has no file; need one CSV or MCAP file")
        digest = await _save(_pieces(file), path, settings)
        found = _format((file.content_type or "").partition(";")[0], file.filename)
        return Upload(path, found, digest, Path(file.filename).stem)


async def _pieces(file: UploadFile) -> AsyncIterator[bytes]:
    while piece := await file.read(PIECE):
        yield piece


async def _save(pieces: AsyncIterator[bytes], path: Path, settings: Settings) -> str:
    digest, size = hashlib.sha256(), 0
    with path.open("wb") as file:
        async for piece in pieces:
            size += len(piece)
            check_size(size, settings)
            digest.update(piece)
            await run_in_threadpool(file.write, piece)
    return digest.hexdigest()


def _format(kind: str, file_name: str | None) -> Format:
    # Browsers do not know MCAP and call CSV many things: a file's suffix says it better.
    suffix = Path(file_name or "").suffix.lower()
    if suffix == ".mcap" or kind in MCAP_TYPES:
        return "mcap"
    if suffix in (".csv", ".txt", ".tsv") or kind in CSV_TYPES:
        return "csv"
    found = f"{kind!r}" + (f" ({file_name})" if file_name else "")
    raise UnsupportedMediaType(f"found {found}; need text/csv or application/x-mcap")
