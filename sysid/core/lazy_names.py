"""Load on first use: public names of a package, and libraries that a user may not have."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def load_on_first_use(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Make the function `__getattr__` of a package.

    Parameters
    ----------
    package : str
    modules : mapping of str to str
        Public name → module that defines it.

    Examples
    --------
    >>> load_name = load_on_first_use("sysid.core", {"sqrt": "math"})
    >>> load_name("sqrt")(9.0)
    3.0
    """

    def load_name(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(modules[name]), name)
        setattr(sys.modules[package], name, value)  # the next use finds it there
        return value

    return load_name


def load_library(name: str, call: str) -> Any:
    """Load a library that only `call` needs.

    Raises
    ------
    MissingLibrary
        If it is not installed.
    """
    try:
        return import_module(name)
    except ImportError:
        from sysid.core.errors import MissingLibrary  # `import lagid` does without

        raise MissingLibrary(call, name.partition(".")[0]) from None
