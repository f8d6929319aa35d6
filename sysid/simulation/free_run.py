"""The free run of a model with a filter: its outputs follow from the inputs alone."""

from dataclasses import replace

import numpy as np

from sysid.core.types import FloatArray
from sysid.models.kalman_filter import is_noise_parameter
from sysid.simulation.problem import Problem


def build_free_run(problem: Problem) -> Problem:
    """Build the problem without a filter, with the same parameters."""
    settings = problem.settings
    kept = {name: one for name, one in settings.parameters.items() if not is_noise_parameter(name)}
    return problem.rebuild(loss=replace(settings.loss, noise_model="white"), parameters=kept)


def convert_to_free_run(problem: Problem, theta: FloatArray) -> tuple[Problem, FloatArray]:
    """Convert an estimate (D,) to the problem without a filter, and its parameters."""
    if not problem.model.corrections:
        return problem, theta
    free = build_free_run(problem)
    values = dict(zip(problem.free_names, theta.tolist(), strict=True))
    return free, np.array([values[name] for name in free.free_names])


def simulate_free_run(problem: Problem, theta: FloatArray) -> tuple[Problem, FloatArray]:
    """Simulate the free run at an estimate (D,): its problem, and the values (M,)."""
    free, point = convert_to_free_run(problem, theta)
    return free, free.predict(point[None])[0]
