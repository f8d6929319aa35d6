"""Secrets of keys and browsers: made here, and stored as digests only."""

import hashlib
import secrets
from hmac import compare_digest
from typing import NamedTuple

from service.core.bodies.text_checks import find_text_fault

SECRET_BYTES = 32
"""256 random bits: no list of guesses reaches them, so a plain digest is enough."""
MAX_TOKEN_CHARACTERS = 200
_PREFIX, _KEY_PREFIX = "lagid", "key_"


class TokenParts(NamedTuple):
    """Identifier of a key, and the secret that shows who has it."""

    key_id: str
    secret: str


def make_secret() -> str:
    """Make a secret as hexadecimal digits."""
    return secrets.token_hex(SECRET_BYTES)


def hash_secret(secret: str) -> str:
    """Return the digest of a secret, which is stored."""
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()


def is_secret(secret: str, digest: str) -> bool:
    """Return whether a secret has this digest; the time does not tell how much of it is right."""
    return compare_digest(hash_secret(secret), digest)


def write_token(key_id: str, secret: str) -> str:
    """Return the text that a user sends as the API key.

    Examples
    --------
    >>> write_token("key_01", "ab")
    'lagid_01_ab'
    """
    return f"{_PREFIX}_{key_id.removeprefix(_KEY_PREFIX)}_{secret}"


def parse_token(token: str) -> TokenParts | None:
    """Split the text of an API key; None if it has another form.

    Examples
    --------
    >>> parse_token("lagid_01_ab")
    TokenParts(key_id='key_01', secret='ab')
    """
    parts = token.strip().split("_")
    is_storable = len(token) <= MAX_TOKEN_CHARACTERS and find_text_fault(token) is None
    if not is_storable or len(parts) != 3 or parts[0] != _PREFIX or not all(parts):
        return None
    return TokenParts(f"{_KEY_PREFIX}{parts[1]}", parts[2])
