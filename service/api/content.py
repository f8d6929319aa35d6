"""Objects over HTTP: ranges, ETags and cross-origin reading, as MCAP viewers ask for them."""

import re
from dataclasses import dataclass

from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from service.errors import StaleVersion, UnsatisfiableRange
from service.storage.objects import ObjectStore

MCAP_TYPE = "application/x-mcap"
# Foxglove and others read from a page of another origin; an id cannot be guessed.
CROSS_ORIGIN = {
    "Access-Control-Allow-Origin": "*",
    "Access-Control-Expose-Headers": "Accept-Ranges, Content-Length, Content-Range, ETag",
}
_RANGE = re.compile(r"bytes=(\d*)-(\d*)", re.ASCII)


@dataclass(frozen=True, slots=True)
class ByteRange:
    """Bytes `start` to `stop`, the last one not included."""

    start: int
    stop: int


def content_of(
    request: Request,
    store: ObjectStore,
    sha256: str,
    file_name: str,
    part_of: ByteRange | None = None,
) -> Response:
    """An object, or the part of it that was asked for.

    Parameters
    ----------
    part_of : ByteRange, optional
        Where the file is in the object; the whole object is the file if this is not given.

    Raises
    ------
    UnsatisfiableRange
        If the range lies outside the object.
    StaleVersion
        If ``If-Match`` names another version.
    """
    etag = f'"{sha256}"' if part_of is None else f'"{sha256}-{part_of.start}"'
    headers = {
        **CROSS_ORIGIN,
        "Accept-Ranges": "bytes",
        "ETag": etag,
        "Cache-Control": "private, max-age=31536000, immutable",
        "Content-Disposition": f'attachment; filename="{file_name}"',
    }
    if "if-match" in request.headers and not _names(request.headers["if-match"], etag):
        raise StaleVersion(f"the content is {etag}; asked for {request.headers['if-match']}")
    if _names(request.headers.get("if-none-match", ""), etag):
        return Response(status_code=304, headers=headers)
    whole = ByteRange(0, store.size(sha256))  # asked in any case: it may be missing
    file = whole if part_of is None else part_of
    size = file.stop - file.start
    part = _asked(request, size, etag)
    status, wanted = (200, ByteRange(0, size)) if part is None else (206, part)
    if part is not None:
        headers["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{size}"
    headers["Content-Length"] = str(wanted.stop - wanted.start)
    if request.method == "HEAD":
        return Response(status_code=status, headers=headers, media_type=MCAP_TYPE)
    blocks = store.stream(sha256, file.start + wanted.start, wanted.stop - wanted.start)
    return StreamingResponse(blocks, status, headers, MCAP_TYPE)


def preflight() -> Response:
    """Answer of a browser's question whether a page of another origin may ask for ranges."""
    headers = {
        **CROSS_ORIGIN,
        "Access-Control-Allow-Methods": "GET, HEAD",
        "Access-Control-Allow-Headers": "Range, If-None-Match",
        "Access-Control-Max-Age": "86400",
    }
    return Response(status_code=204, headers=headers)


def _asked(request: Request, size: int, etag: str) -> ByteRange | None:
    """The range asked for; None for the whole, also where the client holds another version."""
    text = request.headers.get("range")
    if text is None or request.headers.get("if-range", etag) != etag:
        return None
    found = _RANGE.fullmatch(text.strip())
    if found is None or found[0] == "bytes=-":
        return None  # several ranges, or another unit: RFC 9110 lets a server send the whole
    first, last = found.groups()
    if not first:
        start, stop = max(size - int(last), 0), size
    else:
        start, stop = int(first), min(int(last) + 1 if last else size, size)
    if start >= stop:
        raise UnsatisfiableRange(text, size)
    return ByteRange(start, stop)


def _names(header: str, etag: str) -> bool:
    given = [one.strip().removeprefix("W/") for one in header.split(",")]
    return etag in given or given == ["*"]
