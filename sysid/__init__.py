"""Identification of nonlinear systems with unknown time lags: the numerical core.

The public names are imported from their modules on first use. `import sysid.core.errors` loads
neither the compiler nor SciPy, so web process, command line and upload reader start fast.
"""

from typing import TYPE_CHECKING

from sysid.core.lazy_names import put_off_imports

_DISTRIBUTION = "lagid"
"""Tells this package from others of the name; `lagid` looks at it."""

if TYPE_CHECKING:
    from sysid.core.errors import DivergedEverywhere as DivergedEverywhere
    from sysid.core.errors import InvalidModel as InvalidModel
    from sysid.core.errors import InvalidRecord as InvalidRecord
    from sysid.core.errors import InvalidSettings as InvalidSettings
    from sysid.core.errors import MissingLibrary as MissingLibrary
    from sysid.core.errors import NothingIdentifiable as NothingIdentifiable
    from sysid.core.errors import RecordTooShort as RecordTooShort
    from sysid.core.errors import SysidError as SysidError
    from sysid.core.errors import UnknownModel as UnknownModel
    from sysid.core.errors import UnknownParameter as UnknownParameter
    from sysid.core.errors import UnreadableFile as UnreadableFile
    from sysid.core.errors import UnreadableResult as UnreadableResult
    from sysid.core.errors import UnwritableFile as UnwritableFile
    from sysid.core.settings import GeneticAlgorithm as GeneticAlgorithm
    from sysid.core.settings import IslandChange as IslandChange
    from sysid.core.settings import Loss as Loss
    from sysid.core.settings import Migration as Migration
    from sysid.core.settings import SequenceSearch as SequenceSearch
    from sysid.core.settings import Stop as Stop
    from sysid.data.noise import Noise as Noise
    from sysid.data.records import Channel as Channel
    from sysid.data.records import History as History
    from sysid.data.records import Record as Record
    from sysid.data.records import Recording as Recording
    from sysid.data.table_rules import ReadingNote as ReadingNote
    from sysid.export.export import export_model as export_model
    from sysid.export.load_export import load_identified as load_identified
    from sysid.identification.identify import identify as identify
    from sysid.inspection.inspect import check_recording as check_recording
    from sysid.models.catalogue.load import catalogue as catalogue
    from sysid.models.catalogue.load import load_model as load_model
    from sysid.models.parameters import Parameter as Parameter
    from sysid.results.identification import Identification as Identification
    from sysid.simulation.problem import Problem as Problem
    from sysid.simulation.simulate import simulate as simulate
    from sysid.uncertainty.estimates import Estimate as Estimate

put_off_imports(globals())
