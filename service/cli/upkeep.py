"""`lagid db …` and `lagid doctor`."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.common import err, out
from service.cli.serving import DataDir, listening, settings_of
from service.errors import Misconfigured, Unavailable

if TYPE_CHECKING:
    from service.settings import Settings
    from service.storage.sessions import Database

database = typer.Typer(help="The tables of the database.", no_args_is_help=True)

NEEDED = ("numpy", "scipy", "numba", "ray", "fastapi", "sqlalchemy", "obstore", "mcap")
Fix = Annotated[bool, typer.Option("--fix", help="Delete the objects that no row names.")]


@database.command()
def upgrade(data_dir: DataDir = None) -> None:
    """Create the tables, or bring them to this version."""
    from service.storage import migrate

    settings = settings_of(data_dir=data_dir)
    settings.prepare_folder()
    with opened(settings) as found:
        migrate.upgrade(found)
        out.print(f"the database is at revision {migrate.current(found)}", markup=False)


@database.command()
def check(data_dir: DataDir = None, fix: Fix = False) -> None:
    """Compare database and store: the revision, lost objects, objects that no row names."""
    from service.storage import garbage, migrate
    from service.storage.objects import open_store

    settings = settings_of(data_dir=data_dir)
    if settings.database_url is None and not (settings.data_dir / "lagid.db").is_file():
        raise Misconfigured(
            f"there is no database in {settings.data_dir.absolute()}; `lagid serve` or "
            "`lagid db upgrade` makes one, or name another folder with --data-dir"
        )
    with opened(settings) as found:
        migrate.check(found)
        store = open_store(settings.store)
        with found.read() as session:
            lost = garbage.lost(session, store)
            orphans = list(garbage.orphans(session, store))
            if fix:
                freed = garbage.collect(session, store)
                out.print(f"deleted {len(orphans)} objects, {freed} bytes")
    out.print(f"tables at head; {len(lost)} objects lost; {len(orphans)} objects without a row")
    for sha256 in sorted(lost):
        err.print(f"lost: {sha256}", markup=False)
    if lost:
        raise typer.Exit(1)


def doctor(data_dir: DataDir = None) -> None:
    """Check the installation: packages, kernels, data folder, port."""
    settings = settings_of(data_dir=data_dir)
    checks: list[tuple[str, Callable[[], str]]] = [
        ("Python", _python),
        ("packages", _packages),
        ("kernels", _kernels),
        ("data folder", lambda: _folder(settings)),
        ("port", lambda: _port(settings)),
    ]
    failed = False
    for name, look in checks:
        try:
            out.print(f"ok      {name}: {look()}", markup=False, soft_wrap=True)
        except (Misconfigured, ImportError, OSError, ArithmeticError) as error:
            failed = True
            err.print(f"failed  {name}: {error}", markup=False)
    if failed:
        raise typer.Exit(1)


@contextmanager
def opened(settings: "Settings") -> Iterator["Database"]:
    """The database, for the length of a command.

    Raises
    ------
    Unavailable
        In one line, if it does not answer.
    """
    from sqlalchemy.exc import SQLAlchemyError

    from service.storage.sessions import Database

    found = Database(settings.database)
    try:
        yield found
    except SQLAlchemyError as error:
        reason = str(error).splitlines()[0]
        raise Unavailable(f"the database cannot be used: {reason}") from error
    finally:
        found.dispose()


def _python() -> str:
    return sys.version.split()[0]


def _packages() -> str:
    return ", ".join(f"{name} {version(name)}" for name in NEEDED)


def _kernels() -> str:
    """Compile a model and simulate it: the harmonic oscillator without force rests."""
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
        raise ArithmeticError("a system at rest without a force moves: the compiler is at fault")
    return "compiled, and a system at rest stays at rest"


def _folder(settings: "Settings") -> str:
    folder = settings.data_dir.absolute()
    if folder.is_dir():
        settings.prepare_folder()
        return str(folder)
    above = next(parent for parent in folder.parents if parent.is_dir())
    _probe(above)
    return f"{folder} (will be made)"


def _probe(folder: Path) -> None:
    try:
        with TemporaryDirectory(dir=folder):
            return
    except OSError as error:
        raise Misconfigured(f"{folder} is not writable ({error.strerror})") from error


def _port(settings: "Settings") -> str:
    with listening(settings.host, settings.port):
        return f"{settings.host}:{settings.port} is free"
