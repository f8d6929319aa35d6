"""Serialisation of a run's state for SQL. Only this program reads and writes it."""

import pickle
import zlib
from importlib.metadata import version

from sysid.islands.state import RunState

_HEADER = f"lagid {version('lagid')} run state 1\n".encode()


def pack_state(state: RunState) -> bytes:
    """Serialise the state, with a header for the version that can read it."""
    return _HEADER + zlib.compress(pickle.dumps(state, protocol=5), level=1)


def unpack_state(data: bytes | None) -> RunState | None:
    """Restore the state; None if there is none or another version wrote it."""
    if data is None or not data.startswith(_HEADER):
        return None
    state = pickle.loads(zlib.decompress(data[len(_HEADER) :]))
    return state if isinstance(state, RunState) else None
