"""Readers of stored result documents."""

from collections.abc import Mapping
from typing import Any


def is_free(estimate: Mapping[str, Any]) -> bool:
    """Test whether an entry of ``parameters`` was estimated, that is, neither fixed nor tied."""
    return estimate["status"] not in ("fixed", "tied")


def read_noise_model(result: Mapping[str, Any]) -> str:
    """Read the noise model that the estimates used, whatever the request asked for."""
    return "ar1" if any((result.get("correlation_times") or {}).values()) else "white"
