"""Words of a command that are no text."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.service.commands import (
    CommandResult,
    check_refusal,
    run_lagid,
    run_lagid_process,
)
from tests.support.service.web_app import recording


@pytest.mark.parametrize(
    ("run", "words"),
    [(run_lagid_process, ["watch"]), (run_lagid, ["dataset", "add", "d.csv", "--name"])],
)
def test_a_word_that_is_no_text_is_one_line(
    run: Callable[..., CommandResult], words: list[str], tmp_path: Path
) -> None:
    (tmp_path / "d.csv").write_bytes(recording())
    told = check_refusal(run(*words, b"\xf6sse", cwd=tmp_path))
    assert r"\udcf6" in told
    assert told.endswith("is not UTF-8 text; encode it in UTF-8")
