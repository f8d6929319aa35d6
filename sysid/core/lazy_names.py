"""Load on first use: public names of a package, and libraries that a user may not have."""

import builtins
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import SimpleNamespace
from typing import Any


@contextmanager
def load_on_first_use(package: dict[str, Any]) -> Iterator[None]:
    """Put off the imports of a block until their names are used; they are the public ones.

    Type checkers and editors see plain imports. None of them is carried out: Python is given a
    stand-in for each module, and the package finds its names when somebody asks for one.

    Parameters
    ----------
    package : dict of str to Any
        The ``globals()`` of the package.

    Examples
    --------
    >>> with load_on_first_use(globals()):
    ...     from math import sqrt
    >>> "sqrt" in globals(), __all__
    (False, ['sqrt'])
    """
    modules: dict[str, str] = {}
    import_as_usual = builtins.__import__

    def note_import(
        module: str, scope: Any = None, local: Any = None, names: Any = (), level: int = 0
    ) -> Any:
        if scope is not package:  # another thread imports meanwhile
            return import_as_usual(module, scope, local, names, level)
        public = import_module(module).__all__ if names == ("*",) else names
        modules.update(dict.fromkeys(public, module))
        return SimpleNamespace(__all__=public, **dict.fromkeys(public))

    def load_name(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package['__name__']!r} has no attribute {name!r}")
        package[name] = getattr(import_module(modules[name]), name)  # the next use finds it there
        return package[name]

    vars(builtins)["__import__"] = note_import
    try:
        yield
    finally:
        vars(builtins)["__import__"] = import_as_usual
    for name in modules:
        del package[name]
    package |= {"__all__": sorted(modules), "__getattr__": load_name}


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
