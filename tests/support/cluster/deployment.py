"""The services of `docker/compose.yaml` as processes of this machine: the same commands, elsewhere.

Commands, environments and health checks are read from the file. Only addresses, ports and secrets
are replaced. Each part has a loopback address of its own where Compose gives it a container.
"""

import os
import re
import secrets
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import boto3
import yaml
from moto.server import ThreadedMotoServer

from service.client.embedded import find_free_port
from service.dispatch.supervisor import clear_session
from tests.support.checkout import ROOT
from tests.support.limits import LIMIT_SECONDS
from tests.support.storage.databases import empty_postgres

STOP_SECONDS = 30.0
PAUSE_SECONDS = 0.5
MAX_RESTARTS = 5
BUCKET = "lagid"
WEB_HOSTS = ("127.0.0.5", "127.0.0.6")
HEAD_HOST, WORKER_HOST, DISPATCHER_HOST = "127.0.0.2", "127.0.0.3", "127.0.0.4"
# What `lagid` and `ray` are in the image. RAY_EXTRA tells a node where it is on this machine.
PROGRAMS = {
    "lagid": '-m service.cli.main "$@"',
    "ray": "-c 'from ray.scripts.scripts import main; main()' \"$@\" $RAY_EXTRA",
}


@dataclass
class Deployment:
    """What runs, and how its parts are reached."""

    folder: Path
    environments: dict[str, dict[str, str]]
    commands: dict[str, list[str]]
    checks: dict[str, list[str]]
    metrics_url: str
    processes: dict[str, "subprocess.Popen[bytes]"] = field(default_factory=dict)
    n_restarts: int = 0

    def start(self, service: str, number: int = 0) -> None:
        """Start a process of a service; `number` tells its replicas apart."""
        name = f"{service}-{number}"
        host = WEB_HOSTS[number]
        command = [host if word == "0.0.0.0" else word for word in self.commands[service]]
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                command,
                env=self._build_environment(service, name),
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def restart_ended(self) -> None:
        """Start again what has ended, as an engine does; Ray gives up after 30 s."""
        for name, child in list(self.processes.items()):
            if child.poll() is not None:
                clear_session(child.pid)
                self.n_restarts += 1
                assert self.n_restarts <= MAX_RESTARTS, self.read_log(name)
                service, _, number = name.rpartition("-")
                self.start(service, int(number))

    def run(self, service: str, *command: str) -> str:
        """Run a command once in the environment of a service; return what it prints."""
        done = subprocess.run(
            command,
            env=self._build_environment(service, f"{service}-once"),
            cwd=self.folder,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    def check_health(self, service: str, number: int = 0) -> bool:
        """Run the health check of a service, as an engine does, and return whether it is well."""
        environment = self._build_environment(service, f"{service}-{number}")
        command = self.checks[service]
        if service == "web":
            environment["LAGID_HOST"] = WEB_HOSTS[number]
        done = subprocess.run(command, env=environment, capture_output=True, check=False)
        return done.returncode == 0

    def wait_until(self, holds: Callable[[], bool], what: str) -> None:
        """Wait for something that must come true."""
        limit = time.monotonic() + LIMIT_SECONDS
        while not holds():
            self.restart_ended()
            ends = {name: self.read_log(name)[-500:] for name in self.processes}
            assert time.monotonic() < limit, f"{what} did not come true: {ends}"
            time.sleep(PAUSE_SECONDS)

    def wait_until_healthy(self, service: str, number: int = 0) -> None:
        """Wait until the health check of a service succeeds."""
        self.wait_until(lambda: self.check_health(service, number), f"{service} is well")

    def read_log(self, name: str) -> str:
        """What a process has written."""
        return (self.folder / f"{name}.log").read_text(errors="replace")

    def stop(self) -> None:
        """Ask every process to end, the last one first, and clear what they leave."""
        for child in reversed(self.processes.values()):
            child.send_signal(signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                child.wait(STOP_SECONDS)
            clear_session(child.pid)
            child.wait()

    def _build_environment(self, service: str, name: str) -> dict[str, str]:
        inherited = {key: text for key, text in os.environ.items() if not key.startswith("RAY_")}
        data = self.folder / f"data-{name}"
        return {**inherited, "LAGID_DATA_DIR": str(data), **self.environments[service]}


@contextmanager
def rehearse_deployment(folder: Path) -> Iterator[Deployment]:
    """Prepare the deployment with a database, a bucket and addresses; nothing of it is left."""
    services = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text())["services"]
    short = Path(mkdtemp())  # sockets need a short path
    programs = _write_programs(short / "bin")
    ray_port, web_port, metrics_port = (find_free_port() for _ in range(3))
    with ExitStack() as stack:
        database = stack.enter_context(empty_postgres())
        replaced = {
            "ray-head:6379": f"{HEAD_HOST}:{ray_port}",
            "--port=6379": f"--port={ray_port}",
            "http://store:9000": stack.enter_context(_serve_bucket()),
        }
        common = {
            "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "RAY_TMPDIR": str(short),
            "LAGID_LOG_FORMAT": "json",  # as in the image
            "LAGID_PORT": str(web_port),
        }
        own: dict[str, dict[str, str]] = {
            "ray-head": _locate_node(HEAD_HOST),
            "ray-worker": {"RAY_EXTRA": f"{_locate_node(WORKER_HOST)['RAY_EXTRA']} --num-cpus=1"},
            "dispatcher": {
                **_locate_node(DISPATCHER_HOST),
                "LAGID_METRICS_HOST": DISPATCHER_HOST,
                "LAGID_METRICS_PORT": str(metrics_port),
            },
        }
        url = database.engine.url.render_as_string(hide_password=False)
        chosen = {name: secrets.token_hex(32) for name in ("LAGID_RAY_TOKEN",)}
        deployment = Deployment(folder, {}, {}, {}, f"http://{DISPATCHER_HOST}:{metrics_port}")
        for name in ("ray-head", "ray-worker", "dispatcher", "web"):
            given = services[name]["environment"]
            filled = {key: _replace(_fill(text, chosen), replaced) for key, text in given.items()}
            if "LAGID_DATABASE_URL" in filled:
                filled["LAGID_DATABASE_URL"] = url
            deployment.environments[name] = {**common, **filled, **own.get(name, {})}
            deployment.commands[name] = [_replace(w, replaced) for w in services[name]["command"]]
            deployment.checks[name] = services[name]["healthcheck"]["test"][1:]
        stack.callback(deployment.stop)
        yield deployment


def _locate_node(host: str) -> dict[str, str]:
    return {"RAY_EXTRA": f"--node-ip-address={host} --object-store-memory=80000000"}


def _fill(text: str, chosen: Mapping[str, str]) -> str:
    """Fill in the variables of Compose; a secret that nothing needs here is any text."""
    with_defaults = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text)
    return re.sub(
        r"\$\{(\w+):\?[^}]*\}", lambda found: chosen.get(found[1], "rehearsal"), with_defaults
    )


def _replace(text: str, replaced: Mapping[str, str]) -> str:
    for old, new in replaced.items():
        text = text.replace(old, new)
    return text


def _write_programs(folder: Path) -> Path:
    folder.mkdir()
    for name, words in PROGRAMS.items():
        (folder / name).write_text(f"#!/bin/sh\nexec {shlex.quote(sys.executable)} {words}\n")
        (folder / name).chmod(0o755)
    return folder


@contextmanager
def _serve_bucket() -> Iterator[str]:
    """An S3 server with the bucket, for the length of the block."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    try:
        open_client(f"http://{host}:{port}").create_bucket(Bucket=BUCKET)
        yield f"http://{host}:{port}"
    finally:
        server.stop()


def open_client(endpoint: str) -> Any:
    """A client of the store, beside the service."""
    return boto3.client(
        "s3",
        endpoint_url=endpoint,
        region_name="us-east-1",
        aws_access_key_id="lagid",
        aws_secret_access_key="rehearsal",
    )
