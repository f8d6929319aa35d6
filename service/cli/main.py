"""`lagid`: the command line. Commands import late, so `--help` is fast."""

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.exceptions import TyperException

from service.cli import datasets, jobs, models, runs, server, sweeps
from service.cli import reidentify as references
from service.cli import runs as exporting
from service.cli import server as upkeep
from service.cli.common import out, print_error
from service.cli.identify import identify
from service.cli.paper import reproduce_paper
from service.cli.reidentify import reidentify
from service.client.calls import ClientError, NotFinite, ProblemError
from service.core.errors import ServiceError

SERVER_ERROR_STATUS = 500
SURROGATE_REASON = "surrogates not allowed"
"""Python's reason for an argument or a file name in another encoding."""
app = typer.Typer(
    name="lagid",
    help="Identification of nonlinear systems with unknown time lags.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

app.command("serve")(server.serve)
app.command("dispatcher")(server.run_dispatcher)
app.command("identify")(identify)
app.command("paper")(reproduce_paper)
app.command("submit")(jobs.submit_job)
app.command("watch")(jobs.watch_job)
app.command("jobs")(jobs.list_jobs)
app.add_typer(runs.app, name="runs")
app.command("export")(exporting.export_model)
app.command("cancel")(jobs.cancel_job)
app.command("resume")(jobs.resume_job)
app.command("report")(jobs.write_report)
app.command("datasets")(datasets.list_datasets)
app.add_typer(datasets.app, name="dataset")
app.add_typer(models.app, name="models")
app.add_typer(sweeps.app, name="sweep")
app.command("reidentify")(reidentify)
app.add_typer(references.app, name="references")
app.add_typer(upkeep.database_app, name="db")
app.command("doctor")(upkeep.check_installation)


@app.command("demo")
def run_demo(
    data_dir: Annotated[Path, typer.Option(help="Folder for its data.")] = Path("lagid-demo"),
) -> None:
    """Run the paper's Example 1 through the whole service and print its Table 1."""
    from service.cli import demo

    demo.run_demo(data_dir, out)


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
    return f"{text[:1].lower()}{text[1:].rstrip('.')} ({command} --help)"


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
