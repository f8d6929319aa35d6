"""Fitted signals of a stored run, computed again from its estimates instead of stored.

A simulation takes milliseconds where a search takes seconds, and the same program gives the same
bits. So the runs of a large sweep need not store their signals.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.settings import FitSettings, InitialSetting
from sysid.core.threads import use_one_thread
from sysid.core.types import FloatArray
from sysid.identification.fit_problems import FitRecords, build_problems
from sysid.judgement.validation import simulate_validation, split_outputs
from sysid.models.model import Model, replace_substeps
from sysid.uncertainty.estimates import Estimate


class FittedSignals(NamedTuple):
    """Simulated outputs of each record, as in `Identification`."""

    simulated: tuple[tuple[FloatArray, ...], ...]
    simulated_validation: tuple[tuple[FloatArray, ...], ...]


def resimulate_run(
    model: Model,
    records: FitRecords,
    settings: FitSettings,
    estimates: Sequence[Estimate],
    substeps: int,
    initial: InitialSetting | None = None,
) -> FittedSignals:
    """Simulate the outputs of a run again, bit for bit as the run did.

    Parameters
    ----------
    model : Model
        As requested, before terms were selected.
    estimates : sequence of Estimate
        Of the run; bounds and values count.
    substeps : int
        Integration steps in a sample of the result.
    initial : {"rest", "free", "measured"} or None
        Start that the estimates assume; None: as the settings say.

    Raises
    ------
    SysidError
        If model, records or settings cannot be used.
    """
    with use_one_thread():
        problem, validation = build_problems(model, records, settings)
        if substeps != problem.model.solver.substeps:
            problem = problem.rebuild(model=replace_substeps(problem.given_model, substeps))
        if initial is not None:
            problem = problem.rebuild(initial=initial)
        values = {estimate.name: estimate.value for estimate in estimates}
        missing = [name for name in problem.free_names if name not in values]
        if missing:
            raise InvalidSettings("/parameters", f"there is no estimate of {', '.join(missing)}")
        theta = np.array([values[name] for name in problem.free_names])
        simulated = split_outputs(problem, problem.predict_ahead(theta[None])[0][0])
        if validation is None:
            return FittedSignals(simulated, ())
        return FittedSignals(simulated, simulate_validation(validation, problem, estimates).scored)
