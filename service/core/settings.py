"""Settings of the service, from the environment (``LAGID_…``) or the file ``lagid.env``."""

import stat
from ipaddress import IPv4Network, IPv6Network, ip_address, ip_network
from pathlib import Path
from tempfile import TemporaryFile
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from service.core.errors import Misconfigured
from service.core.process.logs import LogFormat
from sysid.core.machine import read_memory_bytes

READERS_SHARE = 0.6
"""Share of the memory for all readers of uploads: 3 GiB of 5 GiB, beside 1 GiB of the web process
and the compiler's."""


def make_sqlite_url(path: Path) -> str:
    """Return the address of a SQLite file."""
    return f"sqlite:///{path.absolute()}"


def _split_names(value: Any) -> Any:
    """Split names separated by commas, as an environment variable holds them."""
    if not isinstance(value, str):
        return value
    return [name.strip().lower() for name in value.split(",") if name.strip()]


def _strip_slash(value: Any) -> Any:
    """Strip the slash at the end of a path."""
    return value.rstrip("/") if isinstance(value, str) else value


Names = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_split_names)]
AuthMode = Literal["off", "keys", "proxy"]


class Settings(BaseSettings):
    """Storage, address, limits and habits of the service.

    The texts below the fields are the page ``docs/settings.md`` (``make docs``).
    """

    model_config = SettingsConfigDict(
        env_prefix="LAGID_", env_file="lagid.env", extra="ignore", use_attribute_docstrings=True
    )

    data_dir: Path = Path("lagid-data")
    """Folder of database, objects and logs. May be relative."""
    database_url: str | None = None
    """SQLAlchemy address of the database, such as `postgresql+psycopg://…`. Without it: SQLite in
    the data folder."""
    store_url: str | None = None
    """Where objects are: `s3://bucket/prefix` or `file:///folder`. Without it: `objects` in the
    data folder."""
    host: str = "127.0.0.1"
    """Address where the web process listens."""
    port: int = Field(default=8000, ge=0, le=65535)
    """Port of the web process. 0 chooses a free one."""
    auth: AuthMode | None = None
    """Who may use the service. `off`: everybody who reaches it. `keys`: whoever sends an API key.
    `proxy`: a key, or a user whom an authenticating proxy names. Without it: `off` on loopback,
    else `keys`."""
    allow_open_host: bool = False
    """Serve other hosts without API keys. Only where nobody else reaches the port."""
    proxy_header: str = Field(default="X-Forwarded-User", pattern=r"^[A-Za-z0-9-]+$")
    """Header in which an authenticating proxy names the user."""
    proxy_addresses: Names = ("127.0.0.1", "::1")
    """Addresses or networks of proxies, separated by commas. Headers of others are not believed."""
    proxy_project: str = "proj_default"
    """Project of the users whom the proxy names."""
    proxy_admins: Names = ()
    """Users of the proxy with the scope admin, separated by commas."""
    session_hours: float = Field(default=12.0, gt=0, le=8760)
    """How long a browser stays signed in."""
    allowed_hosts: Names = ()
    """More host names that are answered, separated by commas, such as that of a reverse proxy."""
    root_path: Annotated[
        str, BeforeValidator(_strip_slash), Field(pattern=r"^(/[A-Za-z0-9._~-]+)*$")
    ] = ""
    """Path below which a reverse proxy publishes the service, such as `/lagid`."""
    max_upload_bytes: int = Field(default=2 * 1024**3, ge=1)
    """Largest recording. A larger one is answered by 413."""
    max_body_bytes: int = Field(default=4 * 1024**2, ge=1)
    """Largest body of any other request; 413 beyond. About 40,000 labelled values of a sweep have
    room. In any case 100,000 lists and objects with 200,000 fields are the most. A body that stops
    for 60 s, or sends fewer than 500 bytes a second after its first 20 s, is answered by 408."""
    max_uploads: int = Field(default=4, ge=1)
    """Uploads that one web process reads at once, each for at most 120 s, and that a project sends
    at once. Simulations of more than two million steps, and derivations of more than two million
    values, take these places too. Projects share the places, and one project has all but one at
    most. Others wait, and are answered by 503 after 20 s."""
    reader_memory_mb: int | None = Field(default=None, ge=512)
    """Memory of the reader of an upload, in MiB, and of a child that simulates or derives in its
    place. Without it: a share of 60 % of the machine or the container, 4 GiB at most."""
    max_connections: int = Field(default=1000, ge=1)
    """Connections of one web process, within its limit of open files. Beyond, one without a request
    makes room, else 503. The head of a request must come within 20 s."""
    max_streams: int = Field(default=500, ge=1)
    """Event streams of one web process; 503 beyond."""
    max_runs_per_job: int = Field(default=100_000, ge=1)
    """Runs of one job."""
    max_open_jobs: int = Field(default=1000, ge=1)
    """Unfinished jobs of a project; 429 beyond."""
    max_open_runs: int = Field(default=1_000_000, ge=1)
    """Unfinished runs of a project; 429 beyond."""
    poll_seconds: float = Field(default=0.3, gt=0)
    """How often the web process looks for news, once for all event streams."""
    ray_address: str | None = None
    """Head of the Ray cluster that the dispatcher joins, `host:port` or `auto`. Without it: a local
    Ray."""
    cpus: int | None = Field(default=None, ge=1)
    """Workers of the local Ray, or cores that are used of a joined one at most. Without it: all
    cores."""
    worker_memory_mb: int | None = Field(default=None, ge=256)
    """Memory that a worker may use for its runs, in MiB. Without it: its share of 80 % of the
    machine."""
    project_cores: int | None = Field(default=None, ge=1)
    """Cores that one project may use of a dispatcher. Without it: all."""
    keep_days: float | None = Field(default=None, gt=0, le=36_500)
    """Ended jobs are deleted after this number of days, unless their project says otherwise
    (`lagid db keep`). Without it: they are kept."""
    keep_audit_days: float | None = Field(default=None, gt=0, le=36_500)
    """Entries of the audit log are deleted after this number of days. Without it: they are kept."""
    scrub_days: float = Field(default=30.0, ge=0, le=36_500)
    """Each stored object is read once in this number of days, to find damage. 0: none is."""
    keep_signals: bool = False
    """Whether sweeps store fitted signals, unless a job says otherwise (`keep_signals`). Else they
    are computed again when they are asked for."""
    lease_seconds: float = Field(default=10.0, gt=0)
    """After this time a silent dispatcher loses its jobs."""
    max_attempts: int = Field(default=3, ge=1)
    """Losses of the dispatcher without progress, after which a job fails."""
    start_seconds: float = Field(default=900.0, ge=30)
    """How long a dispatcher waits for Ray, and then for its workers, before it starts anew."""
    log_format: LogFormat = "text"
    """Form of the log lines: `text` for people, `json` for machines."""
    access_log: bool | None = None
    """Whether each request has a log line. Without it: with `json` only."""
    metrics_host: str = "127.0.0.1"
    """Address where a dispatcher answers Prometheus."""
    metrics_port: int | None = Field(default=None, ge=1, le=65535)
    """Port where a dispatcher answers Prometheus. Without it: nowhere. The web process has
    `/metrics` in any case."""
    data: Path | None = None
    """Folder of measured records, for tests and benchmarks."""

    @field_validator("database_url")
    @classmethod
    def _resolve_sqlite_path(cls, url: str | None) -> str | None:
        """Make the path of a SQLite file absolute, for processes that work in another folder."""
        path = (url or "").removeprefix("sqlite:///")
        if path == (url or "") or not path or path.startswith(("/", ":memory:", "file:")):
            return url
        return f"sqlite:///{Path(path).absolute()}"

    @field_validator("proxy_addresses")
    @classmethod
    def _check_addresses(cls, addresses: tuple[str, ...]) -> tuple[str, ...]:
        for address in addresses:
            ip_network(address, strict=False)
        return addresses

    @property
    def auth_mode(self) -> AuthMode:
        """Who may use the service: everybody, or whoever has a key or is named by a proxy."""
        if self.auth is not None:
            return self.auth
        return "off" if is_loopback(self.host) or self.allow_open_host else "keys"

    @property
    def proxy_networks(self) -> tuple[IPv4Network | IPv6Network, ...]:
        """Networks of the proxies whose headers are believed."""
        return tuple(ip_network(address, strict=False) for address in self.proxy_addresses)

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
    def reader_memory_bytes(self) -> int:
        """Memory of the reader of an upload, in bytes: all readers at once leave room for others.

        Below 512 MiB the libraries of the reader cannot even be loaded.
        """
        if self.reader_memory_mb is not None:
            return self.reader_memory_mb * 2**20
        share = int(READERS_SHARE * read_memory_bytes() / self.max_uploads)
        return min(4 * 2**30, max(512 * 2**20, share))

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
        """Refuse to serve other hosts without API keys, unless that is said twice.

        Raises
        ------
        Misconfigured
            If the host is not loopback, keys are off, and `allow_open_host` is not set.
        """
        if self.auth_mode == "off" and not is_loopback(self.host) and not self.allow_open_host:
            raise Misconfigured(
                f"host {self.host} can be reached from other machines, and LAGID_AUTH=off asks "
                "for no API keys. Set LAGID_AUTH=keys, or LAGID_ALLOW_OPEN_HOST=true if others "
                "may do everything."
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
