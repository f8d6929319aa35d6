"""Bytes over HTTP: each answer has those of its object, whole or in part."""

from collections.abc import Iterator
from typing import Any

import pytest
from starlette.requests import Request

from service.api.content import content_response
from service.core.errors import StaleVersion, UnsatisfiableRange
from tests.support.service.web_app import await_in_thread

WHOLE = {"first": b"0123456789", "second": b"abcdefgh"}


class TwoObjects:
    """A store with two objects, which have names in the place of hashes."""

    def get_size(self, sha256: str) -> int:
        return len(WHOLE[sha256])

    def get_stream(self, sha256: str, start: int, length: int) -> Iterator[bytes]:
        yield WHOLE[sha256][start : start + length]


def answer(file: str, method: str = "GET", **headers: str) -> Any:
    pairs = [(name.replace("_", "-").encode(), text.encode()) for name, text in headers.items()]
    request = Request({"type": "http", "method": method, "path": "/", "headers": pairs})
    return content_response(request, TwoObjects(), file, "run.mcap")


def make_body(response: Any) -> bytes:
    async def read() -> bytes:
        return b"".join([piece async for piece in response.body_iterator])

    return await_in_thread(read)


@pytest.mark.parametrize("file", WHOLE)
def test_a_file_comes_whole_with_its_length(file: str) -> None:
    found = answer(file)
    assert (found.status_code, make_body(found)) == (200, WHOLE[file])
    assert found.headers["content-length"] == str(len(WHOLE[file]))
    assert answer(file, "HEAD").headers["content-length"] == str(len(WHOLE[file]))


@pytest.mark.parametrize("file", WHOLE)
@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("bytes=0-0", slice(0, 1)),
        ("bytes=2-4", slice(2, 5)),
        ("bytes=3-", slice(3, None)),
        ("bytes=-3", slice(-3, None)),
        ("bytes=-1000", slice(0, None)),
        ("bytes=4-1000", slice(4, None)),
        ("bytes=0-" + "9" * 5000, slice(0, None)),
        ("bytes=-" + "9" * 5000, slice(0, None)),
        ("bytes=" + "0" * 5000 + "2-4", slice(2, 5)),
    ],
)
def test_a_range_is_within_the_file(file: str, text: str, part: slice) -> None:
    found, whole = answer(file, range=text), WHOLE[file]
    assert (found.status_code, make_body(found)) == (206, whole[part])
    start, stop, _ = part.indices(len(whole))
    assert found.headers["content-range"] == f"bytes {start}-{stop - 1}/{len(whole)}"


@pytest.mark.parametrize(
    "text", ["bytes=8-", "bytes=9-12", "bytes=5-4", "bytes=-0", f"bytes={'9' * 5000}-"]
)
def test_a_range_outside_the_file_is_refused_also_if_the_object_goes_on(text: str) -> None:
    with pytest.raises(UnsatisfiableRange, match="8 bytes"):
        answer("second", range=text)


@pytest.mark.parametrize("text", ["bytes=0-1,3-4", "bytes=-", "lines=0-1", "bytes=x-"])
def test_a_range_that_is_not_understood_gives_the_whole_file(text: str) -> None:
    assert make_body(answer("second", range=text)) == WHOLE["second"]


def test_each_file_has_its_own_version() -> None:
    tags = {file: answer(file).headers["etag"] for file in WHOLE}
    assert len(set(tags.values())) == len(WHOLE)
    for file, tag in tags.items():
        assert answer(file, if_none_match=tag).status_code == 304
        assert answer(file, if_none_match=f'"x", W/{tag}').status_code == 304
        assert answer(file, if_match=tag).status_code == 200
        assert answer(file, range="bytes=0-1", if_range=tag).status_code == 206
    for other in (tags["first"], '"x"'):
        assert answer("second", if_none_match=other).status_code == 200
        assert answer("second", range="bytes=0-1", if_range=other).status_code == 200
        with pytest.raises(StaleVersion):
            answer("second", if_match=other)
    assert answer("second", if_match="*").status_code == 200
