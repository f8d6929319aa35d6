"""A working folder whose modules have the names of ours and of libraries, and tell if they run."""

from pathlib import Path

NAMES = ("service", "sysid", "workers", "migrations", "numpy", "numba", "ray", "json", "secrets")
_MODULE = """
import pathlib
pathlib.Path({mark!r}).touch()
raise RuntimeError("a module of the working folder was imported")
"""


class ForeignFolder:
    """A folder of such modules: packages and single files by turns."""

    def __init__(self, folder: Path) -> None:
        self.path, self._marks = folder / "foreign", folder / "imported"
        self.path.mkdir()
        self._marks.mkdir()
        for number, name in enumerate((*NAMES, "sitecustomize", "usercustomize")):
            file = self.path / (f"{name}.py" if number % 2 else f"{name}/__init__.py")
            file.parent.mkdir(exist_ok=True)
            file.write_text(_MODULE.format(mark=str(self._marks / name)))

    def list_imported(self) -> list[str]:
        """List the modules of the folder that some process has run."""
        return sorted(mark.name for mark in self._marks.iterdir())
