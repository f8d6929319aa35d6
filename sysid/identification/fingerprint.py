"""Which program computes: results are the same bits as long as it does not change."""

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

from sysid.kernels.machine_code import machine_name

_LIBRARIES = ("numpy", "scipy", "numba")


@cache
def program(*packages: Path) -> str:
    """Digest of all that a result depends on besides its specification.

    The sources of this package and of those given as folders, the versions of the libraries, and
    what kernels depend on in the machine.
    """
    parts = [machine_name(), *(f"{name} {version(name)}" for name in _LIBRARIES)]
    digest = hashlib.blake2b("\n".join(parts).encode(), digest_size=16)
    for folder in (Path(__file__).parents[1], *packages):
        for path in sorted([*folder.rglob("*.py"), *folder.rglob("*.yaml")]):
            digest.update(str(path.relative_to(folder.parent)).encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()
