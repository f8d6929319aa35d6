"""The container files, checked by schema: no container engine runs where this is developed."""

import re
from typing import Any

import yaml
from jsonschema import Draft202012Validator

from service.core.settings import Settings
from tests.repository import ROOT

DOCKER = ROOT / "docker"

# The part of the Compose Specification that the file uses; a key outside it is a mistake.
_STRINGS = {"type": "array", "items": {"type": "string"}, "minItems": 1}
_SERVICE = {
    "type": "object",
    "additionalProperties": False,
    "anyOf": [{"required": ["image"]}, {"required": ["build"]}],
    "properties": {
        "image": {"type": "string"},
        "build": {
            "type": "object",
            "required": ["context"],
            "additionalProperties": False,
            "properties": {"context": {"type": "string"}, "dockerfile": {"type": "string"}},
        },
        "command": _STRINGS,
        "restart": {"enum": ["no", "always", "on-failure", "unless-stopped"]},
        "environment": {"type": "object", "additionalProperties": {"type": "string"}},
        "volumes": {"type": "array", "items": {"type": "string", "pattern": "^[^:]+:/[^:]+$"}},
        "ports": {"type": "array", "items": {"pattern": r"^127\.0\.0\.1:\d+:\d+$"}},
        "shm_size": {"type": "string", "pattern": r"^\d+(mb|gb)$"},
        "depends_on": {
            "type": "object",
            "additionalProperties": {
                "type": "object",
                "required": ["condition"],
                "properties": {"condition": {"enum": ["service_started", "service_healthy"]}},
            },
        },
        "healthcheck": {"type": "object", "required": ["test"]},
    },
}
_COMPOSE = {
    "type": "object",
    "required": ["services"],
    "additionalProperties": False,
    "patternProperties": {"^x-": {}},
    "properties": {
        "name": {"type": "string"},
        "services": {"type": "object", "additionalProperties": _SERVICE},
        "volumes": {"type": "object"},
    },
}


def _compose() -> dict[str, Any]:
    document: dict[str, Any] = yaml.safe_load((DOCKER / "compose.yaml").read_text())
    return document


def test_the_compose_file_keeps_to_its_schema() -> None:
    faults = Draft202012Validator(_COMPOSE).iter_errors(_compose())
    assert [f"{'/'.join(map(str, one.path))}: {one.message}" for one in faults] == []


def test_the_compose_file_starts_the_same_commands_as_the_readme() -> None:
    services = _compose()["services"]
    assert services["web"]["command"][:2] == ["lagid", "serve"]
    assert services["dispatcher"]["command"][:2] == ["lagid", "dispatcher"]


def test_whatever_a_service_needs_or_mounts_is_declared() -> None:
    document = _compose()
    for service in document["services"].values():
        assert set(service.get("depends_on", {})) <= set(document["services"])
        assert {one.split(":")[0] for one in service["volumes"]} <= set(document["volumes"])


def test_every_setting_named_in_the_compose_file_exists() -> None:
    named = set(re.findall(r"LAGID_[A-Z_]+(?=:)", (DOCKER / "compose.yaml").read_text()))
    known = {f"LAGID_{name.upper()}" for name in Settings.model_fields}
    assert named <= known | {"LAGID_DB_PASSWORD"}


def _kubernetes() -> dict[str, dict[str, Any]]:
    found = yaml.safe_load_all((DOCKER / "kuberay.yaml").read_text())
    return {one["kind"]: one for one in found}


def _pods() -> list[dict[str, Any]]:
    cluster = _kubernetes()["RayCluster"]["spec"]
    groups = [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]
    templates = [
        *(one["template"] for one in groups),
        _kubernetes()["Deployment"]["spec"]["template"],
    ]
    return [one["spec"] for one in templates]


def _containers() -> list[dict[str, Any]]:
    return [container for pod in _pods() for container in pod["containers"]]


def test_all_of_kubernetes_runs_the_image_of_the_compose_file() -> None:
    assert {one["image"] for one in _containers()} == {_compose()["services"]["web"]["image"]}


def test_kubernetes_starts_the_commands_that_compose_starts() -> None:
    ours = [one["command"][:2] for one in _containers() if "command" in one]
    services = _compose()["services"]
    assert ours == [services[name]["command"][:2] for name in ("dispatcher", "web")]


def test_every_setting_and_secret_of_kubernetes_is_one_that_is_told() -> None:
    text = (DOCKER / "kuberay.yaml").read_text()
    known = {f"LAGID_{name.upper()}" for name in Settings.model_fields}
    assert set(re.findall(r"LAGID_[A-Z_]+", text)) <= known
    made = set(re.findall(r"--from-literal=([a-z-]+)=", text))
    assert made == set(re.findall(r"secretKeyRef: \{name: lagid, key: ([a-z-]+)\}", text))


def test_whoever_talks_to_ray_has_its_token_and_its_sockets() -> None:
    rays = [one for pod in _pods() if pod.get("shareProcessNamespace") for one in pod["containers"]]
    assert [one["name"] for one in rays] == ["ray", "dispatcher", "ray"]
    for one in rays:
        assert {"RAY_AUTH_MODE", "RAY_AUTH_TOKEN"} <= {each["name"] for each in one["env"]}
        assert {"/tmp/ray", "/dev/shm"} <= {each["mountPath"] for each in one["volumeMounts"]}


def test_whatever_a_pod_mounts_is_declared_and_runs_as_the_user_of_the_image() -> None:
    user = int(re.findall(r"--uid (\d+)", (DOCKER / "Dockerfile").read_text())[0])
    for pod in _pods():
        declared = {one["name"] for one in pod.get("volumes", [])}
        mounted = {m["name"] for one in pod["containers"] for m in one.get("volumeMounts", [])}
        assert mounted == declared
        assert pod["securityContext"]["runAsUser"] == user


def test_kubernetes_is_told_the_version_of_ray_that_is_locked() -> None:
    locked = re.findall(r"^ray==([\d.]+)", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    assert [_kubernetes()["RayCluster"]["spec"]["rayVersion"]] == locked


def test_the_image_copies_what_exists_and_installs_from_the_lock() -> None:
    text = (DOCKER / "Dockerfile").read_text()
    for line in re.findall(r"^COPY (.+)$", text, re.MULTILINE):
        for source in line.split()[:-1]:
            assert (ROOT / source).exists(), source
    assert "--require-hashes -r requirements.lock" in text
    assert re.search(r"^USER lagid$", text, re.MULTILINE)
