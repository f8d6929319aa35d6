"""Settings, defaults that stand in two places, and what a client loads."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from service.core.errors import Misconfigured
from service.core.settings import Settings, is_loopback
from service.jobs.schemas import JobIn
from service.jobs.to_core import algorithm_of, loss_of
from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm, IslandChange, Loss, Migration, Stop


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


def test_the_defaults_of_the_job_body_are_those_of_the_core() -> None:
    document = JobIn.model_validate({"model": "m", "datasets": ["d"]}).normal_form()
    assert algorithm_of(document["algorithm"]) == GeneticAlgorithm()
    assert loss_of(document["loss"]) == Loss()


def test_changes_of_single_islands_reach_the_core() -> None:
    algorithm = {"islands": [{"method": "simple"}, {"bits": 12, "mutation": [[0, 0.5]]}]}
    body = JobIn.model_validate({"model": "m", "datasets": ["d"], "algorithm": algorithm})
    assert algorithm_of(body.normal_form()["algorithm"]).islands == (
        IslandChange(method="simple"),
        IslandChange(bits=12, mutation=((0, 0.5),)),
    )


def test_the_client_loads_neither_numpy_nor_ray_nor_the_core() -> None:
    heavy = "{'numpy', 'ray', 'sysid', 'fastapi', 'sqlalchemy', 'pydantic'}"
    code = f"import sys, service.client.client; assert not {heavy} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_the_web_application_loads_neither_ray_nor_the_compiler() -> None:
    heavy = "{'ray', 'workers.tasks', 'workers.cluster', 'numba', 'llvmlite'}"
    code = f"import sys, service.api.app; assert not {heavy} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize(("host", "expected"), [
    ("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False),
    ("example.org", False), ("10.0.0.1", False),
])  # fmt: skip
def test_loopback_is_this_machine_only(host: str, expected: bool) -> None:
    assert is_loopback(host) is expected


def test_another_host_is_refused_as_long_as_there_are_no_keys() -> None:
    with pytest.raises(Misconfigured, match="LAGID_ALLOW_OPEN_HOST"):
        Settings(host="0.0.0.0").check_exposure()
    with pytest.raises(Misconfigured, match="REQUIRE_KEYS"):
        Settings(require_keys=True).check_exposure()
    Settings(host="0.0.0.0", allow_open_host=True).check_exposure()
    Settings().check_exposure()


def test_a_data_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("not a folder")
    with pytest.raises(Misconfigured, match="not writable") as refused:
        Settings(data_dir=file / "data").prepare_folder()
    assert str(file) in str(refused.value)


def test_database_and_store_lie_in_the_data_folder_unless_named(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    assert settings.database == f"sqlite:///{tmp_path / 'lagid.db'}"
    assert settings.store == (tmp_path / "objects").as_uri()
    assert Settings(store_url="s3://bucket").store == "s3://bucket"
