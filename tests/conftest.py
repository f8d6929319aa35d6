"""What holds for every test: the threads it has, the shared fixtures."""

import os

# Set before NumPy is loaded. On the small matrices of these tests a second BLAS thread only waits
# for a processor, and beside other work that costs many times the computation. Workers have one
# thread as well.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

from tests.guard import Guard

pytest_plugins = [
    "tests.profiles",
    "tests.database",
    "tests.cluster",
    "tests.needs",
    "tests.standing",
]

GUARD = pytest.StashKey[Guard]()


def pytest_configure(config: pytest.Config) -> None:
    """Start the guard: at the end nothing is left, also if pytest is killed."""
    guard = config.stash[GUARD] = Guard()
    guard.mark_environment()
    config.addinivalue_line("markers", "xdist_group(name): tests that one process runs in turn")
    config.add_cleanup(guard.end_session)


@pytest.fixture(scope="session", autouse=True)
def _guarded_folder(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> None:
    pytestconfig.stash[GUARD].remove_when_killed(tmp_path_factory.getbasetemp())


@pytest.hookimpl(tryfirst=True)  # xdist reads the groups in the same hook
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let the tests of services begin; for xdist they are one group, all others one by module."""
    items.sort(key=lambda item: not needs_service(item))
    for item in items:
        module = item.nodeid.partition("::")[0]
        group = "services" if needs_service(item) else module
        item.add_marker(pytest.mark.xdist_group(group))


def needs_service(item: pytest.Item) -> bool:
    """Whether a test uses Ray: all of these share one Ray, one service, and wait for each other."""
    return item.get_closest_marker("ray") is not None
