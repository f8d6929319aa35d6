"""Users whom an authenticating proxy names, and the addresses that are believed."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from service.api.requests.access_check import COOKIE
from tests.support.service.keyed_service import Guarded, guard
from tests.support.service.web_app import read_faults, settings_of

PROXY = {"auth": "proxy", "proxy_header": "X-User", "proxy_admins": "Ada@lab"}


@pytest.fixture(scope="module")
def behind(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    """A service behind a proxy at 10.1.2.3, asked from there."""
    changes: dict[str, Any] = {**PROXY, "proxy_addresses": "10.1.0.0/16"}
    with guard("sqlite", tmp_path_factory.mktemp("behind"), **changes) as guarded:
        guarded.client._transport.client = ("10.1.2.3", 1)  # type: ignore[attr-defined]
        yield guarded


def test_a_user_of_the_proxy_may_write_and_only_named_ones_may_manage(behind: Guarded) -> None:
    user = behind.ask("GET", "/v1/access", headers={"X-User": "grace"}).json()
    assert (user["actor"], user["scopes"]) == ("user:grace", ["read", "write"])
    admin = behind.ask("GET", "/v1/access", headers={"X-User": "ada@lab"}).json()
    assert admin["scopes"] == ["read", "write", "admin"]
    read_faults(behind.ask("GET", "/v1/audit", headers={"X-User": "grace"}), 403, "out-of-scope")
    model = {"name": "tank", "form": "differential"}
    assert behind.ask("POST", "/v1/models:check", json=model, headers={"X-User": "a"}).is_success


def test_credentials_that_a_proxy_passes_on_are_its_own(behind: Guarded) -> None:
    for passed_on in ("Basic Z3JhY2U6c2VjcmV0", "Bearer eyJhbGciOiJSUzI1NiJ9.e30.x"):
        headers = {"X-User": "grace", "Authorization": passed_on}
        user = behind.ask("GET", "/v1/access", headers=headers).json()
        assert user["actor"] == "user:grace"
        read_faults(
            behind.ask("GET", "/v1/access", headers={"Authorization": passed_on}),
            401,
            "unauthorized",
        )


def test_without_one_user_the_proxy_or_a_key_is_needed(behind: Guarded) -> None:
    for names in (
        [],
        [""],
        ["a\tb"],
        ["a" * 101],
        ["grace", "ada@lab"],
        ["grace, ada@lab"],
        ["grace ada@lab"],
    ):
        headers = [("X-User", name) for name in names]
        read_faults(behind.client.get("/v1/jobs", headers=headers), 401, "unauthorized")
    token = behind.add_key(scope="read")
    assert behind.ask("GET", "/v1/jobs", token).status_code == 200
    wrong = behind.ask("GET", "/v1/jobs", "lagid_1_2", headers={"X-User": "ada@lab"})
    read_faults(wrong, 401, "unauthorized")
    signed_in = behind.ask("POST", "/sign-in", data={"key": token})
    behind.client.cookies.clear()
    cookie = {"Cookie": f"{COOKIE}={signed_in.cookies[COOKIE]}"}
    assert behind.ask("GET", "/v1/access", headers=cookie).json()["scopes"] == ["read"]


def test_an_address_that_is_no_proxy_names_nobody(tmp_path: Path) -> None:
    with guard("sqlite", tmp_path, **PROXY, proxy_addresses="10.1.0.0/16") as guarded:
        for address in ("10.2.0.1", "127.0.0.1", "testclient"):
            guarded.client._transport.client = (address, 1)  # type: ignore[attr-defined]
            headers = {"X-User": "ada@lab", "X-Forwarded-For": "10.1.2.3"}
            read_faults(guarded.ask("GET", "/v1/jobs", headers=headers), 401, "unauthorized")


def test_without_the_mode_the_header_means_nothing(tmp_path: Path) -> None:
    with guard("sqlite", tmp_path, proxy_header="X-User", proxy_addresses="127.0.0.1") as guarded:
        guarded.client._transport.client = ("127.0.0.1", 1)  # type: ignore[attr-defined]
        read_faults(guarded.ask("GET", "/v1/jobs", headers={"X-User": "ada"}), 401, "unauthorized")


@pytest.mark.parametrize(("address", "secure"), [("127.0.0.1", True), ("10.9.9.9", False)])
def test_a_cookie_is_secure_where_a_proxy_speaks_https(
    tmp_path: Path, address: str, secure: bool
) -> None:
    with guard("sqlite", tmp_path) as guarded:
        token = guarded.add_key()
        guarded.client._transport.client = (address, 1)  # type: ignore[attr-defined]
        headers = {"X-Forwarded-Proto": "https"}
        answer = guarded.ask("POST", "/sign-in", data={"key": token}, headers=headers)
        assert ("Secure" in answer.headers["set-cookie"]) is secure


@pytest.mark.parametrize(
    ("address", "told", "seen"),
    [
        ("127.0.0.1", "203.0.113.5", "203.0.113.5"),
        ("10.9.9.9", "203.0.113.5", "10.9.9.9"),
        ("127.0.0.1", "x" * 5000, "x" * 100),
    ],
    ids=["a proxy", "another peer", "a proxy that passes on a lie"],
)
def test_only_a_proxy_tells_from_where_a_wrong_key_came(
    tmp_path: Path, address: str, told: str, seen: str
) -> None:
    with guard("sqlite", tmp_path) as guarded:
        token = guarded.add_key()
        guarded.client._transport.client = (address, 1)  # type: ignore[attr-defined]
        headers = {
            "X-Forwarded-For": told,
            "Forwarded": "for=203.0.113.6",
            "X-Forwarded-Host": "evil.example",
        }
        form = guarded.ask("POST", "/sign-in", data={"key": f"{token}0"}, headers=headers)
        assert form.status_code == 401
        assert "evil.example" not in form.text
        (entry, *_) = guarded.ask("GET", "/v1/audit", token).json()["items"]
        assert (entry["action"], entry["actor"]) == ("key.refuse", f"address:{seen}")


def test_on_loopback_nothing_is_asked(tmp_path: Path) -> None:
    with TestClient(create_app(settings_of(tmp_path))) as client:
        answer = client.get("/v1/access", headers={"Authorization": "Bearer lagid_1_2"}).json()
        assert (answer["actor"], answer["project"]) == ("loopback", "proj_default")
        assert "Sign out" not in client.get("/").text
        assert client.get("/v1/audit").json()["items"] == []


def test_an_open_host_without_keys_does_not_call_its_callers_loopback(tmp_path: Path) -> None:
    settings = settings_of(tmp_path, host="0.0.0.0", allow_open_host=True)
    with TestClient(create_app(settings)) as client:
        assert client.get("/v1/access").json()["actor"] == "anybody"
