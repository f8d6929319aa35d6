"""Fingerprint of the program: equal fingerprints give results equal bit for bit."""

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

from sysid.core.code_cache import digest_files
from sysid.kernels.compilation.machine_code import describe_machine

_LIBRARIES = ("numpy", "scipy", "numba", "emcee")


@cache
def compute_fingerprint(*packages: Path) -> str:
    """Compute a digest of all that a result depends on in addition to its specification.

    It covers the sources of this package and of the folders `packages`. It also covers the versions
    of the libraries and the properties of the machine that kernels depend on.
    """
    parts = [describe_machine(), *(f"{name} {version(name)}" for name in _LIBRARIES)]
    for folder in (Path(__file__).parents[1], *packages):
        sources = (*folder.rglob("*.py"), *folder.rglob("*.yaml"))
        parts.append(digest_files(sources, folder.parent))
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=16).hexdigest()
