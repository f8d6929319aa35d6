"""What holds for every test: the threads it has, the shared fixtures."""

import os

# Set before NumPy is loaded. On the small matrices of these tests a second BLAS thread only waits
# for a processor, and beside other work that costs many times the computation. Workers have one
# thread as well.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from functools import cache

import pytest
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling

from tests.guard import Guard
from tests.repository import ROOT

pytest_plugins = [
    "tests.profiles",
    "tests.database",
    "tests.cluster",
    "tests.needs",
    "tests.standing",
]

SERVICES = "services"
GUARD = pytest.StashKey[Guard]()


def pytest_configure(config: pytest.Config) -> None:
    """Start the guard: at the end nothing is left, also if pytest is killed."""
    guard = config.stash[GUARD] = Guard()
    guard.mark_environment()
    config.add_cleanup(guard.end_session)


@pytest.fixture(scope="session", autouse=True)
def _guarded_folder(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> None:
    pytestconfig.stash[GUARD].remove_when_killed(tmp_path_factory.getbasetemp())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let the tests of services begin: they wait more than they compute."""
    items.sort(key=lambda item: item.get_closest_marker("ray") is None)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> LoadScopeScheduling:
    """Give a process all tests of services, which share one Ray, and any other module whole."""
    return GroupScheduling(config, log)


class GroupScheduling(LoadScopeScheduling):
    """Scheduling by group. Marks do not reach it, so a module shows its group by its text."""

    def _split_scope(self, nodeid: str) -> str:
        return find_group(nodeid)


@cache
def _needs_services(module: str) -> bool:
    path = ROOT / module
    return path.is_file() and "pytest.mark.ray" in path.read_text(encoding="utf-8")


def find_group(nodeid: str) -> str:
    """Find the group of a test: its module, or that of all modules that use Ray."""
    module = nodeid.partition("::")[0]
    return SERVICES if _needs_services(module) else module
