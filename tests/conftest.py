"""What holds for every test: the threads it has, the shared fixtures."""

import gc
import os

# Set before NumPy is loaded. On the small matrices of these tests a second BLAS thread only waits
# for a processor, and beside other work that costs many times the computation. Workers have one
# thread as well.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from functools import cache

import pytest
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling

from tests.support.checkout import ROOT
from tests.support.session_guard import Guard

pytest_plugins = [
    "tests.support.profiles",
    "tests.support.storage.databases",
    "tests.support.storage.object_stores",
    "tests.support.cluster.local_ray",
    "tests.support.library.local_compilation",
    "tests.support.endless_children",
    "tests.support.requirements",
    "tests.support.service.patience",
    "tests.support.service.whole_service",
]

GUARD = pytest.StashKey[Guard]()


def pytest_collection_finish() -> None:
    """Take what was collected out of garbage collection: it stays, and is looked through each time.

    With it and wider thresholds the tests of the service need a tenth less processor time.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)


def pytest_configure(config: pytest.Config) -> None:
    """Start the guard: at the end nothing is left, also if pytest is killed."""
    guard = config.stash[GUARD] = Guard()
    guard.mark_environment()
    config.add_cleanup(guard.end_session)


@pytest.fixture(scope="session", autouse=True)
def _guarded_folder(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> None:
    pytestconfig.stash[GUARD].remove_when_killed(tmp_path_factory.getbasetemp())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let the tests of services and pages begin: they wait more than they compute."""
    items.sort(key=lambda item: not any(map(item.get_closest_marker, ("ray", "browser"))))


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> LoadScopeScheduling:
    """Give a process all tests that share a service, Ray or browser, and other modules whole."""
    return GroupScheduling(config, log)


class GroupScheduling(LoadScopeScheduling):
    """Scheduling by group. Marks do not reach it, so a module shows its group by its text."""

    def _split_scope(self, nodeid: str) -> str:
        return find_group(nodeid)


@cache
def find_module_group(module: str) -> str:
    """Find the group of a module: what it shares with others and costs seconds, or itself."""
    path = ROOT / module
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    shared = {
        "tests.support.service.whole_service": "service",
        "mark.ray": "ray",
        "mark.browser": "browser",
    }
    return next((group for mark, group in shared.items() if mark in text), module)


def find_group(nodeid: str) -> str:
    """Find the group of a test: that of its module."""
    return find_module_group(nodeid.partition("::")[0])
