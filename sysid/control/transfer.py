"""Transfer functions of a linear model, from every input to every output.

How a recursion reads a signal between its samples, as weights of whole samples.

Polynomials in s with dead times: sums of c s^p e^(-s d); in z⁻¹ with p = 0 and d in samples.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import floor, prod
from typing import NamedTuple, TypeAlias

from sysid.control.linear_form import Affine, Identified, Linear, NotLinear, Signal, linear_form
from sysid.data.interpolation import DENSE, MOST_POINTS
from sysid.kernels.reads import averaged_inputs, is_difference

Quasi: TypeAlias = Mapping[tuple[int, float], float]
"""(p, d): coefficient."""

_CANCELLED = 1e-13


def added(first: Quasi, second: Quasi, factor: float = 1.0) -> Quasi:
    """Sum with a multiple of another; what is left of terms that cancel is left out."""
    found = dict(first)
    for key, value in second.items():
        before, change = found.get(key, 0.0), factor * value
        total = before + change
        if abs(total) > _CANCELLED * (abs(before) + abs(change)):
            found[key] = total
        else:
            found.pop(key, None)
    return found


def product(first: Quasi, second: Quasi) -> Quasi:
    """Product of two."""
    found: Quasi = {}
    for (power, delay), value in first.items():
        shifted = {(power + p, delay + d): value * v for (p, d), v in second.items()}
        found = added(found, shifted)
    return found


def determinant(matrix: Sequence[Sequence[Quasi]]) -> Quasi:
    """Determinant of a small square matrix, by its first row."""
    if not matrix:
        return {(0, 0.0): 1.0}
    found: Quasi = {}
    for j, entry in enumerate(matrix[0]):
        if entry:
            minor = [[*row[:j], *row[j + 1 :]] for row in matrix[1:]]
            found = added(found, product(entry, determinant(minor)), -1.0 if j % 2 else 1.0)
    return found


def replaced(
    matrix: Sequence[Sequence[Quasi]], j: int, column: Sequence[Quasi]
) -> list[list[Quasi]]:
    """The matrix with another column j."""
    return [[*row[:j], one, *row[j + 1 :]] for row, one in zip(matrix, column, strict=True)]


def by_delay(found: Quasi) -> list[tuple[float, list[float]]]:
    """Coefficients of falling powers for each dead time, the shortest dead time first."""
    parts: dict[float, dict[int, float]] = {}
    for (power, delay), value in found.items():
        parts.setdefault(delay, {})[power] = value
    return [
        (delay, [powers.get(p, 0.0) for p in range(max(powers), -1, -1)])
        for delay, powers in sorted(parts.items())
    ]


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


MOST_STATES = 8


class Transfer(NamedTuple):
    """From `input` to `output`: numerator and denominator."""

    input: str
    output: str
    numerator: Quasi
    denominator: Quasi


class Transfers(NamedTuple):
    """All pairs of a model; `period` (s) of a recursion, None in continuous time."""

    pairs: tuple[Transfer, ...]
    linear: Linear
    period: float | None


def transfers(identified: Identified) -> Transfers:
    """Transfer functions from the equations, with all lags as they are.

    Raises
    ------
    NotLinear
        If the model is not linear with constant coefficients, has no input, has too many states,
        or is a recursion whose sampling period is not known.
    """
    model = identified.model
    if not model.inputs:
        raise NotLinear("the model has no input, so it has no transfer function")
    period = _period(identified)
    linear = linear_form(identified, period)
    if len(model.states) > MOST_STATES:
        raise NotLinear(
            f"the model has {len(model.states)} states; transfer functions are written of up to "
            f"{MOST_STATES}"
        )
    matrix, columns = _equations(identified, linear)
    denominator = determinant(matrix)
    inside = {
        name: [determinant(replaced(matrix, j, column)) for j in range(len(model.states))]
        for name, column in columns.items()
    }
    pairs = tuple(
        Transfer(name, output.name, _numerator(identified, form, name, states, denominator),
                 denominator)
        for output, form in zip(model.outputs, linear.outputs, strict=True)
        for name, states in inside.items()
    )  # fmt: skip
    return Transfers(pairs, linear, period)


def _period(identified: Identified) -> float | None:
    if not is_difference(identified.model):
        return None
    if identified.sample_time is None:
        raise NotLinear(
            "the model is a recursion and the sampling period of its data is not known, so its "
            "transfer function has none"
        )
    return identified.sample_time / identified.model.solver.substeps


def _equations(
    identified: Identified, linear: Linear
) -> tuple[list[list[Quasi]], Mapping[str, list[Quasi]]]:
    """M X = Σ b U: the matrix M, and b of every input."""
    states = [one.name for one in identified.model.states]
    power = 0 if is_difference(identified.model) else 1
    matrix = []
    columns: dict[str, list[Quasi]] = {one.name: [] for one in identified.model.inputs}
    for i, form in enumerate(linear.equations):
        read = _reader(identified, i)
        row = [read(form, "state", name) for name in states]
        own: Quasi = {(power, 0.0): 1.0}
        matrix.append([added(own if i == j else {}, one, -1.0) for j, one in enumerate(row)])
        for name, column in columns.items():
            column.append(read(form, "input", name))
    return matrix, columns


def _numerator(
    identified: Identified, form: Affine, name: str, states: Sequence[Quasi], denominator: Quasi
) -> Quasi:
    read = _reader(identified, None)
    found = product(read(form, "input", name), denominator)
    for state, inside in zip(identified.model.states, states, strict=True):
        found = added(found, product(read(form, "state", state.name), inside))
    return found


def _reader(identified: Identified, equation: int | None) -> Callable[[Affine, str, str], Quasi]:
    """What one signal contributes to an affine form, in an equation or in an output (None)."""
    model = identified.model

    def weights(signal: Signal) -> Iterable[tuple[float, float]]:
        if not is_difference(model):
            return [(signal.delay, 1.0)]
        updated = equation is None or signal.kind == "input" or signal.delay == 0.0
        if not updated:
            at = [state.name for state in model.states].index(signal.name)
            updated = model.order.index(at) < model.order.index(equation or 0)
        finished = 0 if equation is None else 1
        found = taps(identified, signal, finished=finished, updated=updated)
        return [(float(back), weight) for back, weight in found.items()]

    def read(form: Affine, kind: str, name: str) -> Quasi:
        found: Quasi = {}
        for signal, coefficient in form.terms.items():
            if (signal.kind, signal.name) == (kind, name):
                parts = {(0, delay): weight * coefficient for delay, weight in weights(signal)}
                found = added(found, parts)
        return found

    return read
