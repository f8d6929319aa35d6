"""`lagid`: the command line. Only the command that is run is imported; `--help` imports all."""

import inspect
import os
import re
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.exceptions import TyperException

from service.cli.common import out, print_error, print_line, show_examples
from service.client.calls import ClientError, NotFinite, ProblemError
from service.core.errors import ServiceError

SERVER_ERROR_STATUS = 500
EXTRA_ARGUMENT = "unexpected extra argument"
SURROGATE_REASON = "surrogates not allowed"
"""Python's reason for an argument or a file name in another encoding."""


def _print_version(is_asked: bool) -> None:
    if is_asked:
        print_line(f"lagid {version('lagid')}")
        raise typer.Exit


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


# Panels of the help in their order: commands, each with examples that can be copied, and groups.
_PANELS: Mapping[str, Mapping[str, tuple[Callable[..., None] | str, *tuple[str, ...]]]] = {
    "Try it": {
        "demo": (run_demo, "lagid demo", "lagid demo --data-dir /tmp/demo"),
        "identify": (
            "identify_command:identify",
            "lagid identify recording.csv --model fopdt",
            "lagid identify recording.csv --model mine.yaml --channels u=P1,y=P2",
            "lagid identify recording.csv --model tube --set parameters.L.upper=0.5",
            "lagid identify - --model fopdt --json < recording.csv",
        ),
    },
    "Data and models": {
        "datasets": (
            "dataset_commands:list_datasets",
            "lagid datasets",
            "lagid datasets --name tube --json",
        ),
        "dataset": ("dataset_commands:app",),
        "models": ("model_commands:app",),
    },
    "Jobs": {
        "submit": (
            "job_commands:submit_job",
            "lagid submit job.yaml --wait",
            "lagid submit - --json < job.yaml",
        ),
        "watch": (
            "job_commands:watch_job",
            "lagid watch job_1",
            "lagid watch job_1 --quiet --json",
        ),
        "jobs": (
            "job_commands:list_jobs",
            "lagid jobs --state running",
            "lagid jobs --tag night --since 2026-01-31",
        ),
        "cancel": ("job_commands:cancel_job", "lagid cancel job_1"),
        "resume": ("job_commands:resume_job", "lagid resume job_1"),
        "job": ("job_commands:app",),
        "sweep": ("sweep_command:app",),
        "reidentify": (
            "reidentify_command:reidentify",
            "lagid reidentify --model tube --label length_m 5=a.csv 10=b.csv --wait",
            "lagid reidentify --model tube --label length_m --reference tube 30=new.csv",
        ),
    },
    "Results": {
        "runs": ("run_commands:app",),
        "export": (
            "run_commands:export_model",
            "lagid export run_1 --format c --output model.c",
            "lagid export run_1 --json",
        ),
        "report": ("job_commands:write_report", "lagid report job_1 --output tube.html"),
        "references": ("reidentify_command:app",),
    },
    "Server": {
        "serve": (
            "server_processes:serve",
            "lagid serve",
            "lagid serve --port 8001 --data-dir measurements --cpus 4",
        ),
        "dispatcher": ("server_processes:run_dispatcher", "lagid dispatcher --cpus 8"),
        "key": ("access_commands:key_app",),
        "project": ("access_commands:project_app",),
        "audit": (
            "access_commands:list_audit_log",
            "lagid audit",
            "lagid audit --project tubes --json",
        ),
        "backup": ("backup_commands:write_backup", "lagid backup lagid.zip"),
        "restore": (
            "backup_commands:restore_backup",
            "lagid restore lagid.zip --data-dir restored",
            "lagid restore lagid.zip --force",
        ),
        "db": ("retention_command:app",),
        "health": ("health_command:check_health", "lagid health web", "lagid health dispatcher"),
        "doctor": (
            "server_processes:check_installation",
            "lagid doctor",
            "lagid doctor --deep",
            "lagid doctor --json",
        ),
    },
}


def build_program(only: str | None = None) -> typer.Typer:
    """Build the program with all its commands, or with one; no other is imported then."""
    program = typer.Typer(
        name="lagid",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        context_settings={"help_option_names": ["-h", "--help"]},
        epilog=show_examples(
            "lagid identify recording.csv --model fopdt", "lagid models", "lagid demo"
        ),
    )
    program.callback(help=_join_lines(describe_program.__doc__))(describe_program)
    for panel, commands in _PANELS.items():
        for name, (source, *examples) in commands.items():
            if only not in (None, name):
                continue
            command = _load_command(source) if isinstance(source, str) else source
            if isinstance(command, typer.Typer):
                program.add_typer(command, name=name, rich_help_panel=panel)
            else:
                epilog = show_examples(*examples)
                program.command(name, rich_help_panel=panel, epilog=epilog)(command)
    groups = [group.typer_instance for group in program.registered_groups]
    for each in (program, *filter(None, groups)):
        for info in each.registered_commands:
            info.help = _join_lines(info.callback.__doc__)
    return program


def _join_lines(docstring: str | None) -> str:
    """Join the lines of each paragraph of a help text; the terminal breaks them at its width."""
    return re.sub(r"(?<!\n)\n(?!\n)", " ", inspect.cleandoc(docstring or ""))


def _load_command(source: str) -> Any:
    module, _, name = source.partition(":")
    return getattr(import_module(f"service.cli.{module}"), name)


def _find_command() -> str | None:
    """Find the command that is run; None if it takes all of them to know, as for a help text."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    return name if any(name in commands for commands in _PANELS.values()) else None


def main() -> None:
    """Run the command line; a user's mistake prints one line, never a traceback."""
    # The matrices are tiny: several threads take many times longer when other work runs as well.
    # NumPy reads this variable once, when it is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Errors of the core are imported late, since the package may load compiled code.
    try:
        code = build_program(_find_command())(prog_name="lagid", standalone_mode=False)
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
    text = " ".join(error.format_message().split())
    if not text:  # the help was printed
        return ""
    cause: Any = error.__cause__
    if hasattr(cause, "errors"):  # from Pydantic, which reads the values of options
        from service.core.bodies.validation import describe_error

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
    storage = sys.modules.get("service.storage.storage_errors")  # the library alone has no storage
    kinds = (SysidError,) if storage is None else (SysidError, storage.StorageError)
    return str(error) if isinstance(error, kinds) else None


if __name__ == "__main__":
    main()
