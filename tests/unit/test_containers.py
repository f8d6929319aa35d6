"""The container files, checked by schema: no container engine runs where this is developed."""

import json
import re
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator
from prometheus_client.parser import text_string_to_metric_families

from service.api.queue_metrics import write_metrics
from service.core import settings
from service.core.settings import Settings
from service.storage.sessions import Database
from tests.support.checkout import ROOT

DOCKER = ROOT / "docker"
OURS = {"web", "dispatcher", "ray-head", "ray-worker"}
SECRETS = {"LAGID_DB_PASSWORD", "LAGID_STORE_PASSWORD", "LAGID_RAY_TOKEN"}

# The part of the Compose Specification that the file uses; a key outside it is a mistake.
_STRINGS = {"type": "array", "items": {"type": "string"}, "minItems": 1}
_SECONDS = {"type": "string", "pattern": r"^\d+s$"}
_SERVICE = {
    "type": "object",
    "additionalProperties": False,
    "anyOf": [{"required": ["image"]}, {"required": ["build"]}],
    "required": ["networks", "restart"],
    "properties": {
        "image": {"type": "string", "pattern": "^[a-z/]+:[^:]+$"},
        "build": {
            "type": "object",
            "required": ["context"],
            "additionalProperties": False,
            "properties": {"context": {"type": "string"}, "dockerfile": {"type": "string"}},
        },
        "command": _STRINGS,
        "entrypoint": _STRINGS,
        "init": {"type": "boolean"},
        "restart": {"enum": ["no", "always", "on-failure", "unless-stopped"]},
        "environment": {"type": "object", "additionalProperties": {"type": "string"}},
        "volumes": {
            "type": "array",
            "items": {"type": "string", "pattern": "^[^:]+:/[^:]+(:ro)?$"},
        },
        "ports": {"type": "array", "items": {"pattern": r"^127\.0\.0\.1:\d+:\d+$"}},
        "networks": _STRINGS,
        "shm_size": {"type": "string", "pattern": r"^\d+(mb|gb)$"},
        "stop_grace_period": _SECONDS,
        "ulimits": {"type": "object", "additionalProperties": {"type": "integer"}},
        "deploy": {
            "type": "object",
            "additionalProperties": False,
            "properties": {"replicas": {"type": "integer", "minimum": 1}},
        },
        "depends_on": {
            "type": "object",
            "additionalProperties": {
                "type": "object",
                "required": ["condition"],
                "additionalProperties": False,
                "properties": {
                    "condition": {"enum": ["service_healthy", "service_completed_successfully"]}
                },
            },
        },
        "healthcheck": {
            "type": "object",
            "required": ["test", "interval", "timeout", "retries"],
            "additionalProperties": False,
            "properties": {
                "test": {**_STRINGS, "prefixItems": [{"enum": ["CMD", "CMD-SHELL"]}]},
                **dict.fromkeys(
                    ("interval", "timeout", "start_period", "start_interval"), _SECONDS
                ),
                "retries": {"type": "integer", "minimum": 1},
            },
        },
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
        "networks": {
            "type": "object",
            "additionalProperties": {
                "type": "object",
                "additionalProperties": False,
                "properties": {"internal": {"type": "boolean"}},
            },
        },
        "volumes": {"type": "object"},
    },
}

_PORTS = {
    "type": "array",
    "items": {
        "type": "object",
        "required": ["protocol", "port"],
        "additionalProperties": False,
        "properties": {"protocol": {"enum": ["TCP", "UDP"]}, "port": {"type": "integer"}},
    },
}
_SELECTOR = {
    "type": "object",
    "additionalProperties": False,
    "properties": {"matchLabels": {"type": "object", "additionalProperties": {"type": "string"}}},
}
_PEERS = {
    "type": "array",
    "minItems": 1,
    "items": {
        "type": "object",
        "additionalProperties": False,
        "minProperties": 1,
        "properties": {"podSelector": _SELECTOR, "namespaceSelector": _SELECTOR},
    },
}


def _rules(peers: str) -> dict[str, Any]:
    rule = {
        "type": "object",
        "required": [peers],  # without it everybody may
        "additionalProperties": False,
        "properties": {peers: _PEERS, "ports": _PORTS},
    }
    return {"type": "array", "items": rule}


_POLICY = {
    "type": "object",
    "additionalProperties": False,
    "required": ["podSelector", "policyTypes"],
    "properties": {
        "podSelector": _SELECTOR,
        "policyTypes": {"type": "array", "items": {"enum": ["Ingress", "Egress"]}},
        "ingress": _rules("from"),
        "egress": _rules("to"),
    },
}


def list_faults(schema: dict[str, Any], document: Any) -> list[str]:
    faults = Draft202012Validator(schema).iter_errors(document)
    return [f"{'/'.join(map(str, one.path))}: {one.message}" for one in faults]


def _compose() -> dict[str, Any]:
    document: dict[str, Any] = yaml.safe_load((DOCKER / "compose.yaml").read_text())
    return document


def test_the_compose_file_keeps_to_its_schema() -> None:
    assert list_faults(_COMPOSE, _compose()) == []


def test_compose_starts_two_web_processes_a_dispatcher_and_a_ray_cluster_of_one_image() -> None:
    services = _compose()["services"]
    assert {name for name, one in services.items() if one["image"].startswith("lagid:")} == OURS
    assert services["web"]["command"][:3] == ["lagid", "serve", "--no-dispatcher"]
    assert services["web"]["deploy"]["replicas"] == 2
    assert services["dispatcher"]["command"][-1].endswith("&& exec lagid dispatcher")
    assert services["ray-head"]["command"][:3] == ["ray", "start", "--head"]
    assert services["ray-worker"]["command"][:2] == ["ray", "start"]
    assert {"database", "store"} <= {*services}


def test_every_part_of_compose_has_a_health_check_of_its_own() -> None:
    checks = {name: one.get("healthcheck", {}) for name, one in _compose()["services"].items()}
    assert [name for name, check in checks.items() if not check] == ["bucket"]  # it ends
    asked = {name: checks[name]["test"] for name in OURS}
    parts = {"web": "web", "dispatcher": "dispatcher", "ray-head": "ray", "ray-worker": "ray"}
    assert asked == {name: ["CMD", "lagid", "health", part] for name, part in parts.items()}


def test_the_s3_server_is_built_at_the_version_that_its_image_is_named_after() -> None:
    """Since the repair of CVE-2025-62506 MinIO publishes no images."""
    services = _compose()["services"]
    assert services["store"]["image"] == services["bucket"]["image"]
    name, _, version = services["store"]["image"].partition(":")
    assert name == "lagid/store"
    assert version >= "RELEASE.2025-10-15"
    build = services["store"]["build"]
    text = (DOCKER / build["context"] / build["dockerfile"]).read_text()
    assert f"github.com/minio/minio@{version} " in text
    copied = re.findall(r"/go/bin/(\w+)", text)
    assert set(copied) == {services["store"]["command"][0], "mc"}
    assert services["store"]["healthcheck"]["test"][1] == "mc"
    assert "mc mb --ignore-existing store/lagid" in services["bucket"]["command"][-1]


def test_a_slow_start_of_the_dispatcher_is_not_ill_before_it_gives_up_itself() -> None:
    patience = Settings.model_fields["start_seconds"].default
    check = _compose()["services"]["dispatcher"]["healthcheck"]
    assert int(check["start_period"].removesuffix("s")) >= patience
    for container in _containers():
        if "command" not in container or container["command"][1] == "dispatcher":
            probe = container["startupProbe"]
            assert probe["periodSeconds"] * probe["failureThreshold"] >= patience


def test_whatever_a_service_needs_or_mounts_is_declared() -> None:
    document = _compose()
    for service in document["services"].values():
        assert set(service.get("depends_on", {})) <= set(document["services"])
        assert {*service["networks"]} <= set(document["networks"])
        for source in (one.split(":")[0] for one in service.get("volumes", ())):
            assert source in document["volumes"] or (DOCKER / source).is_file()


def test_only_the_proxy_is_reached_from_outside_and_ray_only_by_its_own() -> None:
    document = _compose()
    services = document["services"]
    assert [name for name, one in services.items() if "ports" in one] == ["proxy"]
    assert services["proxy"]["networks"] == ["front"]
    inner = {name for name, one in document["networks"].items() if one.get("internal")}
    assert inner == {"back", "ray"}
    in_ray = {name for name, one in services.items() if "ray" in one["networks"]}
    assert in_ray == {"dispatcher", "ray-head", "ray-worker"}
    for name in in_ray:
        assert services[name]["environment"]["RAY_AUTH_MODE"] == "token"


def test_the_proxy_passes_on_large_recordings_events_and_host() -> None:
    text = (DOCKER / "nginx.conf").read_text()
    port = _compose()["services"]["proxy"]["ports"][0].rpartition(":")[2]
    assert f"listen {port};" in text
    assert "server web:8000" in text
    assert "client_max_body_size 2g;" in text
    for line in ("proxy_buffering off;", "proxy_set_header Host $http_host;"):
        assert line in text
    assert text.count("{") == text.count("}")


def test_the_proxy_believes_nothing_that_clients_say_of_themselves() -> None:
    text = (DOCKER / "nginx.conf").read_text()
    set_here = dict(re.findall(r"proxy_set_header (\S+) (\S+);", text))
    user = Settings.model_fields["proxy_header"].default
    assert set_here[user] == set_here["Forwarded"] == set_here["X-Forwarded-Host"] == '""'
    assert (set_here["X-Forwarded-For"], set_here["X-Forwarded-Proto"]) == (
        "$remote_addr",
        "$scheme",
    )


def test_every_setting_named_in_the_compose_file_exists_and_no_secret_has_a_default() -> None:
    text = (DOCKER / "compose.yaml").read_text()
    known = {f"LAGID_{name.upper()}" for name in Settings.model_fields}
    assert set(re.findall(r"LAGID_[A-Z_]+(?=:)", text)) <= known | SECRETS
    assert set(re.findall(r"\$\{(\w+):\?", text)) == SECRETS
    with_default = set(re.findall(r"\$\{(\w+)(?::-|\})", text))
    assert with_default == {"LAGID_ALLOWED_HOSTS", "LAGID_PROXY_ADDRESSES"}


def _kubernetes(kind: str) -> list[dict[str, Any]]:
    found = yaml.safe_load_all((DOCKER / "kuberay.yaml").read_text())
    return [one for one in found if one["kind"] == kind]


def _templates() -> list[dict[str, Any]]:
    (cluster,), (deployment,) = _kubernetes("RayCluster"), _kubernetes("Deployment")
    groups = [cluster["spec"]["headGroupSpec"], *cluster["spec"]["workerGroupSpecs"]]
    return [*(one["template"] for one in groups), deployment["spec"]["template"]]


def _pods() -> list[dict[str, Any]]:
    return [one["spec"] for one in _templates()]


def _containers() -> list[dict[str, Any]]:
    return [container for pod in _pods() for container in pod["containers"]]


def test_all_of_kubernetes_runs_the_image_of_the_compose_file() -> None:
    assert {one["image"] for one in _containers()} == {_compose()["services"]["web"]["image"]}


def test_kubernetes_starts_the_commands_that_compose_starts() -> None:
    ours = [one["command"][:2] for one in _containers() if "command" in one]
    assert ours == [["lagid", "dispatcher"], ["lagid", "serve"]]


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
        assert pod["securityContext"]["runAsNonRoot"]


def test_kubernetes_is_told_the_version_of_ray_that_is_locked() -> None:
    locked = re.findall(r"^ray==([\d.]+)", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    assert [one["spec"]["rayVersion"] for one in _kubernetes("RayCluster")] == locked


def test_the_web_processes_of_two_versions_never_serve_at_once_and_their_memory_suffices(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (deployment,) = _kubernetes("Deployment")
    assert deployment["spec"]["strategy"] == {"type": "Recreate"}
    (web,) = deployment["spec"]["template"]["spec"]["containers"]
    limit = int(web["resources"]["limits"]["memory"].removesuffix("Gi")) * 2**30
    monkeypatch.setattr(settings, "read_memory_bytes", lambda: limit)
    service = Settings()
    assert service.reader_memory_bytes >= 900 * 2**20  # enough for a recording of some 100 MB
    assert service.max_uploads * service.reader_memory_bytes <= limit - 2 * 2**30


def test_our_containers_may_open_many_connections_and_are_started_again() -> None:
    services = _compose()["services"]
    for name in OURS:
        assert services[name]["ulimits"]["nofile"] >= 65_536
        assert services[name]["restart"] == "unless-stopped"


def test_every_container_of_kubernetes_has_probes_for_its_start_and_its_life() -> None:
    for container in _containers():
        assert {"startupProbe", "livenessProbe"} <= {*container}, container["name"]


def test_network_policies_let_nobody_in_but_the_named() -> None:
    policies = {one["metadata"]["name"]: one["spec"] for one in _kubernetes("NetworkPolicy")}
    for policy in policies.values():
        assert list_faults(_POLICY, policy) == []
        assert {one.lower() for one in policy["policyTypes"]} == {*policy} & {"ingress", "egress"}
    labels = [one["metadata"]["labels"]["app"] for one in _templates()]
    guarded = {
        policy["podSelector"]["matchLabels"]["app"]
        for policy in policies.values()
        if "Ingress" in policy["policyTypes"]
    }
    assert guarded == {*labels} == {"lagid-ray", "lagid-web"}
    whole, metrics = policies["lagid-ray"]["ingress"]
    assert whole["from"] == [{"podSelector": {"matchLabels": {"app": "lagid-ray"}}}]
    assert [one["port"] for one in metrics["ports"]] == [9108]
    (service,) = _kubernetes("Service")
    assert service["spec"]["selector"] == {"app": "lagid-web"}
    assert service["spec"].get("type", "ClusterIP") == "ClusterIP"


def test_the_image_copies_what_exists_and_installs_from_the_lock_without_test_tools() -> None:
    text = (DOCKER / "Dockerfile").read_text()
    for line in re.findall(r"^COPY (?!--from)(.+)$", text, re.MULTILINE):
        for source in line.split()[:-1]:
            assert (ROOT / source).exists(), source
    assert "COPY docker/requirements.lock server.lock" in text
    assert "--require-hashes -r server.lock" in text
    assert re.search(r"^USER lagid$", text, re.MULTILINE)
    assert re.findall(r"^FROM (\S+)", text, re.MULTILINE) == ["${BASE}", "${BASE}"]
    assert text.index("USER lagid") < text.index("compile_search()")  # into the user's cache


def test_every_metric_of_the_dashboard_exists_and_every_one_of_ours_is_on_it(
    sqlite_database: Database,
) -> None:
    shown = text_string_to_metric_families(write_metrics(sqlite_database).decode())
    families = {one.name for one in shown}
    suffixes = ("", "_total", "_bucket", "_count", "_sum")
    known = {f"{name}{suffix}" for name in families for suffix in suffixes}
    dashboard = json.loads((DOCKER / "grafana-dashboard.json").read_text())
    queries = [query["expr"] for panel in dashboard["panels"] for query in panel["targets"]]
    named = set(re.findall(r"\b(?:lagid|process|python)_\w+", " ".join(queries)))
    assert named - known == set()
    ours = {name for name in families if name.startswith("lagid_")}
    assert {name for name in ours if not any(one.startswith(name) for one in named)} == set()
    for expression in queries:
        assert expression.count("(") == expression.count(")"), expression


def test_panels_of_the_dashboard_have_titles_units_and_places_of_their_own() -> None:
    dashboard = json.loads((DOCKER / "grafana-dashboard.json").read_text())
    assert {"title", "uid", "schemaVersion", "templating"} <= {*dashboard}
    cells = set[tuple[int, int]]()
    for panel in dashboard["panels"]:
        assert panel["title"]
        assert panel["fieldConfig"]["defaults"]["unit"]
        place = panel["gridPos"]
        taken = {
            (place["x"] + i, place["y"] + j) for i in range(place["w"]) for j in range(place["h"])
        }
        assert not cells & taken, panel["title"]
        assert max(x for x, _ in taken) < 24
        cells |= taken
