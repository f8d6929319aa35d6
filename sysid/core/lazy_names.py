"""Load on first use: public names of a package, and libraries that a user may not have."""

import ast
from collections.abc import Iterator
from importlib import import_module
from typing import Any


def put_off_imports(package: dict[str, Any]) -> None:
    """Import the public names of a package when they are used, each from its own module.

    They stand in the block ``if TYPE_CHECKING:`` of the package's source. So type checkers
    and editors read plain imports, and a name stands once. A star stands for the public names of a
    package that does the same. SPEC 1 of Scientific Python does so with a stub.

    Parameters
    ----------
    package : dict of str to Any
        The ``globals()`` of the package. It is given ``__all__`` and ``__getattr__``.
    """
    source = package["__spec__"].loader.get_source(package["__name__"])
    modules = dict(_list_imports(source))

    def load_name(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package['__name__']!r} has no attribute {name!r}")
        package[name] = getattr(import_module(modules[name]), name)  # the next use finds it there
        return package[name]

    package |= {"__all__": sorted(modules), "__getattr__": load_name}


def _list_imports(source: str) -> Iterator[tuple[str, str]]:
    """List the names that a file imports for type checkers, and the module of each."""
    for block in ast.parse(source).body:
        if not (isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"):
            continue
        for line in block.body:
            assert isinstance(line, ast.ImportFrom)
            assert line.module is not None
            for alias in line.names:
                star = alias.name == "*"
                names = import_module(line.module).__all__ if star else [alias.name]
                yield from ((name, line.module) for name in names)


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
