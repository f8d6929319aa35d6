"""A start of Ray that a busy machine delays is tried again; any other failure is told."""

import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from workers import local_ray


class UnwillingRay:
    """Raises these errors when it is started, one after the other; then it starts."""

    def __init__(self, *errors: Exception) -> None:
        self.starts, self._errors = 0, list(errors)

    def init(self, **settings: Any) -> SimpleNamespace:
        self.starts += 1
        if self._errors:
            raise self._errors.pop(0)
        return SimpleNamespace(**settings)


def start(ray: UnwillingRay, folder: Path, seconds: float = 60.0) -> None:
    local_ray._start_patiently(ray, 1, folder, seconds)


LATE = Exception("The current node timed out during startup.")


def test_a_start_that_took_too_long_is_tried_until_it_succeeds(tmp_path: Path) -> None:
    ray = UnwillingRay(LATE, LATE, LATE)
    start(ray, tmp_path)
    assert ray.starts == 4


def test_a_start_fails_once_its_time_is_over(tmp_path: Path) -> None:
    ray = UnwillingRay(LATE, LATE)
    with pytest.raises(local_ray.INIT_ERRORS, match="timed out during startup"):
        start(ray, tmp_path, seconds=-1.0)
    assert ray.starts == 1


def test_another_failure_is_not_tried_again(tmp_path: Path) -> None:
    ray = UnwillingRay(ConnectionError("no port"))
    with pytest.raises(ConnectionError, match="no port"):
        start(ray, tmp_path)
    assert ray.starts == 1


def test_a_ray_without_private_names_starts_with_its_public_settings_and_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    ray = UnwillingRay()
    for name, missing in (("ray._private.node", local_ray._UNUSED_STARTS), ("ray", ())):
        caplog.clear()
        with monkeypatch.context() as gone:
            if missing:
                gone.setitem(sys.modules, name, None)
            start(ray, tmp_path)
        assert [text in caplog.text for text in local_ray._UNUSED_STARTS] == [bool(missing)] * 3
    assert ray.starts == 2


def test_ray_has_its_files_in_our_folder_by_its_public_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class TellingRay(UnwillingRay):
        def init(self, **settings: Any) -> SimpleNamespace:
            told.append(os.environ["RAY_TMPDIR"])
            assert not [name for name in settings if name.startswith("_")]
            return super().init(**settings)

    told: list[str] = []
    for before in ("/elsewhere", None):
        if before is None:
            monkeypatch.delenv("RAY_TMPDIR", raising=False)
        else:
            monkeypatch.setenv("RAY_TMPDIR", before)
        start(TellingRay(), tmp_path)
        assert os.environ.get("RAY_TMPDIR") == before
    assert told == [str(tmp_path)] * 2
