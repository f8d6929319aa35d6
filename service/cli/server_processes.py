"""`lagid serve`, `lagid dispatcher`, `lagid db …` and `lagid doctor`."""

import errno
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.common import AsJson, ask_to_go_on, err, out, print_json, show_examples
from service.core.errors import Misconfigured, ServiceError, Unavailable
from service.core.extras import check_extra, list_missing

if TYPE_CHECKING:
    from service.core.process.folder_lock import FolderLock
    from service.core.settings import Settings
    from service.dispatch.supervisor import Supervisor
    from service.storage.sessions import Database


_log = logging.getLogger("lagid.web")

SHUTDOWN_SECONDS = 3  # time for open answers once the process is asked to end
END_SECONDS = 9.0  # then the process ends, whatever its threads wait for

Host = Annotated[str | None, typer.Option(help="Address to listen on.")]
Port = Annotated[int | None, typer.Option(min=0, max=65535, help="Port; 0 chooses a free one.")]
DataDir = Annotated[Path | None, typer.Option(help="Folder of database, objects and logs.")]
Cpus = Annotated[int | None, typer.Option(min=1, help="Cores for the workers.")]


def serve(
    host: Host = None,
    port: Port = None,
    data_dir: DataDir = None,
    cpus: Cpus = None,
    with_dispatcher: Annotated[
        bool,
        typer.Option("--dispatcher/--no-dispatcher", help="Also keep a dispatcher running."),
    ] = True,
) -> None:
    """Serve REST and pages, and run a dispatcher (defaults from LAGID_… variables)."""
    settings = load_settings(host=host, port=port, data_dir=data_dir, cpus=cpus)
    settings.check_exposure()
    _prepare_data_folder(settings)
    _check_access(settings)
    from service.core.process.folder_lock import use_folder

    with (
        lock_data_folder(settings, with_dispatcher=with_dispatcher) as lock,
        use_folder(settings.data_dir),
        open_listener(settings.host, settings.port) as listener,
    ):
        from service.dispatch.supervisor import supervise_dispatcher

        _exit_on_signals()
        child: AbstractContextManager[Supervisor | None] = nullcontext()
        if with_dispatcher:
            child = supervise_dispatcher(settings)
        with child as supervisor:  # the dispatcher starts while the following runs
            _check_storage(settings)
            bound = listener.getsockname()[1]
            folder = settings.data_dir.absolute()
            url = f"http://{settings.host}:{bound}/"
            if lock is not None:
                lock.describe_holder(f"`lagid serve` at {url} (process {os.getpid()})")
            out.print(
                f"lagid serves {url} (data in {folder}); Ctrl-C ends it",
                soft_wrap=True,
            )
            _run_server(settings, listener, supervisor)


def run_dispatcher(data_dir: DataDir = None, cpus: Cpus = None) -> None:
    """Claim jobs and compute them until stopped (`serve` starts a dispatcher itself)."""
    settings = load_settings(data_dir=data_dir, cpus=cpus)
    _prepare_data_folder(settings)
    from service.core.process.folder_lock import use_folder
    from service.dispatch.process import run_process

    with use_folder(settings.data_dir):
        raise typer.Exit(run_process(settings))


def lock_data_folder(
    settings: "Settings", *, with_dispatcher: bool
) -> "AbstractContextManager[FolderLock | None]":
    """Lock the data folder for a dispatcher. Web processes without one may share a folder."""
    from service.core.process.folder_lock import lock_folder

    if not with_dispatcher:
        return nullcontext()
    advice = "a second one with --no-dispatcher only serves pages, and --data-dir names another"
    return lock_folder(settings.data_dir, advice)


def _prepare_data_folder(settings: "Settings") -> None:
    """Create the data folder if needed, and tell if other users can read it."""
    settings.prepare_data_folder()
    warning = settings.describe_open_files()
    if warning is not None:
        err.print(f"warning: {warning}", markup=False, soft_wrap=True)


def load_settings(**options: Any) -> "Settings":
    """Read settings from the environment; options override them.

    Raises
    ------
    Misconfigured
        If a setting is invalid; the message names its variable. Or if lagid is installed without
        the libraries of a server.
    """
    check_extra("server", "this command")
    from pydantic import ValidationError

    from service.core.bodies.validation import describe_error
    from service.core.settings import Settings

    try:
        return Settings(**{name: value for name, value in options.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        name = "_".join(str(part) for part in first["loc"]).upper()
        raise Misconfigured(f"LAGID_{name}: {describe_error(first, ())}") from None


def open_listener(host: str, port: int) -> socket.socket:
    """Open a socket that listens on this host and port.

    Raises
    ------
    Misconfigured
        If the port is in use or not allowed, or the host has no such address.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with ExitStack() as stack:
            listener = stack.enter_context(socket.socket(family, kind, protocol))
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(128)
            stack.pop_all()  # it stays open
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise Misconfigured(
                f"port {port} of {host} is in use; choose another with --port (0: any free port)"
            ) from None
        raise Misconfigured(f"cannot listen on {host}:{port}: {error.strerror}") from None
    return listener


def _run_server(
    settings: "Settings", listener: socket.socket, supervisor: "Supervisor | None"
) -> None:
    import asyncio

    import uvicorn

    from service.api.app import create_app
    from service.api.connections import limit_connections, tell_accept_errors_seldom
    from service.core.process.logs import configure_logging
    from service.core.process.loop_watch import LoopWatch, end_if_standing
    from service.dispatch.supervisor import RESTART_EXIT_CODE

    configure_logging(settings.log_format, logging.WARNING, with_access=settings.writes_access_log)
    app = create_app(settings)

    loop, ending = LoopWatch(), threading.Event()
    end_if_standing(loop, ending, partial(os._exit, RESTART_EXIT_CODE))

    class Server(uvicorn.Server):
        """Server that stops open event streams and the dispatcher as soon as it must end."""

        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            tell_accept_errors_seldom(asyncio.get_running_loop())
            await super().startup(sockets)

        async def on_tick(self, counter: int) -> bool:
            loop.turn()
            return await super().on_tick(counter)

        def handle_exit(self, sig: int, frame: FrameType | None) -> None:
            _end_in_time(sig)
            ending.set()
            if supervisor is not None:
                threading.Thread(target=supervisor.stop, name="end").start()
            parts = getattr(app.state, "parts", None)
            if parts is not None:
                parts.stopping.set()
            super().handle_exit(sig, frame)

    config = uvicorn.Config(
        app,
        log_config=None,  # its loggers pass their lines on to ours
        log_level="warning",
        access_log=False,
        proxy_headers=False,  # the application believes them, of the proxies in its settings
        timeout_graceful_shutdown=SHUTDOWN_SECONDS,
    )
    limit_connections(config, settings.max_connections)
    Server(config).run(sockets=[listener])


def _check_storage(settings: "Settings") -> None:
    """Open the database and the object store once, so that a failure prints one line."""
    with _open_checked_storage(settings):
        pass


@contextmanager
def _open_checked_storage(settings: "Settings") -> Iterator["Database"]:
    """Open the database and the object store.

    Raises
    ------
    Misconfigured, StorageError
        If one of them cannot be opened.
    """
    from sqlalchemy.exc import SQLAlchemyError

    from service.storage.open_storage import open_storage

    try:
        database, _ = open_storage(settings)
    except SQLAlchemyError as error:
        reason = str(error).splitlines()[0]
        raise Misconfigured(
            f"the database cannot be opened: {reason}. Check that its server runs and that "
            "LAGID_DATABASE_URL is right."
        ) from None
    try:
        yield database
    finally:
        database.dispose()


def _check_access(settings: "Settings") -> None:
    """Refuse to ask for keys while there is none, and to let in users of no project.

    Raises
    ------
    Misconfigured
        With what to do.
    """
    if settings.auth_mode == "off":
        return
    from service.repositories.key_rows import KeyRepository
    from service.repositories.project_rows import ProjectRepository
    from service.storage.storage_errors import RowNotFound

    with _open_checked_storage(settings) as database, database.read_session() as session:
        if settings.auth_mode == "proxy":
            try:
                ProjectRepository(session).get(settings.proxy_project)
            except RowNotFound as error:
                raise Misconfigured(f"LAGID_PROXY_PROJECT: {error}") from None
        elif not KeyRepository(session, None).has_valid():
            raise Misconfigured(
                f"requests to {settings.host} need an API key, and there is none. Create one with "
                "`lagid key create NAME` on this data folder, or serve on 127.0.0.1 without keys. "
                "LAGID_ALLOW_OPEN_HOST=true lets everybody in."
            )


def _exit_on_signals() -> None:
    """End by an exception, so that resources are closed; uvicorn raises the signal again."""

    def end(number: int, _frame: FrameType | None) -> None:
        _end_in_time(number)
        raise SystemExit(0)

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)


def _end_in_time(number: int) -> None:
    """End the process `END_SECONDS` after a signal, even if a thread waits for ever."""

    def end() -> None:
        standing = ", ".join(sorted(thread.name for thread in threading.enumerate()))
        _log.error("the process is ended %g s after signal %d: %s", END_SECONDS, number, standing)
        os._exit(128 + number)  # the code of a process that a signal has ended

    timer = threading.Timer(END_SECONDS, end)
    timer.daemon = True
    timer.start()


database_app = typer.Typer(help="Upgrade and check the database.", no_args_is_help=True)

LIBRARY_PACKAGES = ("numpy", "scipy", "numba", "mcap")
SERVER_PACKAGES = ("ray", "fastapi", "sqlalchemy", "obstore")
Sample = Annotated[
    float, typer.Option(min=0.0, max=1.0, help="Share of the objects that are read, at random.")
]
Fix = Annotated[bool, typer.Option("--fix", help="Delete objects that no row refers to.")]


@database_app.command("upgrade", epilog=show_examples("lagid db upgrade"))
def upgrade_database(data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """Create the tables, or upgrade them to this version."""
    settings = load_settings(data_dir=data_dir)
    from service.storage import migrate

    settings.prepare_data_folder()
    with open_database(settings) as database:
        migrate.upgrade_database(database)
        _print_revision(migrate.read_current_revision(database), as_json)


@database_app.command("downgrade", epilog=show_examples("lagid db downgrade v1"))
def downgrade_database(
    revision: Annotated[str, typer.Argument(help="Earlier revision, or base: no tables at all.")],
    data_dir: DataDir = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    as_json: AsJson = False,
) -> None:
    """Go back to the tables of an earlier version; what only later ones can store is lost."""
    settings = load_settings(data_dir=data_dir)
    from service.storage import migrate

    require_database(settings)
    settings.prepare_data_folder()
    with (
        lock_data_folder(settings, with_dispatcher=True),
        open_database(settings) as database,
    ):
        undone = migrate.list_undone_migrations(database, revision)
        told = err if as_json else out
        for name, description in undone:
            told.print(f"undoes {name}: {description}", markup=False)
        lost = "all of its data" if revision == "base" else "what only these revisions store"
        told.print(f"The database loses {lost}. Stop all dispatchers, and back it up first.")
        if not yes:
            ask_to_go_on("Go on?", "nothing was done, because nobody can answer here; add --yes")
        migrate.downgrade_database(database, revision)
        _print_revision(revision, as_json)


def _print_revision(revision: str | None, as_json: bool) -> None:
    if as_json:
        print_json({"revision": revision})
    else:
        out.print(f"the database is at revision {revision}", markup=False)


def require_database(settings: "Settings") -> None:
    """Refuse to go on if the data folder has no database.

    Raises
    ------
    Misconfigured
        With what to do.
    """
    if settings.database_url is None and not (settings.data_dir / "lagid.db").is_file():
        raise Misconfigured(
            f"there is no database in {settings.data_dir.absolute()}. Create one with "
            "`lagid serve` or `lagid db upgrade`, or name another folder with --data-dir."
        )


@database_app.command(
    "check",
    epilog=show_examples("lagid db check", "lagid db check --sample 0.05", "lagid db check --fix"),
)
def check_database(
    data_dir: DataDir = None, sample: Sample = 1.0, fix: Fix = False, as_json: AsJson = False
) -> None:
    """Check database and store: damage, lost objects, objects that no row refers to."""
    settings = load_settings(data_dir=data_dir)
    from service.storage import garbage, integrity, migrate
    from service.storage.objects import open_store

    require_database(settings)
    with open_database(settings) as database:
        faults = integrity.find_faults(database)
        for fault in faults:
            err.print(f"the database is damaged: {fault}", markup=False)
        migrate.check_revision(database)
        store = open_store(settings.store_location)
        read = dict(garbage.find_damaged(store, sample))
        damaged = sorted(sha256 for sha256, is_damaged in read.items() if is_damaged)
        with database.read_session() as session:
            lost = sorted(garbage.find_lost_hashes(session, store))
            n_orphans = sum(1 for _ in garbage.find_orphans(session, store))
        n_deleted, freed = garbage.delete_orphans(database, store) if fix else (0, 0)
    if as_json:
        found = {"database": faults, "read": len(read), "damaged": damaged, "lost": lost}
        counts = {"without_row": n_orphans, "deleted": n_deleted, "freed_bytes": freed}
        print_json({**found, **counts})
    else:
        if fix:
            out.print(f"deleted {n_deleted} objects, {freed} bytes")
        out.print(
            f"tables at head; {len(read)} objects read, {len(damaged)} damaged; {len(lost)} lost; "
            f"{n_orphans} without a row"
        )
        for sha256 in damaged:
            err.print(f"damaged: {sha256}", markup=False)
        for sha256 in lost:
            err.print(f"lost: {sha256}", markup=False)
    if faults or damaged or lost:
        raise typer.Exit(1)


Deep = Annotated[
    bool,
    typer.Option(
        "--deep",
        help="Also a drill of a minute: a job, a worker that dies, a backup and its restoration.",
    ),
]


def check_installation(
    data_dir: DataDir = None, deep: Deep = False, as_json: AsJson = False
) -> None:
    """Check the installation: packages, kernels, data folder, port."""
    checks: list[tuple[str, Callable[[], str]]] = [
        ("Python", _check_python),
        ("packages", lambda: _list_versions(LIBRARY_PACKAGES)),
        ("kernels", _check_kernels),
    ]
    if list_missing("server"):
        checks.append(("server", lambda: "not installed: pip install 'lagid[server]' adds it"))
    else:
        settings = load_settings(data_dir=data_dir)
        checks += [
            ("server", lambda: _list_versions(SERVER_PACKAGES)),
            ("data folder", lambda: _check_folder(settings)),
            ("port", lambda: _check_port(settings)),
        ]
    with ExitStack() as used:
        if deep:
            check_extra("server", "`lagid doctor --deep`")
            from service.cli.drill import Drill

            drill = used.enter_context(Drill(load_settings(data_dir=data_dir)))
            checks += [
                ("drill: start", drill.start_service),
                ("drill: a worker dies", drill.survive_kill),
                ("drill: backup", drill.restore_backup),
            ]
        found = _carry_out(checks, as_json=as_json)
    if as_json:
        print_json(found)
    if not all(entry["ok"] for entry in found):
        raise typer.Exit(1)


def _carry_out(
    checks: Sequence[tuple[str, Callable[[], str]]], *, as_json: bool
) -> list[dict[str, Any]]:
    """Carry out the checks, each after the other, and tell of each unless that is left to JSON."""
    found: list[dict[str, Any]] = []
    for name, look in checks:
        try:
            found.append({"check": name, "ok": True, "detail": look()})
        except (ServiceError, ImportError, OSError, ArithmeticError) as error:
            found.append({"check": name, "ok": False, "detail": str(error)})
        if not as_json:
            _print_check(**found[-1])
    return found


def _print_check(check: str, ok: bool, detail: str) -> None:
    if ok:
        out.print(f"ok      {check}: {detail}", markup=False, soft_wrap=True)
    else:
        err.print(f"failed  {check}: {detail}", markup=False)


@contextmanager
def open_database(settings: "Settings") -> Iterator["Database"]:
    """Open the database until the command ends.

    Raises
    ------
    Unavailable
        If it does not answer; the message has one line.
    """
    from sqlalchemy.exc import SQLAlchemyError

    from service.storage.sessions import Database

    database = Database(settings.database_location)
    try:
        yield database
    except SQLAlchemyError as error:
        reason = str(error).splitlines()[0]
        raise Unavailable(f"the database cannot be used: {reason}") from error
    finally:
        database.dispose()


def _check_python() -> str:
    return sys.version.split()[0]


def _list_versions(packages: tuple[str, ...]) -> str:
    return ", ".join(f"{name} {version(name)}" for name in packages)


def _check_kernels() -> str:
    """Compile a model and simulate it: without force, the oscillator stays at rest."""
    import numpy as np

    from sysid.data.records import Channel
    from sysid.models.catalogue.load import load_model
    from sysid.simulation.simulate import simulate

    model = load_model("duffing-eq16")
    times = np.arange(20, dtype=np.float64) * 0.02
    force = Channel("q", times, np.zeros(20))
    values = {p.name: p.lower for p in model.parameters}
    rest = simulate(model, [force], values, times=times).channels[-1].values
    if np.any(rest != 0.0):
        raise ArithmeticError("a system at rest moves without a force; the compiler is faulty")
    return "compiled, and a system at rest stays at rest"


def _check_folder(settings: "Settings") -> str:
    folder = settings.data_dir.absolute()
    if folder.is_dir():
        settings.prepare_data_folder()
        return "; ".join(filter(None, (str(folder), settings.describe_open_files())))
    above = next(parent for parent in folder.parents if parent.is_dir())
    _check_writable(above)
    return f"{folder} (will be created)"


def _check_writable(folder: Path) -> None:
    try:
        with TemporaryDirectory(dir=folder):
            return
    except OSError as error:
        raise Misconfigured(f"{folder} is not writable ({error.strerror})") from error


def _check_port(settings: "Settings") -> str:
    with open_listener(settings.host, settings.port):
        return f"{settings.host}:{settings.port} is free"
