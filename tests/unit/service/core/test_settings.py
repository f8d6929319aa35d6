"""Settings, defaults and names that wire types take from the core."""

import os
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import ValidationError

from service.core import settings as module
from service.core.errors import Misconfigured
from service.core.settings import Settings, is_loopback
from service.jobs.job_schemas import JobIn
from service.jobs.to_core import RunSettings, read_run_settings
from service.pages.forms.choices import DEFAULTS, NAMES, TEXTS, list_choices
from service.storage.sessions import Database
from sysid.core.errors import InvalidSettings
from sysid.core.settings import (
    LOSS_KINDS,
    MAX_BITS,
    MIN_POPULATION,
    NOISE_MODELS,
    PREDICTION_KINDS,
    SEARCH_METHODS,
    FitSettings,
    GeneticAlgorithm,
    IslandChange,
    Migration,
    SequenceKind,
    Stop,
    TopologyName,
)
from sysid.data.noise import Noise
from sysid.data.records import HOLDS
from sysid.identification.options import RunOptions


@pytest.mark.parametrize(
    ("change", "pointer"),
    [
        (lambda: GeneticAlgorithm(stagnation=10**30), "/algorithm/stagnation"),
        (lambda: GeneticAlgorithm(generations=10**30), "/algorithm/generations"),
        (lambda: GeneticAlgorithm(mutation=((0, 0.2), (10**30, 0.8))), "/algorithm/mutation"),
        (lambda: IslandChange(mutation=((0, 0.2), (10**30, 0.8))), "/algorithm/islands"),
        (lambda: Migration(every=10**30), "/algorithm/migration/every"),
        (lambda: Migration(migrants=10**30), "/algorithm/migration/migrants"),
        (lambda: Stop(evaluations=10**40), "/algorithm/stop/evaluations"),
    ],
)
def test_a_number_that_the_compiled_search_cannot_count_is_refused(
    change: Callable[[], object], pointer: str
) -> None:
    with pytest.raises(InvalidSettings, match="need") as refused:
        change()
    assert refused.value.pointer == pointer


def settings(**body: Any) -> RunSettings:
    """Settings of the core that a job's body gives."""
    job = JobIn.model_validate({"model": "m", "datasets": ["d"], **body})
    return read_run_settings(job.to_normal_form(), in_sweep=False)


def test_the_defaults_of_the_job_body_are_those_of_the_core() -> None:
    assert settings() == (GeneticAlgorithm(), FitSettings(), RunOptions(noise=Noise()))


def test_the_wire_types_take_every_name_of_the_core_and_its_bounds() -> None:
    every = [
        {"algorithm": {"migration": {"topology": name}}} for name in get_args(TopologyName)
    ] + [{"algorithm": {"method": name}} for name in SEARCH_METHODS]
    every += [{"algorithm": {"sequence": {"kind": name}}} for name in get_args(SequenceKind)]
    every += [{"loss": {"kind": name}} for name in LOSS_KINDS]
    every += [{"loss": {"noise_model": name}} for name in NOISE_MODELS]
    every += [{"prediction": name} for name in PREDICTION_KINDS]
    every += [{"hold": {"u": name}} for name in HOLDS]
    every += [{"algorithm": {"population": MIN_POPULATION}}, {"algorithm": {"bits": MAX_BITS}}]
    for body in every:
        assert settings(**body)
    for field, value in (("population", MIN_POPULATION - 1), ("bits", MAX_BITS + 1)):
        body = {"model": "m", "datasets": ["d"], "algorithm": {field: value}}
        with pytest.raises(ValidationError, match=field):
            JobIn.model_validate(body)


def test_the_form_has_a_choice_for_every_name_and_no_text_without_a_name() -> None:
    assert {name for names in NAMES.values() for name in names} >= set(TEXTS)
    for field, pairs in list_choices().items():
        assert [value for value, _ in pairs] == list(NAMES[field])
        assert DEFAULTS[field] in ("", *NAMES[field])


def test_changes_of_single_islands_reach_the_core() -> None:
    algorithm = {"islands": [{"method": "simple"}, {"bits": 12, "mutation": [[0, 0.5]]}]}
    assert settings(algorithm=algorithm).algorithm.islands == (
        IslandChange(method="simple"),
        IslandChange(bits=12, mutation=((0, 0.5),)),
    )


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        ("127.0.0.1", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("example.org", False),
        ("10.0.0.1", False),
    ],
)
def test_loopback_is_this_machine_only(host: str, expected: bool) -> None:
    assert is_loopback(host) is expected


@pytest.mark.parametrize(
    ("values", "mode"),
    [
        ({}, "off"),
        ({"host": "localhost"}, "off"),
        ({"host": "0.0.0.0"}, "keys"),
        ({"host": "0.0.0.0", "allow_open_host": True}, "off"),
        ({"auth": "keys"}, "keys"),
        ({"host": "0.0.0.0", "auth": "proxy"}, "proxy"),
    ],
)
def test_keys_are_off_on_loopback_only_unless_said_otherwise(
    values: dict[str, Any], mode: str
) -> None:
    settings = Settings(**values)
    settings.check_exposure()
    assert settings.auth_mode == mode


def test_keys_are_not_switched_off_for_other_machines_by_one_setting_alone() -> None:
    with pytest.raises(Misconfigured, match="LAGID_ALLOW_OPEN_HOST"):
        Settings(host="0.0.0.0", auth="off").check_exposure()
    Settings(host="0.0.0.0", auth="off", allow_open_host=True).check_exposure()


def test_addresses_of_proxies_are_addresses_or_networks() -> None:
    networks = Settings(proxy_addresses="10.0.0.0/8, ::1").proxy_networks  # type: ignore[arg-type]
    assert [str(network) for network in networks] == ["10.0.0.0/8", "::1/128"]
    with pytest.raises(ValidationError, match="proxy_addresses"):
        Settings(proxy_addresses=("everywhere",))


def test_a_data_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("not a folder")
    with pytest.raises(Misconfigured, match="not writable") as refused:
        Settings(data_dir=file / "data").prepare_data_folder()
    assert str(file) in str(refused.value)


def test_database_and_store_lie_in_the_data_folder_unless_named(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    assert settings.database_location == f"sqlite:///{tmp_path / 'lagid.db'}"
    assert settings.store_location == (tmp_path / "objects").as_uri()
    assert Settings(store_url="s3://bucket").store_location == "s3://bucket"


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


def test_a_new_data_folder_and_its_database_are_for_their_owner_only(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "above" / "data")
    settings.prepare_data_folder()
    database = Database(settings.database_location)
    with database.engine.begin() as connection:
        connection.exec_driver_sql("CREATE TABLE a (b)")
        modes = {file.name: mode(file) for file in settings.data_dir.iterdir()}
    database.dispose()
    assert mode(settings.data_dir) == 0o700
    assert modes == dict.fromkeys(("lagid.db", "lagid.db-shm", "lagid.db-wal"), 0o600)
    assert settings.describe_open_files() is None


def test_what_other_users_can_read_is_told_in_one_line_and_not_changed(tmp_path: Path) -> None:
    folder, elsewhere = tmp_path / "data", tmp_path / "elsewhere.db"
    folder.mkdir()
    folder.chmod(0o755)
    (folder / "lagid.db").touch(0o644)
    settings = Settings(data_dir=folder)
    settings.prepare_data_folder()
    assert settings.describe_open_files() == (
        f"other users of this machine may reach {folder} (mode 755); `chmod 700 {folder}` closes it"
    )
    assert mode(folder) == 0o755
    folder.chmod(0o700)
    assert settings.describe_open_files() is None
    elsewhere.touch()
    elsewhere.chmod(0o640)
    settings = Settings(data_dir=folder, database_url=f"sqlite:///{elsewhere}")
    assert f"`chmod 600 {elsewhere}`" in (settings.describe_open_files() or "")


def test_the_path_of_a_sqlite_file_does_not_depend_on_the_working_folder(tmp_path: Path) -> None:
    with chdir(tmp_path):
        settings = Settings(database_url="sqlite:///a.db?timeout=3")
    assert settings.database_location == f"sqlite:///{tmp_path}/a.db?timeout=3"
    for url in ("sqlite:///:memory:", "sqlite:////a.db", "sqlite://", "postgresql+psycopg://h/d"):
        assert Settings(database_url=url).database_location == url


def test_another_connection_drops_no_lock_of_the_first(tmp_path: Path) -> None:
    """As closing any descriptor of the file would, of which SQLite knows nothing."""
    file = tmp_path / "a.db"
    database = Database(f"sqlite:///{file}")
    with database.engine.begin() as first:
        first.exec_driver_sql("CREATE TABLE a (b)")
        database.engine.connect().close()  # a second connection of the pool
        mine = f" {os.getpid()} ", f":{file.stat().st_ino} "
        locks = Path("/proc/locks").read_text().splitlines()
        assert [line for line in locks if all(part in line for part in mine)]
    database.dispose()


@pytest.mark.parametrize(
    ("gib", "uploads", "given", "expected"),
    [(5, 4, None, 768), (100, 4, None, 4096), (1, 4, None, 512), (5, 4, 1000, 1000)],
)
def test_readers_of_uploads_share_the_memory(
    monkeypatch: pytest.MonkeyPatch, gib: int, uploads: int, given: int | None, expected: int
) -> None:
    monkeypatch.setattr(module, "read_memory_bytes", lambda: gib * 2**30)
    settings = Settings(max_uploads=uploads, reader_memory_mb=given)
    assert settings.reader_memory_bytes // 2**20 == expected
