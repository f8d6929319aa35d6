"""Types of the answers of the REST interface.

Editors and type checkers read them from the stub beside this module. At run time each is a plain
dictionary, so a client loads no list of them.
"""

from typing import Any, NewType


def __getattr__(name: str) -> Any:
    if not name.endswith("Document"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return NewType(name, dict[str, Any])
