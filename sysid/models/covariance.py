"""How the covariance of a model's states moves between samples.

The tangent of a differential model is A = ∂f/∂x, and P' = A P + P Aᵀ + Q. A recursion moves a
sample of its states into the next one: P ← A P Aᵀ + G Q Gᵀ. There an equation may read other states
at the same sample, so noise of one state may enter others at once, by G.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from sysid.language.derivative import ONE, ZERO, add, differentiate, multiply
from sysid.language.tree import Expression, Number, PastValue
from sysid.models.model import Model

Pair = tuple[str, str]
Slopes = dict[Pair, Expression]


@dataclass(frozen=True, slots=True)
class Tangent:
    """Slopes of states by states, and by the noise of states; those that miss are zero.

    Attributes
    ----------
    states : dict of (str, str) to Expression
        Of a rate by a state, or of a sample by a state one sample before.
    noises : dict of (str, str) to Expression
        Of a sample of a recursion by the noise of a state.
    """

    states: Slopes = field(default_factory=dict)
    noises: Slopes = field(default_factory=dict)

    def find_noisy(self, names: Sequence[str], sources: Iterable[str]) -> list[str]:
        """Find the states that noise of some states reaches, in the order of `names`."""
        noisy = set(sources)
        slopes = (*self.states, *self.noises)
        while reached := {a for a, b in slopes if b in noisy} - noisy:
            noisy |= reached
        return [name for name in names if name in noisy]


class StateCovariance(NamedTuple):
    """Entries of P for the states that noise reaches; it is symmetric."""

    noisy: Sequence[str]

    @property
    def pairs(self) -> list[Pair]:
        """Pairs of states, each once."""
        return [(a, b) for i, a in enumerate(self.noisy) for b in self.noisy[i:]]

    def name(self, pair: Pair) -> str:
        """Name an entry."""
        first, second = sorted(pair, key=self.noisy.index)
        return f"P[{first},{second}]"

    def read(self, pair: Pair) -> PastValue:
        """Read an entry as it is."""
        return PastValue(self.name(pair), "state")


def is_covariance(state: str) -> bool:
    """Whether a state is an entry of P."""
    return state.startswith("P[")


def list_noisy(states: Sequence[str]) -> list[str]:
    """List the states of a filter whose variances are among its states."""
    return [name for name in states if StateCovariance((name,)).name((name, name)) in states]


def follow_rates(model: Model) -> Tangent:
    """Differentiate the rates of a differential model by its present states."""
    pairs = _list_equations(model)
    return Tangent(
        {
            (name, other): slope
            for name, equation in pairs
            for other, _ in pairs
            if (slope := differentiate(equation, PastValue(other, "state"))) != ZERO
        }
    )


def follow_recursion(model: Model) -> Tangent:
    """Differentiate the samples of a recursion by the states one sample before, in their order."""
    pairs, found = _list_equations(model), Tangent()
    for name, equation in (pairs[i] for i in model.order):
        found.noises[name, name] = ONE
        for other, _ in pairs:
            before = differentiate(equation, PastValue(other, "state", 1))
            _add_slope(found.states, (name, other), before)
            present = differentiate(equation, PastValue(other, "state"))
            if present != ZERO:
                for slopes in (found.states, found.noises):
                    for (row, column), slope in [*slopes.items()]:
                        if row == other:
                            _add_slope(slopes, (name, column), multiply(present, slope))
    return found


def _list_equations(model: Model) -> list[tuple[str, Expression]]:
    names = [state.name for state in model.states]
    return list(zip(names, model.equations, strict=True))


def _add_slope(slopes: Slopes, pair: Pair, slope: Expression) -> None:
    if slope != ZERO:
        slopes[pair] = add(slopes.get(pair, ZERO), slope)


def make_rate(
    pair: Pair, tangent: Tangent, covariance: StateCovariance, diffusion: Mapping[str, Expression]
) -> Expression:
    """Make the rate of a covariance: an entry of A P + P Aᵀ + Q."""
    first, second = pair
    sides: list[Expression] = []
    for one, other in ((first, second), (second, first)):
        total: Expression = ZERO
        for name in covariance.noisy:
            slope = tangent.states.get((one, name), ZERO)
            total = add(total, multiply(slope, covariance.read((name, other))))
        sides.append(total)
    if first == second:
        return add(multiply(Number(2.0), sides[0]), diffusion.get(first, ZERO))
    return add(*sides)


def make_step(
    pair: Pair, tangent: Tangent, covariance: StateCovariance, noise: Mapping[str, Expression]
) -> Expression:
    """Make the next value of a covariance: an entry of A P Aᵀ + G Q Gᵀ, P one sample before."""
    first, second = pair
    total: Expression = ZERO
    for column in covariance.noisy:
        slope = tangent.states.get((second, column), ZERO)
        if slope == ZERO:
            continue
        own: Expression = ZERO
        for row in covariance.noisy:
            before = replace(covariance.read((row, column)), offset=1)
            own = add(own, multiply(tangent.states.get((first, row), ZERO), before))
        total = add(total, multiply(own, slope))
    for source, variance in noise.items():
        slopes = [tangent.noises.get((name, source), ZERO) for name in pair]
        total = add(total, multiply(multiply(slopes[0], variance), slopes[1]))
    return total
