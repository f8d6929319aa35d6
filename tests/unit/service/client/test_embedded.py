"""A service of its own for a program: how it is started."""

import sys
from pathlib import Path

import pytest

from service.client import embedded
from service.client.embedded import run_embedded_service
from service.core.errors import ServiceDidNotStart


def test_the_folder_may_be_a_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "import sys; print(sys.argv)"
    monkeypatch.setattr(
        embedded, "build_child_command", lambda *words: [sys.executable, "-c", code, *words]
    )
    folder = str(tmp_path / "data")
    with pytest.raises(ServiceDidNotStart, match="exit code 0"), run_embedded_service(folder):
        pass
    assert f"'--data-dir', {folder!r}" in (tmp_path / "data" / "serve.log").read_text()
