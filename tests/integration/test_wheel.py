"""The wheel: what is in it, and that it works on each Python, in an environment of its own."""

import email
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest

from service.client.embedded import find_free_port
from tests.support.checkout import ROOT
from tests.support.requirements import report_missing
from tests.support.service.web_app import recording
from tests.support.session_guard import SESSION_VARIABLE

pytestmark = pytest.mark.slow  # it builds a wheel

PYTHONS = ("3.11", "3.12", "3.13")
LIMIT_SECONDS = 900.0  # libraries are fetched, and the search is compiled


def list_tracked_files() -> list[str]:
    listing = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [name for name in listing.stdout.split("\0") if name and (ROOT / name).is_file()]


def list_image_files() -> dict[str, str]:
    """Files that the image's build copies, by their places there: all that its wheel is made of."""
    dockerfile = (ROOT / "docker/Dockerfile").read_text()
    ignored = re.compile(
        "|".join(map(to_pattern, (ROOT / ".dockerignore").read_text().splitlines()))
    )
    kept = [name for name in list_tracked_files() if not ignored.match(name)]
    files = {}
    for words in re.findall(r"^COPY (?!--from)(.+)$", dockerfile, re.MULTILINE):
        *sources, target = words.split()
        for source in sources:
            found = {name: name.removeprefix(source) for name in kept if is_below(name, source)}
            assert found, f"{source} is left out by .dockerignore"
            for name, rest in found.items():
                place = f"{target}/{Path(source).name}" if target.endswith("/") else target
                files[os.path.normpath(f"{place}{rest}")] = name
    return files


def is_below(name: str, folder: str) -> bool:
    return name == folder or name.startswith(f"{folder}/")


def to_pattern(line: str) -> str:
    """The pattern of a line of ``.dockerignore``: what it names, and all below."""
    path = line.replace(".", r"\.").replace("**/", "(?:.+/)?").replace("*", "[^/]*")
    return f"{path}(/|$)"


def build_wheel(files: Mapping[str, str], source: Path, target: Path) -> Path:
    """Build the wheel of some files by the tools that are here; a file by its place."""
    for place, name in files.items():
        (source / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, source / place)
    options = ("--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check")
    built = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", *options, "-w", target, source],
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    (path,) = target.iterdir()
    return path


@pytest.fixture(scope="module")
def tracked_wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of the checkout."""
    files = {name: name for name in list_tracked_files()}
    return build_wheel(files, tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def image_wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of what `docker/Dockerfile` copies."""
    files = list_image_files()
    return build_wheel(files, tmp_path_factory.mktemp("image"), tmp_path_factory.mktemp("wheel"))


@pytest.fixture(params=["tracked_wheel", "image_wheel"])
def wheel(request: pytest.FixtureRequest) -> Path:
    path: Path = request.getfixturevalue(request.param)
    return path


def test_the_image_copies_nothing_that_is_left_out() -> None:
    files = list_image_files()
    assert {"pyproject.toml", "server.lock", "requirements.lock", "lagid/__init__.py"} <= {*files}
    assert not [name for name in files if name.startswith(("tests/", "docs/site/", "benchmarks/"))]
    assert re.match(to_pattern("**/__pycache__"), "service/api/__pycache__/a.pyc")
    assert not re.match(to_pattern("build"), "builder/a")


def test_the_wheel_holds_all_that_runs_and_no_tests(wheel: Path) -> None:
    with ZipFile(wheel) as archive:
        names = set(archive.namelist())
    for part in ("lagid", "sysid", "workers", "service", "migrations"):
        modules = {str(path.relative_to(ROOT)) for path in (ROOT / part).rglob("*.py")}
        assert modules - names == set()
    for pattern in (
        "service/pages/templates/*",
        "service/pages/static/*",
        "sysid/models/catalogue/*.yaml",
        "migrations/versions/*.py",
        "migrations/script.py.mako",
        "*/py.typed",
        "service/client/*.pyi",
        "docs/*.md",
        "docs/*/*.md",
        "docs/*.png",
        "docs/*/pictures/*.png",
        "docs/openapi.json",
    ):
        files = {str(p.relative_to(ROOT)) for p in ROOT.glob(pattern) if p.is_file()}
        assert files
        guides = {re.sub("^docs/", "service/guides/", name) for name in files}
        assert guides - names == set()
    assert {f"{part}/py.typed" for part in ("lagid", "sysid", "workers", "service")} <= names
    information = {name.rpartition("/")[2] for name in names if ".dist-info/" in name}
    assert {"LICENSE", "METADATA", "entry_points.txt"} <= information
    tops = {name.partition("/")[0] for name in names if ".dist-info/" not in name}
    assert tops == {"lagid", "sysid", "workers", "service", "migrations"}


def test_the_wheel_names_its_version_licence_extras_and_command(wheel: Path) -> None:
    import lagid

    with ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        about = email.message_from_bytes(archive.read(name))
        command = archive.read(name.replace("METADATA", "entry_points.txt")).decode()
    assert about["Version"] == lagid.__version__
    assert about["License-Expression"] == "Apache-2.0"
    assert about["Requires-Python"] == ">=3.11"
    assert {*about.get_all("Provides-Extra")} == {
        *("server", "postgres", "notebook", "parquet", "matlab", "test")
    }
    classifiers = about.get_all("Classifier")
    assert {f"Programming Language :: Python :: {one}" for one in PYTHONS} <= {*classifiers}
    assert "lagid = lagid:main" in command


TYPED = """
from collections.abc import AsyncIterator, Iterator
from typing import Any, assert_type

from lagid import AsyncClient, Client, SysidError, load_model
from service.client.documents import JobDocument, RunDocument
from service.client.rows import Rows
from sysid.models.model import Model

assert_type(load_model("fopdt"), Model)
assert_type(SysidError().args, tuple[Any, ...])


def wait(client: Client) -> str:
    assert_type(client.jobs(3, state=["failed"], tag="night"), Rows[JobDocument])
    assert_type(client.runs("job_1", at_most=3), Rows[RunDocument])
    assert_type(client.iterate_runs("job_1"), Iterator[RunDocument])
    assert_type(client.events("job_1"), Iterator[dict[str, Any]])
    assert_type(client.report("job_1"), str)
    assert_type(Client.runs(client, "job_1"), Rows[RunDocument])
    Client.job(client, 3)  # Argument 2 has incompatible type
    client.wait("job_1", bar="no")  # Argument "bar"
    client.submit()  # Too few arguments
    client.submitted({})  # has no attribute "submitted"
    client.job(name="job_1")["stat"]  # "stat" is not a valid TypedDict key
    return client.job(name="job_1")["state"]


async def work(client: AsyncClient) -> JobDocument:
    assert_type(await client.jobs(3, state=["failed"], tag="night"), Rows[JobDocument])
    assert_type(client.runs("job_1", at_most=3), AsyncIterator[RunDocument])
    assert_type(client.download("ds_1"), AsyncIterator[bytes])
    assert_type(AsyncClient.runs(client, "job_1"), AsyncIterator[RunDocument])
    return client.job("job_1")  # Incompatible return value type
"""


def test_a_type_checker_knows_an_installed_client(wheel: Path, tmp_path: Path) -> None:
    """Each line with a comment has that error, and no other line has one."""
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    (libraries,) = environment.glob("lib/*/site-packages")
    with ZipFile(wheel) as archive:
        archive.extractall(libraries)
    (tmp_path / "typed.py").write_text(TYPED)
    options = ("--strict", "--cache-dir", tmp_path / "cache", "--no-error-summary")
    python = ("--python-executable", environment / "bin" / "python")
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *options, *python, "typed.py"],
        cwd=tmp_path,
        env={"PATH": os.environ["PATH"]},
        capture_output=True,
        text=True,
        check=False,
    )
    faults = [line for line in done.stdout.splitlines() if ": error: " in line]
    lines = enumerate(TYPED.splitlines(), 1)
    wanted = [(number, line.split("  # ")[1]) for number, line in lines if "  # " in line]
    assert len(faults) == len(wanted), done.stdout
    for fault, (number, text) in zip(faults, wanted, strict=True):
        assert fault.startswith(f"typed.py:{number}: error: ")
        assert text in fault


def find_python(version: str) -> Path:
    """Find an interpreter of this version; without one the test is skipped."""
    installed = Path.home() / ".pyenv" / "versions"
    found = [shutil.which(f"python{version}"), *installed.glob(f"{version}.*/bin/python")]
    for path in filter(None, found):
        asked = "import sys; print('%d.%d' % sys.version_info[:2])"
        done = subprocess.run([path, "-c", asked], capture_output=True, text=True, check=False)
        if done.stdout.strip() == version:
            return Path(path)
    report_missing("python", f"Python {version} is absent")
    raise AssertionError


class Installation:
    """An environment with the wheel in it, and a folder outside the checkout."""

    def __init__(self, python: Path, folder: Path) -> None:
        self.folder, self._bin = folder / "work", folder / "environment" / "bin"
        self.folder.mkdir()
        subprocess.run([python, "-m", "venv", self._bin.parent], check=True)
        kept = {
            name: value
            for name, value in os.environ.items()
            if name == SESSION_VARIABLE or not name.startswith(("LAGID_", "PYTHON"))
        }
        self._environment = {**kept, "LAGID_CACHE_DIR": str(folder / "cache")}

    def install(self, requirement: str) -> None:
        words = ("install", "--quiet", "--disable-pip-version-check", requirement)
        done = self.run("python", "-m", "pip", *words)
        assert done.returncode == 0, done.stderr

    def run(self, program: str, *words: object) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(
            self._build_command(program, words),
            cwd=self.folder,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=LIMIT_SECONDS,
            check=False,
        )

    def run_json(self, *words: object) -> Any:
        done = self.run("lagid", *words, "--json")
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    @contextmanager
    def serve(self) -> Iterator[str]:
        """Run `lagid serve` for the length of the block, at the address that is given."""
        port = find_free_port()
        words = ("serve", "--port", port, "--data-dir", self.folder / "data", "--cpus", 1)
        child = subprocess.Popen(
            self._build_command("lagid", words),
            cwd=self.folder,
            env=self._environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert child.stdout is not None
            line = child.stdout.readline()
            assert f":{port}/" in line
            yield f"http://127.0.0.1:{port}"
            child.send_signal(signal.SIGTERM)
            assert child.wait(60) == 0
        finally:
            child.kill()
            child.communicate()

    def _build_command(self, program: str, words: Sequence[object]) -> list[str]:
        return [str(self._bin / program), *map(str, words)]


@pytest.fixture(params=PYTHONS)
def here(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Installation]:
    """An environment of this Python, with nothing in it; it is removed, as it grows large."""
    yield Installation(find_python(request.param), tmp_path)
    shutil.rmtree(tmp_path)


@pytest.mark.night
@pytest.mark.timeout(3600)
def test_the_wheel_identifies_serves_and_runs_a_job(
    tracked_wheel: Path, here: Installation
) -> None:
    (here.folder / "steps.csv").write_bytes(recording())
    identify = ("identify", "steps.csv", "--model", "fopdt")

    here.install(str(tracked_wheel))
    import lagid

    assert here.run("lagid", "--version").stdout == f"lagid {lagid.__version__}\n"
    first = here.run("lagid", *identify, "--output", "found.json")
    assert first.returncode == 0, first.stderr
    assert first.stderr.startswith("compiling the search, once after an installation")
    found = json.loads((here.folder / "found.json").read_text())
    again = here.run("lagid", *identify, "--json")
    assert "compiling" not in again.stderr
    unlike = {"seconds"}
    assert {
        name: value for name, value in json.loads(again.stdout).items() if name not in unlike
    } == {name: value for name, value in found.items() if name not in unlike}
    assert "pip install 'lagid[server]'" in here.run("lagid", "serve").stderr
    (here.folder / "face.py").write_text(
        "import lagid\nprint(lagid.identify.__module__, lagid.Client.__module__)\n"
    )
    face = here.run("python", "face.py")
    assert face.stdout == "sysid.identification.identify service.client.client\n", face.stderr

    here.install(f"{tracked_wheel}[server]")
    with here.serve() as url:
        place = ("--url", url)
        assert here.run_json("dataset", "add", "steps.csv", *place)["name"] == "steps"
        (here.folder / "job.yaml").write_text("model: fopdt\ndatasets: [steps]\n")
        job = here.run_json("submit", "job.yaml", "--wait", *place)
        report = here.run("lagid", "report", job["id"], *place)
        assert report.returncode == 0, report.stderr
    assert job["state"] == "succeeded"
    (run,) = job["runs"]
    values = {parameter["name"]: parameter["value"] for parameter in run["parameters"]}
    assert values == {parameter["name"]: parameter["value"] for parameter in found["parameters"]}
    assert "Plotly" in (here.folder / "report.html").read_text()


def test_the_wheel_of_the_image_serves_its_guides_and_makes_its_tables(
    image_wheel: Path, tmp_path: Path
) -> None:
    """In an environment of its own, beside the libraries that are installed here."""
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    (own,) = environment.glob("lib/*/site-packages")
    with ZipFile(image_wheel) as archive:
        archive.extractall(own)
    libraries = Path(pytest.__file__).parents[1]
    (own / "libraries.pth").write_text(f"{libraries}\n")
    code = f"""
import sys
import lagid, migrations, service.guides
assert all(one.__path__[0].startswith({str(own)!r}) for one in (lagid, migrations, service.guides))
sys.argv = ["lagid", *sys.argv[1:]]
lagid.main()
"""

    def run(*words: object) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(
            [environment / "bin" / "python", "-P", "-c", code, *map(str, words)],
            cwd=tmp_path,
            env={"PATH": os.environ["PATH"]},
            capture_output=True,
            text=True,
            timeout=LIMIT_SECONDS,
            check=False,
        )

    made = run("db", "upgrade", "--data-dir", tmp_path / "data")
    assert "revision" in made.stdout, made.stderr
    assert run("db", "check", "--data-dir", tmp_path / "data").returncode == 0
