"""A run's state as bytes in SQL. Only this program writes and reads them, in its own database."""

import pickle
import zlib
from importlib.metadata import version

from sysid.islands.state import RunState

_HEADER = f"lagid {version('lagid')} run state 1\n".encode()


def pack_state(state: RunState) -> bytes:
    """The state as bytes, headed by the version that can read them."""
    return _HEADER + zlib.compress(pickle.dumps(state, protocol=5), level=1)


def unpack_state(data: bytes | None) -> RunState | None:
    """The state, or None if there is none or another version wrote it: the run starts anew."""
    if data is None or not data.startswith(_HEADER):
        return None
    state = pickle.loads(zlib.decompress(data[len(_HEADER) :]))
    return state if isinstance(state, RunState) else None
