"""How a recursion reads a signal between its samples, as weights of whole samples."""

from math import floor, prod

from sysid.export.identified import Identified
from sysid.export.linear import Signal
from sysid.kernels.demand import averaged_inputs
from sysid.kernels.inputs import DENSE, MOST_POINTS


def taps(
    identified: Identified, signal: Signal, *, finished: int, updated: bool
) -> dict[int, float]:
    """Weights of whole samples that give a signal between them, as the simulation reads it.

    Parameters
    ----------
    identified : Identified
    signal : Signal
        Its delay in samples.
    finished : int
        How many samples ago the last one was that is known: 1 in an equation, 0 in an output.
    updated : bool
        Whether a state's present sample is known; if not, the one before stands for it.
    """
    if signal.kind == "input":
        found = _input_taps(identified, signal)
    else:
        found = _state_taps(identified, signal.delay, finished)
    if signal.kind == "state" and not updated and 0 in found:
        found[1] = found.get(1, 0.0) + found.pop(0)
    return {back: weight for back, weight in found.items() if weight != 0.0}


def _input_taps(identified: Identified, signal: Signal) -> dict[int, float]:
    delay = signal.delay
    if identified.model.solver.interpolation == "nearest":
        return {floor(delay + 0.5): 1.0}
    if identified.hold(signal.name) == "zero" and signal.name in averaged_inputs(identified.model):
        return _held_taps(delay, 0.5 / identified.model.solver.substeps)
    if identified.hold(signal.name) == "zero":
        return _held_taps(delay, 1.0 / min(max(_even(identified), 4), MOST_POINTS))
    return _through(delay, (0, 1))


def _even(identified: Identified) -> int:
    """Fine points in a step of the simulation; half of one is where a jump is read."""
    return 2 * -(-DENSE // (2 * identified.model.solver.substeps))


def _held_taps(delay: float, ramp: float) -> dict[int, float]:
    place = -delay + ramp
    nearest = floor(place + 0.5)
    part = min(max((place - nearest + ramp) / (2 * ramp), 0.0), 1.0)
    return {1 - nearest: 1.0 - part, -nearest: part}


def _state_taps(identified: Identified, delay: float, finished: int) -> dict[int, float]:
    interpolation = identified.model.solver.interpolation
    if interpolation == "nearest":
        return {floor(delay + 0.5): 1.0}
    if interpolation == "linear" or delay < finished:
        return _through(delay, (0, 1))
    return _through(delay, (-1, 0, 1, 2) if floor(finished - delay) <= -2 else (-1, 0, 1))


def _through(delay: float, nodes: tuple[int, ...]) -> dict[int, float]:
    """The polynomial through the samples at these places beside the one before."""
    i = floor(-delay)
    part = -delay - i
    if part == 0.0:
        return {-i: 1.0}
    return {-(i + a): prod((part - b) / (a - b) for b in nodes if b != a) for a in nodes}
