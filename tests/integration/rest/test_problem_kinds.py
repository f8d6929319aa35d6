"""Every type of a problem document has a page that explains it."""

from starlette.testclient import TestClient

from service.api.requests.problems import STATUS_KINDS
from service.api.routes.health_routes import PROBLEM_KINDS
from service.core import errors
from service.core.errors import ServiceError

ONLY_OF_COMMANDS = {errors.Misconfigured, errors.ServiceDidNotStart}


def list_http_errors() -> list[type[ServiceError]]:
    """The errors that a request can meet; those of commands alone have no page."""
    named = [value for value in vars(errors).values() if isinstance(value, type)]
    return [
        kind
        for kind in named
        if issubclass(kind, ServiceError)
        and kind is not ServiceError
        and kind not in ONLY_OF_COMMANDS
    ]


def test_every_kind_of_problem_is_explained(server: TestClient) -> None:
    kinds = {error.kind for error in list_http_errors()} | set(STATUS_KINDS.values())
    assert kinds | {"internal", "invalid-upload"} == set(PROBLEM_KINDS)
    for kind in kinds:
        assert server.get(f"/problems/{kind}").text == PROBLEM_KINDS[kind]
