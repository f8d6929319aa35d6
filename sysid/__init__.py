"""Identification of nonlinear systems with unknown time lags: the numerical core.

The public names are imported from their modules on first use. `import sysid.core.errors` loads
neither the compiler nor SciPy, so web process, command line and upload reader start fast.
"""

from typing import TYPE_CHECKING

from sysid.core.lazy_names import load_on_first_use

if TYPE_CHECKING:
    from sysid.core.errors import (
        DivergedEverywhere,
        InvalidModel,
        InvalidRecord,
        InvalidSettings,
        MissingLibrary,
        NothingIdentifiable,
        RecordTooShort,
        SysidError,
        UnknownModel,
        UnknownParameter,
        UnreadableFile,
        UnreadableResult,
        UnwritableFile,
    )
    from sysid.core.settings import (
        GeneticAlgorithm,
        IslandChange,
        Loss,
        Migration,
        SequenceSearch,
        Stop,
    )
    from sysid.data.noise import Noise
    from sysid.data.records import Channel, History, Record, Recording
    from sysid.data.table_rules import ReadingNote
    from sysid.export.export import export_model
    from sysid.export.load import load_identified
    from sysid.identification.identify import identify
    from sysid.models.catalogue.load import catalogue, load_model
    from sysid.models.parameters import Parameter
    from sysid.results.identification import Identification
    from sysid.simulation.problem import Problem
    from sysid.simulation.simulate import simulate
    from sysid.uncertainty.estimates import Estimate

__all__ = [
    "Channel",
    "DivergedEverywhere",
    "Estimate",
    "GeneticAlgorithm",
    "History",
    "Identification",
    "InvalidModel",
    "InvalidRecord",
    "InvalidSettings",
    "IslandChange",
    "Loss",
    "Migration",
    "MissingLibrary",
    "Noise",
    "NothingIdentifiable",
    "Parameter",
    "Problem",
    "ReadingNote",
    "Record",
    "RecordTooShort",
    "Recording",
    "SequenceSearch",
    "Stop",
    "SysidError",
    "UnknownModel",
    "UnknownParameter",
    "UnreadableFile",
    "UnreadableResult",
    "UnwritableFile",
    "catalogue",
    "export_model",
    "identify",
    "load_identified",
    "load_model",
    "simulate",
]

DISTRIBUTION = "lagid"
"""Tells this package from others of the name; `lagid` looks at it."""

_PUBLIC_NAMES = {
    "core.errors": (
        "DivergedEverywhere",
        "InvalidModel",
        "InvalidRecord",
        "InvalidSettings",
        "MissingLibrary",
        "NothingIdentifiable",
        "RecordTooShort",
        "SysidError",
        "UnknownModel",
        "UnknownParameter",
        "UnreadableFile",
        "UnreadableResult",
        "UnwritableFile",
    ),
    "core.settings": (
        "GeneticAlgorithm",
        "IslandChange",
        "Loss",
        "Migration",
        "SequenceSearch",
        "Stop",
    ),
    "data.noise": ("Noise",),
    "data.records": ("Channel", "History", "Record", "Recording"),
    "data.table_rules": ("ReadingNote",),
    "export.export": ("export_model",),
    "export.load": ("load_identified",),
    "identification.identify": ("identify",),
    "results.identification": ("Identification",),
    "models.catalogue.load": ("catalogue", "load_model"),
    "models.parameters": ("Parameter",),
    "simulation.problem": ("Problem",),
    "simulation.simulate": ("simulate",),
    "uncertainty.estimates": ("Estimate",),
}
_MODULE_BY_NAME = {
    name: f"{__name__}.{module}" for module, names in _PUBLIC_NAMES.items() for name in names
}

__getattr__ = load_on_first_use(__name__, _MODULE_BY_NAME)
