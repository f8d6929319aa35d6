"""The state of a search in the parameters of a problem with other starts, or with a filter."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sysid.core.types import FloatArray
from sysid.islands.run_state import RunState
from sysid.search.archive import convert_archive
from sysid.search.island import Island
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit, to_unit
from sysid.simulation.start_values import convert_point


def convert_state(
    before: Problem, after: Problem, state: RunState, added: Mapping[str, float] | None = None
) -> RunState:
    """Convert champions and minima of a search; its population stays as it was.

    `added` are values of parameters that only the other problem has.
    """
    n = len(after.free_parameters)

    def convert_unit(unit: FloatArray) -> FloatArray:
        theta = convert_point(before, after, from_unit(before.evaluator, unit[None])[0], added)
        return np.asarray(to_unit(after.evaluator, theta[None])[0])

    def convert_island(island: Island) -> Island:
        history = tuple(
            one._replace(
                parameters=tuple(
                    convert_point(before, after, np.array(one.parameters), added).tolist()
                )
            )
            for one in island.history
        )
        return replace(
            island, history=history, archive=convert_archive(island.archive, convert_unit, n)
        )

    return replace(state, islands=tuple(convert_island(island) for island in state.islands))
