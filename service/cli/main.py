"""`lagid`: the command line. Commands import late, so `--help` is fast."""

import os
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.exceptions import TyperException

from service.cli import (
    access,
    backup,
    datasets,
    health,
    jobs,
    models,
    retention,
    runs,
    server,
    sweeps,
)
from service.cli import reidentify as references
from service.cli.common import out, print_error, print_line, show_examples
from service.cli.identify import identify
from service.cli.paper import reproduce_paper
from service.cli.reidentify import reidentify
from service.client.calls import ClientError, NotFinite, ProblemError
from service.core.errors import ServiceError

SERVER_ERROR_STATUS = 500
EXTRA_ARGUMENT = "unexpected extra argument"
SURROGATE_REASON = "surrogates not allowed"
"""Python's reason for an argument or a file name in another encoding."""
app = typer.Typer(
    name="lagid",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=show_examples(
        "lagid identify recording.csv --model fopdt", "lagid models", "lagid demo"
    ),
)


def _print_version(is_asked: bool) -> None:
    if is_asked:
        print_line(f"lagid {version('lagid')}")
        raise typer.Exit


@app.callback()
def describe_program(
    version: Annotated[
        bool,
        typer.Option(
            "--version", "-V", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Identification of nonlinear systems with unknown time delays.

    `identify` and `models` work alone. The commands on jobs and data need a server: start one with
    `lagid serve`, or name one by LAGID_URL. Exit code 0: success, 1: the work failed, 2: wrong
    arguments.
    """


class _HelpPanel:
    """A group of commands in the help, in the order in which they are added."""

    def __init__(self, name: str) -> None:
        self.name = name

    def add(self, name: str, command: Callable[..., Any], *examples: str) -> None:
        """Add a command with examples that can be copied."""
        app.command(name, rich_help_panel=self.name, epilog=show_examples(*examples))(command)

    def add_group(self, name: str, group: typer.Typer) -> None:
        """Add a command that has commands."""
        app.add_typer(group, name=name, rich_help_panel=self.name)


def run_demo(
    data_dir: Annotated[
        Path | None,
        typer.Option(help="Folder for its data (default: LAGID_DATA_DIR, or lagid-demo)."),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Port (default: LAGID_PORT, or any free one)."),
    ] = None,
) -> None:
    """Run one example through the whole service: Example 1 of the paper, with its Table 1."""
    from service.cli import demo

    demo.run_demo(data_dir, port, out)


first = _HelpPanel("Try it")
first.add("demo", run_demo, "lagid demo", "lagid demo --data-dir /tmp/demo")
first.add(
    "identify",
    identify,
    "lagid identify recording.csv --model fopdt",
    "lagid identify recording.csv --model mine.yaml --channels u=P1,y=P2",
    "lagid identify recording.csv --model tube --set parameters.L.upper=0.5",
    "lagid identify - --model fopdt --json < recording.csv",
)
first.add(
    "paper",
    reproduce_paper,
    "lagid paper --quick",
    "lagid paper --only table1,figure15 --output table1.html",
)
data = _HelpPanel("Data and models")
data.add("datasets", datasets.list_datasets, "lagid datasets", "lagid datasets --name tube --json")
data.add_group("dataset", datasets.app)
data.add_group("models", models.app)
work = _HelpPanel("Jobs")
work.add(
    "submit",
    jobs.submit_job,
    "lagid submit job.yaml --wait",
    "lagid submit - --json < job.yaml",
)
work.add("watch", jobs.watch_job, "lagid watch job_1", "lagid watch job_1 --quiet --json")
work.add(
    "jobs",
    jobs.list_jobs,
    "lagid jobs --state running",
    "lagid jobs --tag night --since 2026-01-31",
)
work.add("cancel", jobs.cancel_job, "lagid cancel job_1")
work.add("resume", jobs.resume_job, "lagid resume job_1")
work.add_group("job", jobs.app)
work.add_group("sweep", sweeps.app)
work.add(
    "reidentify",
    reidentify,
    "lagid reidentify --model tube --label length_m 5=a.csv 10=b.csv --wait",
    "lagid reidentify --model tube --label length_m --reference tube 30=new.csv",
)
results = _HelpPanel("Results")
results.add_group("runs", runs.app)
results.add(
    "export",
    runs.export_model,
    "lagid export run_1 --format c --output model.c",
    "lagid export run_1 --json",
)
results.add("report", jobs.write_report, "lagid report job_1 --output tube.html")
results.add_group("references", references.app)
upkeep = _HelpPanel("Server")
upkeep.add(
    "serve", server.serve, "lagid serve", "lagid serve --port 8001 --data-dir measurements --cpus 4"
)
upkeep.add("dispatcher", server.run_dispatcher, "lagid dispatcher --cpus 8")
upkeep.add_group("key", access.key_app)
upkeep.add_group("project", access.project_app)
upkeep.add("audit", access.list_audit_log, "lagid audit", "lagid audit --project tubes --json")
upkeep.add("backup", backup.write_backup, "lagid backup lagid.zip")
upkeep.add(
    "restore",
    backup.restore_backup,
    "lagid restore lagid.zip --data-dir restored",
    "lagid restore lagid.zip --force",
)
upkeep.add_group("db", retention.app)
upkeep.add("health", health.check_health, "lagid health web", "lagid health dispatcher")
upkeep.add("doctor", server.check_installation, "lagid doctor", "lagid doctor --json")


def main() -> None:
    """Run the command line; a user's mistake prints one line, never a traceback."""
    # The matrices are tiny: several threads take many times longer when other work runs as well.
    # NumPy reads this variable once, when it is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Errors of the core are imported late, since the package may load compiled code.
    try:
        code = app(prog_name="lagid", standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except TyperException as error:
        _exit_with_message(_usage_message(error), error.exit_code)
    except ProblemError as error:
        _exit_with_message(error.reason if error.status < SERVER_ERROR_STATUS else str(error))
    except (ServiceError, ClientError) as error:
        _exit_with_message(str(error), 2 if isinstance(error, NotFinite) else 1)
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:  # the process border; other than user's mistakes, errors go on
        sentence = _user_message(error)
        if sentence is None:
            raise
        _exit_with_message(sentence)


def _usage_message(error: TyperException) -> str:
    """Describe wrong arguments in our own words; empty after a help text."""
    text = error.format_message()
    if not text.strip() or "\n" in text.strip():  # no arguments: the help was printed
        return ""
    cause: Any = error.__cause__
    if hasattr(cause, "errors"):  # from Pydantic, which reads the values of options
        from service.core.validation import describe_error

        text = text.replace(error.message, describe_error(cause.errors()[0], ()))
    context = getattr(error, "ctx", None)
    command = "lagid" if context is None else context.command_path
    hint = "" if context is None or EXTRA_ARGUMENT not in text else _advise_on_json(context.command)
    return f"{text[:1].lower()}{text[1:].rstrip('.')}{hint} ({command} --help)"


def _advise_on_json(command: Any) -> str:
    """Say how JSON is written to a file, if a word that is none of the options follows --json."""
    words = sys.argv[sys.argv.index("--json") + 1 :] if "--json" in sys.argv else []
    if not words or words[0].startswith("-"):
        return ""
    has_output = any("--output" in option.opts for option in command.params)
    file = f"--output {words[0]}" if has_output else f"--json > {words[0]}"
    return f"; --json takes no file, it prints on standard output. To write one: {file}"


def _exit_with_message(message: str, code: int = 1) -> None:
    if message:
        print_error(message)
    sys.exit(code)


def _user_message(error: Exception) -> str | None:
    """Message of a user's mistake that the core, the storage or an encoding reports; else None."""
    from sysid.core.errors import SysidError

    if isinstance(error, UnicodeEncodeError) and error.reason == SURROGATE_REASON:
        return f"{error.object[:200]!r} is not UTF-8 text; encode it in UTF-8"
    storage = sys.modules.get("service.storage.errors")  # the library alone has no storage
    kinds = (SysidError,) if storage is None else (SysidError, storage.StorageError)
    return str(error) if isinstance(error, kinds) else None


if __name__ == "__main__":
    main()
