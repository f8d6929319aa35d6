"""Scopes of keys, and the scope that each request needs.

The rules go by method and path, so a new route has one without any word about it.
"""

import re
from typing import Literal, get_args

Scope = Literal["read", "write", "admin"]
SCOPES: tuple[Scope, ...] = get_args(Scope)
"""From the least to the most; each one includes those before it."""

_READING_METHODS = ("GET", "HEAD")
_PUBLIC = re.compile(
    r"/(healthz|readyz|docs|openapi\.json|sign-in|sign-out|problems/[^/]*|static/[^/]*|guides(/.*)?)"
)
"""Paths without anything of a project: health, texts of the program, and the way in."""
_ADMIN = re.compile(r"/v1/audit|/keys(/.*)?|/settings")
_COMPUTING = re.compile(r"/v1/(models:check|runs:compare|runs/[^/]+:(validate|profile))")
"""Paths that compute an answer to a body, and store nothing."""


def include_scopes(scope: Scope) -> tuple[Scope, ...]:
    """Return a scope with those that it includes.

    Examples
    --------
    >>> include_scopes("write")
    ('read', 'write')
    """
    return SCOPES[: SCOPES.index(scope) + 1]


def find_needed_scope(method: str, path: str) -> Scope | None:
    """Return the scope that a request needs; None if it needs no key.

    Parameters
    ----------
    path : str
        Path of a request, or of an operation of the OpenAPI document.

    Examples
    --------
    >>> find_needed_scope("GET", "/v1/jobs"), find_needed_scope("POST", "/v1/jobs")
    ('read', 'write')
    """
    if method == "OPTIONS" or _PUBLIC.fullmatch(path):
        return None
    if _ADMIN.fullmatch(path):
        return "admin"
    if method in _READING_METHODS or (method == "POST" and _COMPUTING.fullmatch(path)):
        return "read"
    return "write"
