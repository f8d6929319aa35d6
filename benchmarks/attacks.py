"""Attack a service of its own, and measure what each attack costs: status, memory, time.

The attacks are those of a review: foreign pages, models and bodies that exhaust the service, many
streams and uploads at once, crafted headers and files, and folders of other users. During each one
another client asks for `/healthz`. Its slowest answer tells whether anybody notices the attack.
"""

import json
import re
import socket
import subprocess
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import psutil

from benchmarks.breaking.stand import Stand, standing_service
from benchmarks.table import Row, parser, report
from sysid.core.child_processes import build_child_command

JSON = {"content-type": "application/json"}
MEGABYTE = 1024**2
MEMORY_BAR = 300.0
TIMEOUT = httpx.Timeout(300.0)
SAMPLES = {"samples": 50, "sample_time": 0.1, "inputs": {"u": {"kind": "step"}}}


@dataclass(frozen=True, slots=True)
class Target:
    """The service that is attacked."""

    stand: Stand
    client: httpx.Client

    def post(self, path: str, document: Any, **headers: str) -> str:
        """Send a JSON body; return the status."""
        content = document if isinstance(document, bytes) else json.dumps(document).encode()
        return str(self.client.post(path, content=content, headers={**JSON, **headers}).status_code)


Attack = Callable[[Target], str]


@dataclass(frozen=True, slots=True)
class Figures:
    """What an attack has cost."""

    name: str
    status: str
    holds: bool
    seconds: float
    processor_seconds: float
    memory: float
    slowest: float


def simulate(states: int, equation: Callable[[int], str], start: Any = 0) -> Attack:
    """Build the simulation of a model of some states with these equations."""
    names = [f"x{n}" for n in range(states)]
    model = {
        "name": "attack",
        "form": "differential",
        "inputs": {"u": "V"},
        "states": dict.fromkeys(names, "1"),
        "parameters": {"a": {"lower": 0.1, "upper": 1}, "L": {"lower": 0, "upper": 1}},
        "equations": {name: equation(n) for n, name in enumerate(names)},
        "outputs": {"y": "x0"},
        "initial": dict.fromkeys(names, start),
    }
    body = {"model": model, "parameters": {"a": 0.5, "L": 0.2}, **SAMPLES}
    return lambda target: target.post("/v1/datasets:simulate", body)


def send_job(**fields: Any) -> Attack:
    """Build the submission of a job with these fields."""
    body = json.dumps({"model": "fopdt", "datasets": ["none"], **fields}).encode()
    return lambda target: target.post("/v1/jobs", body)


def check_model(**fields: Any) -> Attack:
    """Build the check of a model; the status and whether it is valid."""

    def attack(target: Target) -> str:
        answer = target.client.post("/v1/models:check", json={"name": "attack", **fields})
        return f"{answer.status_code}, valid: {answer.json()['valid']}"

    return attack


def get(path: str, **headers: str) -> Attack:
    """Build a request without a body."""
    return lambda target: str(target.client.get(path, headers=headers).status_code)


def post_as_page(path: str, content_type: str | None) -> Attack:
    """Build what a page of another origin can send without asking."""

    def attack(target: Target) -> str:
        headers = {"origin": "http://evil.example", "sec-fetch-site": "cross-site"}
        headers |= {} if content_type is None else {"content-type": content_type}
        answer = target.client.post(path, content=b"t,u\n0,1\n1,2\n", headers=headers)
        return str(answer.status_code)

    return attack


def upload(content: bytes) -> Attack:
    """Build the upload of a CSV file."""
    headers = {"content-type": "text/csv"}
    return lambda target: str(
        target.client.post("/v1/datasets", content=content, headers=headers).status_code
    )


def open_streams(target: Target) -> str:
    """Open 600 event streams; the statuses, and the median time of a list of jobs meanwhile."""
    job = _submit(target)
    request = f"GET /v1/jobs/{job}/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()
    with _connections(target, 600) as connections:
        for connection in connections:
            connection.sendall(request)
        lines = [connection.recv(12).decode() for connection in connections]
        times = []
        for _ in range(20):
            begun = time.monotonic()
            target.client.get("/v1/jobs?limit=5")
            times.append(time.monotonic() - begun)
    target.client.post(f"/v1/jobs/{job}:cancel")
    counts = {code: sum(line.endswith(code) for line in lines) for code in ("200", "503")}
    return f"{counts['200']}×200, {counts['503']}×503, list {sorted(times)[10]:.2f} s"


def stall_uploads(target: Target) -> str:
    """Begin 20 uploads and send nothing; the status of another one meanwhile."""
    head = "POST /v1/datasets HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: text/csv\r\n"
    with _connections(target, 20) as connections:
        for connection in connections:
            connection.sendall(f"{head}Content-Length: 9999\r\n\r\nt,u\n".encode())
        time.sleep(1.0)
        return upload(b"t,u\n0,1\n1,2\n2,3\n")(target)


def start_another(target: Target) -> str:
    """Start a second service on the folder; its exit code."""
    done = subprocess.run(
        [*build_child_command("service.cli.main", "serve", "--port", "0")],
        env=target.stand.environment,
        capture_output=True,
        timeout=120,
        check=False,
    )
    return f"exit {done.returncode}"


def guess_keys(target: Target) -> str:
    """Ask a web process with keys 600 times with wrong ones, and with a right one meanwhile."""
    environment = {**target.stand.environment, "LAGID_AUTH": "keys", "LAGID_PORT": "0"}
    made = subprocess.run(
        [*build_child_command("service.cli.main", "key", "create", "attack")],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    token = made.stdout.strip()
    web = subprocess.Popen(
        [*build_child_command("service.cli.main", "serve", "--no-dispatcher")],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert web.stdout is not None
        url = next(
            re.findall(r"serves (\S+)/ ", line)[0] for line in web.stdout if "serves" in line
        )
        _wait_until_up(url)
        wrong = [f"{token[:-4]}{n:04x}" for n in range(600) if not token.endswith(f"{n:04x}")]
        with ThreadPoolExecutor(100) as pool:
            asked = [pool.submit(_ask_with_key, url, guess) for guess in wrong]
            times = []
            for _ in range(10):
                begun = time.monotonic()
                assert _ask_with_key(url, token) == httpx.codes.OK
                times.append(time.monotonic() - begun)
            counts = Counter(future.result() for future in asked)
    finally:
        web.terminate()
        web.wait()
    others = len(wrong) - counts[401] - counts[503]
    return f"{counts[401]}×401, {counts[503]}×503, {others} others; right {sorted(times)[5]:.2f} s"


def _ask_with_key(url: str, key: str) -> int:
    headers = {"Authorization": f"Bearer {key}"}
    return httpx.get(f"{url}/v1/jobs", headers=headers, timeout=TIMEOUT).status_code


def _wait_until_up(url: str) -> None:
    for _ in range(600):
        with suppress(httpx.TransportError):
            httpx.get(f"{url}/healthz", timeout=TIMEOUT)
            return
        time.sleep(0.1)
    raise TimeoutError("the web process with keys did not start")


def look_at_folders(target: Target) -> str:
    """Look at the folders as another user would: data, database, Ray."""
    data = target.stand.folder
    paths = [data, data / "lagid.db"]
    paths += [Path(f"/proc/{pid}/cwd").readlink() for pid in target.stand.family.named("raylet")]
    return f"open to others: {sum(bool(path.stat().st_mode & 0o077) for path in paths)}"


def _submit(target: Target) -> str:
    rows = "\n".join(f"{0.1 * k:.1f},{k % 7 // 3},{k % 5}" for k in range(300))
    dataset = target.client.post(
        "/v1/datasets", content=f"t,u,y\n{rows}\n", headers={"content-type": "text/csv"}
    ).json()["id"]
    stop = {"generations": 10_000_000, "stop": {"settled": None}}
    body = {"model": "fopdt", "datasets": [dataset], "algorithm": stop, "reuse": False}
    return str(target.client.post("/v1/jobs", json=body).json()["id"])


@contextmanager
def _connections(target: Target, count: int) -> Iterator[list[socket.socket]]:
    address = ("127.0.0.1", target.stand.port)
    opened = [socket.create_connection(address, timeout=60) for _ in range(count)]
    try:
        yield opened
    finally:
        for connection in opened:
            connection.close()


def _sum(count: int, term: Callable[[int], str]) -> str:
    return "+".join(term(n) for n in range(count))


def _table(columns: int, rows: int) -> bytes:
    head = "t," + ",".join(f"c{n}" for n in range(columns))
    line = ",1" * columns
    return "\n".join([head, *(f"{k}{line}" for k in range(rows))]).encode()


LONG_TERM = "*".join(f"y(k-{n})**9" for n in range(1, 4))
ATTACKS: dict[str, tuple[Attack, str]] = {
    "host of another name (DNS rebinding)": (get("/v1/jobs", host="evil.example"), "421"),
    "page of another origin: model without type": (post_as_page("/v1/models", None), "403"),
    "page of another origin: dataset": (post_as_page("/v1/datasets", "text/plain"), "403"),
    "page of another origin: clone a job": (post_as_page("/v1/jobs/job_x:clone", None), "403"),
    "64 states of 64 products": (
        simulate(64, lambda i: _sum(64, lambda j: f"a*x{(i + j) % 64}*x{j}")),
        "422",
    ),
    "64 equations of 4,000 characters": (
        simulate(64, lambda i: _sum(90, lambda j: f"tanh(x{i})*exp(-a*x{j % 64})*sin({j}*a)")),
        "422",
    ),
    "9,800 nodes, nearly the largest model": (
        simulate(11, lambda i: _sum(64, lambda j: f"tanh(x{j % 11})*exp(-x{i}*a)*sin({j}*a)")),
        "201|422",
    ),
    "200 delays of one input": (
        simulate(1, lambda _: _sum(200, lambda j: f"u(t-L*0.{j:03}1)")),
        "201|422",
    ),
    "twelve dense equations at rest": (
        simulate(12, lambda i: _sum(12, lambda j: f"{(7 * i * j) % 11 + 1.5}*a*x{j}"), "steady"),
        "422",
    ),
    "64 states, each the square of the one before, at rest": (
        simulate(64, lambda i: f"x{i - 1}*x{i - 1} - x{i}" if i else "a - x0", "steady"),
        "422",
    ),
    "250 polynomial terms of 27 factors": (
        check_model(
            form="polynomial",
            output="y",
            terms=[f"{LONG_TERM}*y(k-{n})" for n in range(4, 254)],
            coefficients={"lower": -1, "upper": 1},
        ),
        "200, valid: False",
    ),
    "250,000 unknown fields, 4 MB": (
        send_job(**{f"k{n:07}": 1 for n in range(250_000)}),
        "422",
    ),
    "body of 31 MB": (send_job(name="x" * 31 * MEGABYTE), "413"),
    "500,000 valid objects, 4 MB": (
        send_job(sweep={"axes": [{"path": "/seed", "values": [1], "labels": [{}] * 500_000}]}),
        "422",
    ),
    "40,000 labelled values": (
        send_job(
            sweep={
                "axes": [
                    {
                        "path": "/seed",
                        "values": list(range(40_000)),
                        "labels": [{"n": n, "m": n} for n in range(40_000)],
                    }
                ]
            }
        ),
        "422|404",
    ),
    "axis of a million values": (
        send_job(sweep={"axes": [{"path": "/seed", "values": [0] * 1_000_000}]}),
        "422|404",
    ),
    "500,000 names of datasets, 4 MB": (send_job(datasets=["abcdef"] * 400_000), "422"),
    "100,000 levels": (lambda target: target.post("/v1/jobs", b"[" * 100_000), "422"),
    "600 event streams": (open_streams, "500×200, 100×503.*"),
    "20 stalled uploads, and another one": (stall_uploads, "201|503"),
    "cursor of 30 digits": (get("/v1/jobs/job_x/runs?cursor=[null,9999999999999999]"), "4.."),
    "cursor of truth values": (get("/v1/jobs/job_x/runs?cursor=[true,true]"), "4.."),
    "range of 5,000 digits": (
        get("/v1/datasets/ds_x/content", range=f"bytes=0-{'9' * 5000}"),
        "4..",
    ),
    "CSV of 900 columns and 5,000 rows": (upload(_table(900, 5_000)), "201"),
    "CSV of 100,000 columns": (upload(_table(100_000, 3)), "422"),
    "CSV with a line of 60 MB": (upload(b't,u\n0,"' + b"x" * 60 * MEGABYTE), "422"),
    "second service on the folder": (start_another, "exit 1"),
    "600 wrong keys, and a right one": (guess_keys, ".*, 0 others; .*"),
    "folders of another user": (look_at_folders, "open to others: 0"),
}


class Watch:
    """Memory and processor time of the web process, and the slowest `/healthz`, for a block."""

    def __init__(self, stand: Stand) -> None:
        assert stand.web is not None
        self._process, self._url = psutil.Process(stand.web.pid), stand.url
        self._ending = threading.Event()
        self._threads = [threading.Thread(target=work) for work in (self._look, self._ask)]
        self.slowest, self._before = 0.0, self._process.memory_info().rss
        self._most, self._processor = self._before, self._read_processor()
        self.begun = time.monotonic()

    def __enter__(self) -> "Watch":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds = time.monotonic() - self.begun
        self._ending.set()
        for thread in self._threads:
            thread.join()
        self.memory = (self._most - self._before) / MEGABYTE
        self.processor_seconds = self._read_processor() - self._processor

    def _read_processor(self) -> float:
        times = self._process.cpu_times()
        return float(times.user + times.system)

    def _look(self) -> None:
        while not self._ending.wait(0.02):
            self._most = max(self._most, self._process.memory_info().rss)

    def _ask(self) -> None:
        with httpx.Client(timeout=TIMEOUT) as client:
            while not self._ending.wait(0.05):
                begun = time.monotonic()
                with suppress(httpx.TransportError):
                    client.get(f"{self._url}/healthz")
                self.slowest = max(self.slowest, time.monotonic() - begun)


def measure(target: Target, name: str) -> Figures:
    """Measure one attack."""
    attack, expected = ATTACKS[name]
    with Watch(target.stand) as watch:
        try:
            status = attack(target)
        except httpx.TransportError as error:
            status = type(error).__name__
    holds = re.fullmatch(expected, status) is not None
    costs = watch.seconds, watch.processor_seconds, watch.memory, watch.slowest
    return Figures(name, status, holds, *costs)


def format_figures(figures: list[Figures]) -> str:
    """Format the figures as a table."""
    lines = [
        "| attack | answer | as wanted | s | web processor s | web memory MB | slowest other s |",
        "|---|---|---|--:|--:|--:|--:|",
    ]
    for f in figures:
        costs = f"{f.seconds:.1f} | {f.processor_seconds:.1f} | {f.memory:+.0f} | {f.slowest:.2f}"
        lines.append(f"| {f.name} | {f.status} | {'yes' if f.holds else '**no**'} | {costs} |")
    return "\n".join(lines)


def main() -> None:
    """Attack a service and print the table."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--only", help="attacks whose name has this text")
    options = arguments.parse_args()
    figures = []
    with (
        tempfile.TemporaryDirectory(prefix="lagid-attacks-") as folder,
        standing_service(Stand(Path(folder) / "data")) as stand,
        httpx.Client(base_url=stand.url, timeout=TIMEOUT) as client,
    ):
        target = Target(stand, client)
        for name in ATTACKS:
            if options.only is None or options.only in name:
                figures.append(measure(target, name))
                print(format_figures(figures[-1:]).splitlines()[-1], flush=True)
        is_alive = stand.answers() == httpx.codes.OK
    print(f"\n{format_figures(figures)}\n")
    most = max((f.memory for f in figures), default=0.0)
    rows = [
        Row("attacks", len(figures), "", 1, ">="),
        Row("attacks with another answer than wanted", sum(not f.holds for f in figures), "", 0),
        Row("most memory of the web process in one attack", most, "MB", MEMORY_BAR),
        Row("slowest other answer", max((f.slowest for f in figures), default=0.0), "s"),
        Row("service answers afterwards", float(is_alive), "", 1, ">="),
    ]
    report("Attacks", rows, [], options)


if __name__ == "__main__":
    main()
