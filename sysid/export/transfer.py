"""Transfer functions of a linear model, from every input to every output."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from sysid.export.identified import Identified
from sysid.export.linear import Affine, Linear, NotLinear, Signal, linear_form
from sysid.export.quasi import Quasi, added, determinant, product, replaced
from sysid.export.taps import taps
from sysid.kernels.demand import is_difference

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
