"""Numerics: errors of the integration that the residuals show.

An input that jumps inside an integration step leaves an error there. Coloured noise is small from
one sample to the next, so even a small error shows. The column is ŷ(finer step) - ŷ.
"""

from collections.abc import Iterator

import numpy as np

from sysid.core.errors import SysidError
from sysid.judgement.residual_context import Candidate, ResidualContext
from sysid.kernels.signals.past_reads import is_difference
from sysid.models.model import MAX_SUBSTEPS, replace_substeps

_FINER = 4  # times as many steps


def propose(context: ResidualContext) -> Iterator[Candidate]:
    """Propose that the integration step is too long for the data."""
    model = context.problem.untied_model
    steps = _FINER * model.solver.substeps
    if is_difference(model) or steps > MAX_SUBSTEPS:
        return
    try:
        finer = context.simulate(model=replace_substeps(model, steps))
    except SysidError:
        return
    moved = finer - context.simulated
    if np.all(np.isfinite(moved)) and moved.any():
        yield Candidate(
            "integration step",
            "numerics",
            context.weigh(moved),
            "the integration step is long",
            "the residuals show errors of the integration",
            f"Set substeps: {steps} in the solver of the model's document.",
            is_added=True,
        )
