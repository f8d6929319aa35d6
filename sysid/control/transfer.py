"""Transfer functions of a linear model, from every input to every output.

They are fractions of polynomials in s with dead times, sums of c s^p e^(-s d). Those of a recursion
are in z⁻¹, with p = 0 and d in samples. A recursion reads a signal between its samples as a
weighted sum of samples.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import floor, prod
from typing import NamedTuple, TypeAlias

from sysid.control.linear_form import (
    AffineForm,
    DelayedSignal,
    IdentifiedModel,
    LinearForm,
    NotLinear,
    to_linear_form,
)
from sysid.data.interpolation import MAX_POINTS_PER_STEP, POINTS_PER_SAMPLE
from sysid.kernels.signals.past_reads import find_averaged_inputs, is_difference

QuasiPolynomial: TypeAlias = Mapping[tuple[int, float], float]
"""(p, d): coefficient."""

_CANCELLATION_TOLERANCE = 1e-13


def add_polynomials(
    first: QuasiPolynomial, second: QuasiPolynomial, factor: float = 1.0
) -> QuasiPolynomial:
    """Add a multiple of another polynomial; terms that cancel up to rounding are removed."""
    terms = dict(first)
    for key, value in second.items():
        before, change = terms.get(key, 0.0), factor * value
        total = before + change
        if abs(total) > _CANCELLATION_TOLERANCE * (abs(before) + abs(change)):
            terms[key] = total
        else:
            terms.pop(key, None)
    return terms


def multiply_polynomials(first: QuasiPolynomial, second: QuasiPolynomial) -> QuasiPolynomial:
    """Multiply two polynomials."""
    product: QuasiPolynomial = {}
    for (power, delay), value in first.items():
        shifted = {(power + p, delay + d): value * v for (p, d), v in second.items()}
        product = add_polynomials(product, shifted)
    return product


def compute_determinant(matrix: Sequence[Sequence[QuasiPolynomial]]) -> QuasiPolynomial:
    """Compute the determinant of a small square matrix, by its first row."""
    if not matrix:
        return {(0, 0.0): 1.0}
    determinant: QuasiPolynomial = {}
    for j, entry in enumerate(matrix[0]):
        if entry:
            minor = [[*row[:j], *row[j + 1 :]] for row in matrix[1:]]
            determinant = add_polynomials(
                determinant,
                multiply_polynomials(entry, compute_determinant(minor)),
                -1.0 if j % 2 else 1.0,
            )
    return determinant


def replace_column(
    matrix: Sequence[Sequence[QuasiPolynomial]], j: int, column: Sequence[QuasiPolynomial]
) -> list[list[QuasiPolynomial]]:
    """Replace column j of a matrix."""
    return [[*row[:j], entry, *row[j + 1 :]] for row, entry in zip(matrix, column, strict=True)]


def group_by_delay(polynomial: QuasiPolynomial) -> list[tuple[float, list[float]]]:
    """Group coefficients of falling powers by dead time, the shortest dead time first."""
    parts: dict[float, dict[int, float]] = {}
    for (power, delay), value in polynomial.items():
        parts.setdefault(delay, {})[power] = value
    return [
        (delay, [powers.get(p, 0.0) for p in range(max(powers), -1, -1)])
        for delay, powers in sorted(parts.items())
    ]


def compute_taps(
    identified: IdentifiedModel, signal: DelayedSignal, *, finished: int, updated: bool
) -> dict[int, float]:
    """Compute the weights of samples that give a delayed signal, as the simulation reads it.

    Parameters
    ----------
    identified : IdentifiedModel
    signal : DelayedSignal
        With its delay in samples.
    finished : int
        Samples since the last computed one: 1 in an equation, 0 in an output.
    updated : bool
        Whether a state's present sample is computed; if not, the previous one replaces it.
    """
    if signal.kind == "input":
        taps = _compute_input_taps(identified, signal)
    else:
        taps = _compute_state_taps(identified, signal.delay, finished)
    if signal.kind == "state" and not updated and 0 in taps:
        taps[1] = taps.get(1, 0.0) + taps.pop(0)
    return {back: weight for back, weight in taps.items() if weight != 0.0}


def _compute_input_taps(identified: IdentifiedModel, signal: DelayedSignal) -> dict[int, float]:
    delay = signal.delay
    if identified.model.solver.interpolation == "nearest":
        return {floor(delay + 0.5): 1.0}
    if identified.get_hold(signal.name) == "zero" and signal.name in find_averaged_inputs(
        identified.model
    ):
        return _compute_held_taps(delay, 0.5 / identified.model.solver.substeps)
    if identified.get_hold(signal.name) == "zero":
        return _compute_held_taps(
            delay, 1.0 / min(max(_count_fine_points(identified), 4), MAX_POINTS_PER_STEP)
        )
    return _interpolate_polynomial(delay, (0, 1))


def _count_fine_points(identified: IdentifiedModel) -> int:
    """Count the fine points in a step of the simulation; a jump is read at half of one."""
    return 2 * -(-POINTS_PER_SAMPLE // (2 * identified.model.solver.substeps))


def _compute_held_taps(delay: float, ramp: float) -> dict[int, float]:
    position = -delay + ramp
    nearest = floor(position + 0.5)
    part = min(max((position - nearest + ramp) / (2 * ramp), 0.0), 1.0)
    return {1 - nearest: 1.0 - part, -nearest: part}


def _compute_state_taps(
    identified: IdentifiedModel, delay: float, finished: int
) -> dict[int, float]:
    interpolation = identified.model.solver.interpolation
    if interpolation == "nearest":
        return {floor(delay + 0.5): 1.0}
    if interpolation == "linear" or delay < finished:
        return _interpolate_polynomial(delay, (0, 1))
    return _interpolate_polynomial(
        delay, (-1, 0, 1, 2) if floor(finished - delay) <= -2 else (-1, 0, 1)
    )


def _interpolate_polynomial(delay: float, nodes: tuple[int, ...]) -> dict[int, float]:
    """Interpolate by the polynomial through the samples at these offsets."""
    i = floor(-delay)
    part = -delay - i
    if part == 0.0:
        return {-i: 1.0}
    return {-(i + a): prod((part - b) / (a - b) for b in nodes if b != a) for a in nodes}


MAX_STATES = 8


class TransferFunction(NamedTuple):
    """Numerator and denominator of the transfer function from `input` to `output`."""

    input: str
    output: str
    numerator: QuasiPolynomial
    denominator: QuasiPolynomial


class TransferFunctions(NamedTuple):
    """Transfer functions of all pairs; `period` (s) of a recursion, None in continuous time."""

    pairs: tuple[TransferFunction, ...]
    linear_form: LinearForm
    period: float | None


def compute_transfer_functions(identified: IdentifiedModel) -> TransferFunctions:
    """Compute transfer functions from the equations, with exact dead times.

    Raises
    ------
    NotLinear
        If the model is not linear with constant coefficients, has no input or too many states, or
        is a recursion whose sampling period is unknown.
    """
    model = identified.model
    if not model.inputs:
        raise NotLinear("the model has no input, so it has no transfer function")
    period = _find_integration_step(identified)
    linear = to_linear_form(identified, period)
    if len(model.states) > MAX_STATES:
        raise NotLinear(
            f"the model has {len(model.states)} states; transfer functions are written for up to "
            f"{MAX_STATES}"
        )
    matrix, columns = _build_equations(identified, linear)
    denominator = compute_determinant(matrix)
    inside = {
        name: [
            compute_determinant(replace_column(matrix, j, column)) for j in range(len(model.states))
        ]
        for name, column in columns.items()
    }
    pairs = tuple(
        TransferFunction(
            name,
            output.name,
            _compute_numerator(identified, form, name, states, denominator),
            denominator,
        )
        for output, form in zip(model.outputs, linear.outputs, strict=True)
        for name, states in inside.items()
    )
    return TransferFunctions(pairs, linear, period)


def _find_integration_step(identified: IdentifiedModel) -> float | None:
    if not is_difference(identified.model):
        return None
    if identified.sample_time is None:
        raise NotLinear(
            "the model is a recursion and the sampling period of its data is unknown, so it has "
            "no transfer function; give the sampling period"
        )
    return identified.sample_time / identified.model.solver.substeps


def _build_equations(
    identified: IdentifiedModel, linear: LinearForm
) -> tuple[list[list[QuasiPolynomial]], Mapping[str, list[QuasiPolynomial]]]:
    """Build M X = Σ b U: the matrix M, and b of every input."""
    states = [state.name for state in identified.model.states]
    power = 0 if is_difference(identified.model) else 1
    matrix = []
    columns: dict[str, list[QuasiPolynomial]] = {
        channel.name: [] for channel in identified.model.inputs
    }
    for i, form in enumerate(linear.equations):
        read = _make_coefficient_reader(identified, i)
        row = [read(form, "state", name) for name in states]
        derivative: QuasiPolynomial = {(power, 0.0): 1.0}
        matrix.append(
            [
                add_polynomials(derivative if i == j else {}, entry, -1.0)
                for j, entry in enumerate(row)
            ]
        )
        for name, column in columns.items():
            column.append(read(form, "input", name))
    return matrix, columns


def _compute_numerator(
    identified: IdentifiedModel,
    form: AffineForm,
    name: str,
    states: Sequence[QuasiPolynomial],
    denominator: QuasiPolynomial,
) -> QuasiPolynomial:
    read = _make_coefficient_reader(identified, None)
    numerator = multiply_polynomials(read(form, "input", name), denominator)
    for state, states_part in zip(identified.model.states, states, strict=True):
        numerator = add_polynomials(
            numerator, multiply_polynomials(read(form, "state", state.name), states_part)
        )
    return numerator


def _make_coefficient_reader(
    identified: IdentifiedModel, equation: int | None
) -> Callable[[AffineForm, str, str], QuasiPolynomial]:
    """Make a function that reads the coefficient of a signal in an equation or output (None)."""
    model = identified.model

    def weights(signal: DelayedSignal) -> Iterable[tuple[float, float]]:
        if not is_difference(model):
            return [(signal.delay, 1.0)]
        updated = equation is None or signal.kind == "input" or signal.delay == 0.0
        if not updated:
            at = [state.name for state in model.states].index(signal.name)
            updated = model.order.index(at) < model.order.index(equation or 0)
        finished = 0 if equation is None else 1
        taps = compute_taps(identified, signal, finished=finished, updated=updated)
        return [(float(back), weight) for back, weight in taps.items()]

    def read(form: AffineForm, kind: str, name: str) -> QuasiPolynomial:
        polynomial: QuasiPolynomial = {}
        for signal, coefficient in form.terms.items():
            if (signal.kind, signal.name) == (kind, name):
                parts = {(0, delay): weight * coefficient for delay, weight in weights(signal)}
                polynomial = add_polynomials(polynomial, parts)
        return polynomial

    return read
