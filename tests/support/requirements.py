"""What a test needs and a machine may lack, such as Chromium, a C compiler or measured records.

Without it the test is skipped with a reason. With `LAGID_REQUIRE_BROWSER`,
`LAGID_REQUIRE_COMPILER`, `LAGID_REQUIRE_PYTHON`, `LAGID_REQUIRE_GENERATOR`, `LAGID_REQUIRE_DATA`
or `LAGID_REQUIRE_NOTEBOOK` set to 1 it fails.
`LAGID_MAX_SKIPPED` limits all other skips: the whole run fails if more tests were skipped, because
a gate that skips is not seen.
"""

import os
from pathlib import Path
from typing import Literal

import pytest

from tests.support.checkout import ROOT

Need = Literal["browser", "compiler", "data", "generator", "notebook", "python"]

DATA = Path(os.environ.get("LAGID_DATA", ROOT.parent / "shared" / "data"))


def report_missing(need: Need, what: str) -> None:
    """Skip the running test because something is missing, or fail it where that is required."""
    variable = f"LAGID_REQUIRE_{need.upper()}"
    if os.environ.get(variable) == "1":
        pytest.fail(f"{what}, and {variable} is 1", pytrace=False)
    pytest.skip(f"{what}; set {variable}=1 to make that an error")


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("data") and not DATA.is_dir():
        report_missing("data", "the measured records (LAGID_DATA) are absent")


def count_skipped(reports: list[pytest.TestReport]) -> int:
    """Count skipped tests, without those that wait for the measured records."""
    return sum("data" not in report.keywords for report in reports)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    limit = os.environ.get("LAGID_MAX_SKIPPED")
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if limit is None or reporter is None or hasattr(session.config, "workerinput"):
        return
    skipped = count_skipped(reporter.stats.get("skipped", []))
    reporter.write_line("")
    reporter.write_line(f"{skipped} tests were skipped besides those of the measured records")
    if skipped > int(limit) and session.exitstatus == pytest.ExitCode.OK:
        reporter.write_line(f"more than LAGID_MAX_SKIPPED={limit}: the run fails", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
