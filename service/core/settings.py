"""Settings of the service, from the environment (``LAGID_…``) or the file ``lagid.env``."""

import stat
from ipaddress import ip_address
from pathlib import Path
from tempfile import TemporaryFile
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from service.core.errors import Misconfigured
from service.core.logs import LogFormat


def make_sqlite_url(path: Path) -> str:
    """Return the address of a SQLite file."""
    return f"sqlite:///{path.absolute()}"


def _split_names(value: Any) -> Any:
    """Split names separated by commas, as an environment variable holds them."""
    if not isinstance(value, str):
        return value
    return [name.strip().lower() for name in value.split(",") if name.strip()]


class Settings(BaseSettings):
    """Storage, address and limits of the service.

    Attributes
    ----------
    data_dir : Path
        Folder of everything that the embedded service stores.
    database_url, store_url : str or None
        None: SQLite and a folder of objects inside `data_dir`.
    ray_address : str or None
        None: a local Ray cluster, started by this process.
    cpus : int or None
        Workers of the local Ray; None: all cores.
    worker_memory_mb : int or None
        Memory of a worker for its runs, in MiB; None: its share of 80 % of the machine.
    require_keys : bool or None
        None: API keys are off on loopback and required elsewhere.
    allow_open_host : bool
        Serve other hosts although this version has no API keys yet.
    allowed_hosts : tuple of str
        More names by which requests may address the service, such as that of a reverse proxy.
    max_upload_bytes, max_body_bytes : int
        Longest recording, and longest body of any other request. Larger ones are answered by 413.
    max_uploads : int
        Uploads that a web process receives and reads at once. A further one waits for 20 s, and is
        then answered by 503.
    max_streams : int
        Event streams of one web process. A further one is answered by 503.
    max_open_jobs, max_open_runs : int
        Unfinished jobs and runs of one project. A submission beyond them is answered by 429.
    project_cores : int or None
        Cores of each dispatcher that the runs of one project may use; None: all.
    keep_signals : bool
        Whether sweeps store the fitted signals of their runs, unless a job says otherwise. Else
        they are computed again when they are asked for.
    lease_seconds : float
        How long a job stays with a dispatcher that sends no heartbeat.
    start_seconds : float
        How long a dispatcher waits for Ray and its workers to start, before it starts anew.
    log_format : {"text", "json"}
        Form of the log lines.
    access_log : bool or None
        Whether each request has a log line; None: with JSON only.
    metrics_host, metrics_port : str, int or None
        Where a dispatcher answers Prometheus; None: nowhere. The web process has `/metrics`.
    data : Path or None
        Folder of measured records, for tests and benchmarks.
    """

    model_config = SettingsConfigDict(env_prefix="LAGID_", env_file="lagid.env", extra="ignore")

    data_dir: Path = Path("lagid-data")
    database_url: str | None = None
    store_url: str | None = None
    ray_address: str | None = None
    cpus: int | None = Field(default=None, ge=1)
    worker_memory_mb: int | None = Field(default=None, ge=256)
    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, le=65535)
    require_keys: bool | None = None
    allow_open_host: bool = False
    allowed_hosts: Annotated[tuple[str, ...], NoDecode, BeforeValidator(_split_names)] = ()
    max_upload_bytes: int = Field(default=2 * 1024**3, ge=1)
    max_body_bytes: int = Field(default=4 * 1024**2, ge=1)
    max_uploads: int = Field(default=4, ge=1)
    max_streams: int = Field(default=500, ge=1)
    max_runs_per_job: int = Field(default=100_000, ge=1)
    max_open_jobs: int = Field(default=1000, ge=1)
    max_open_runs: int = Field(default=1_000_000, ge=1)
    project_cores: int | None = Field(default=None, ge=1)
    keep_signals: bool = False
    lease_seconds: float = Field(default=10.0, gt=0)
    max_attempts: int = Field(default=3, ge=1)
    poll_seconds: float = Field(default=0.3, gt=0)
    start_seconds: float = Field(default=900.0, ge=30)
    log_format: LogFormat = "text"
    access_log: bool | None = None
    metrics_host: str = "127.0.0.1"
    metrics_port: int | None = Field(default=None, ge=1, le=65535)
    data: Path | None = None

    @field_validator("database_url")
    @classmethod
    def _resolve_sqlite_path(cls, url: str | None) -> str | None:
        """Make the path of a SQLite file absolute, for processes that work in another folder."""
        path = (url or "").removeprefix("sqlite:///")
        if path == (url or "") or not path or path.startswith(("/", ":memory:", "file:")):
            return url
        return f"sqlite:///{Path(path).absolute()}"

    @property
    def database_location(self) -> str:
        """SQLAlchemy address of the database."""
        return self.database_url or make_sqlite_url(self.data_dir / "lagid.db")

    @property
    def writes_access_log(self) -> bool:
        """Whether each request has a log line."""
        return self.log_format == "json" if self.access_log is None else self.access_log

    @property
    def worker_memory_bytes(self) -> int | None:
        """Memory of a worker in bytes."""
        return None if self.worker_memory_mb is None else self.worker_memory_mb * 2**20

    @property
    def store_location(self) -> str:
        """Address of the object store."""
        return self.store_url or (self.data_dir.absolute() / "objects").as_uri()

    def is_served_host(self, name: str) -> bool:
        """Return whether a request may address the service by this name or address.

        These are the names and addresses of loopback, the host it listens on, and `allowed_hosts`.
        If it listens for other machines, any address is served: only a name can be rebound.
        """
        if is_loopback(name) or (name and name in (self.host.lower(), *self.allowed_hosts)):
            return True
        return not is_loopback(self.host) and _is_address(name)

    def prepare_data_folder(self) -> None:
        """Create the data folder, for this user only, if it does not exist.

        Raises
        ------
        Misconfigured
            If it cannot be created or written to.
        """
        folder = self.data_dir.absolute()
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with TemporaryFile(dir=folder):
                pass  # only an attempt shows it: permissions, a full disk, a read-only file system
        except OSError as error:
            raise Misconfigured(
                f"the data folder {folder} is not writable ({error.strerror}); "
                "choose another with --data-dir"
            ) from error

    def describe_open_files(self) -> str | None:
        """Describe in one line what other users of this machine can read; None if nothing.

        Modes of existing files are never changed: their owner may share them on purpose.
        """
        folder = self.data_dir.absolute()
        database = Path(self.database_location.removeprefix("sqlite:///"))
        for path, closed in ((folder, 0o700), (database, 0o600)):
            if path is database and folder in database.parents:
                continue  # the folder decides
            mode = stat.S_IMODE(path.stat().st_mode) if path.exists() else 0
            if mode & 0o077:
                return (
                    f"other users of this machine may reach {path} (mode {mode:o}); "
                    f"`chmod {closed:o} {path}` closes it"
                )
        return None

    def check_exposure(self) -> None:
        """Refuse to serve other hosts without API keys.

        Raises
        ------
        Misconfigured
            If the host is not loopback, or keys are required: this version has no API keys.
        """
        if self.require_keys:
            raise Misconfigured("this version has no API keys yet; unset LAGID_REQUIRE_KEYS")
        if not is_loopback(self.host) and not self.allow_open_host:
            raise Misconfigured(
                f"host {self.host} can be reached from other machines, and this version has no "
                "API keys yet. Serve on 127.0.0.1, or set LAGID_ALLOW_OPEN_HOST=true if an "
                "authenticating reverse proxy is in front of it."
            )


def is_loopback(host: str) -> bool:
    """Return whether a host name or address can be reached from this machine only."""
    if host == "localhost" or host.endswith(".localhost"):
        return True
    return _is_address(host) and ip_address(host).is_loopback


def _is_address(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:
        return False
    return True
