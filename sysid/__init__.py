"""Identification of nonlinear systems with unknown time lags: the numerical core.

The public names are found in their modules when they are first asked for: `import sysid.errors`
brings neither the compiler nor SciPy, so web process, command line and upload reader start fast.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sysid.errors import SysidError
    from sysid.export.exporting import export
    from sysid.identify import identify
    from sysid.models.library import catalogue, load_model
    from sysid.noise import Noise
    from sysid.parameters import Parameter
    from sysid.problem import Problem
    from sysid.records import Channel, History, Record, Recording
    from sysid.result import Estimate, Identification
    from sysid.settings import GeneticAlgorithm, IslandChange, Loss, Migration, SequenceSearch, Stop
    from sysid.simulation import simulate

__all__ = [
    "Channel", "Estimate", "GeneticAlgorithm", "History", "Identification", "IslandChange", "Loss",
    "Migration", "Noise", "Parameter", "Problem", "Record", "Recording", "SequenceSearch", "Stop",
    "SysidError", "catalogue", "export", "identify", "load_model", "simulate",
]  # fmt: skip

_PLACES = {
    "errors": ("SysidError",),
    "export.exporting": ("export",),
    "identify": ("identify",),
    "models.library": ("catalogue", "load_model"),
    "noise": ("Noise",),
    "parameters": ("Parameter",),
    "problem": ("Problem",),
    "records": ("Channel", "History", "Record", "Recording"),
    "result": ("Estimate", "Identification"),
    "settings": ("GeneticAlgorithm", "IslandChange", "Loss", "Migration", "SequenceSearch", "Stop"),
    "simulation": ("simulate",),
}
_MODULE_OF = {name: module for module, names in _PLACES.items() for name in names}


class _Face(ModuleType):
    """The package, whose `identify` is the function and not the module of that name."""

    def __getattr__(self, name: str) -> Any:
        if name not in _MODULE_OF:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        found = getattr(import_module(f"{self.__name__}.{_MODULE_OF[name]}"), name)
        self.__dict__[name] = found
        return found

    def __setattr__(self, name: str, value: object) -> None:
        # The import system sets every submodule as an attribute of its package.
        if name not in _MODULE_OF or not isinstance(value, ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Face
