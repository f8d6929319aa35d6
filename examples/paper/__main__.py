"""``python -m examples.paper``: print the study's tables, and write its report."""

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from examples.paper.bench import StudyBench, StudyFailed
from examples.paper.document import to_markdown
from examples.paper.report import render_report
from examples.paper.study import UnknownPart, choose_parts, conduct_study
from lagid import Client, ClientError, ServiceDidNotStart, run_embedded_service


def main() -> None:
    """Conduct the study that the command line asks for."""
    options = _parse_arguments()
    start, sections = time.monotonic(), []
    try:
        with _connect_client(options.url) as client:
            bench = StudyBench(client, options.quick, _show_progress)
            for section in conduct_study(bench, options.only):
                sections.append(section)
                print(to_markdown(section))
    except (ClientError, ServiceDidNotStart, StudyFailed) as error:
        sys.exit(f"examples.paper: {error}")
    options.output.write_text(render_report(sections, quick=options.quick), encoding="utf-8")
    print(f"report {options.output.resolve()} ({time.monotonic() - start:.0f} s)")


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m examples.paper",
        description="Reproduce tables and figures of the paper that the method is from.",
    )
    parser.add_argument(
        "--output", type=Path, default=Path("paper.html"), help="file of the report (%(default)s)"
    )
    parser.add_argument("--quick", action="store_true", help="fewer replicates")
    parser.add_argument("--only", help="parts, such as table1,figure15 (default: all)")
    parser.add_argument("--url", help="server that runs the jobs (default: start one)")
    options = parser.parse_args()
    try:
        options.only = choose_parts(options.only)
    except UnknownPart as error:
        parser.error(f"--only: {error}")
    if not options.output.parent.is_dir():
        parser.error(f"--output: there is no folder {options.output.parent}")
    return options


@contextmanager
def _connect_client(url: str | None) -> Iterator[Client]:
    """Connect to the named server, or to one that runs until the study ends."""
    if url is not None:
        with Client(url) as client:
            yield client
        return
    with (
        TemporaryDirectory(prefix="lagid-paper-") as folder,
        run_embedded_service(Path(folder)) as own_url,
        Client(own_url) as client,
    ):
        yield client


def _show_progress(text: str) -> None:
    print(f"… {text}", file=sys.stderr)


if __name__ == "__main__":
    main()
