"""The container files, checked by schema: no container engine runs where this is developed."""

import re
from pathlib import Path
from typing import Any

import yaml
from jsonschema import Draft202012Validator

from service.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
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


def test_the_image_copies_what_exists_and_installs_from_the_lock() -> None:
    text = (DOCKER / "Dockerfile").read_text()
    for line in re.findall(r"^COPY (.+)$", text, re.MULTILINE):
        for source in line.split()[:-1]:
            assert (ROOT / source).exists(), source
    assert "--require-hashes -r requirements.lock" in text
    assert re.search(r"^USER lagid$", text, re.MULTILINE)
