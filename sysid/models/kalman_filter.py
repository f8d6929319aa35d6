"""Kalman filter of a model whose noise acts inside the plant: more states, corrected by samples.

The noise of a plant is a slow load at an input, or diffusion of its states. The filter adds its
loads and its covariance P to the states of the model, so that one integrator serves all of them::

    d' = -d/τ + √(2/τ) λ·w              a load, an Ornstein-Uhlenbeck process of deviation λ
    P' = A P + P Aᵀ + Q,  A = ∂f/∂x     between samples
    x ← x + P c (y - ŷ)/S,  P ← P - P c cᵀ P/S,  S = 1 + cᵀ P c,  c = ∂h/∂x     at a sample

(Jazwinski 1970, Theorem 8.1; Kristensen, Madsen and Jørgensen, Automatica 40 (2004) 225.) All
deviations are relative to that of the sensor, so its variance is 1 here and has a closed form in
the likelihood. A linear model with lags of inputs has its exact filter. Others have the extended
one, in which delayed states count as known.

A load enters where its input does, but without the input's delay: before or after a dead time is
the same for a stationary process. The innovations y - ŷ are the residuals, and their sum of squares
is minimised: the filter-error method (Maine and Iliff 1981) in innovations form.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import sqrt
from typing import Literal, NamedTuple

from sysid.core.errors import InvalidSettings
from sysid.core.settings import FILTERED, NoiseModel, PlantNoise
from sysid.core.units import divide_units, is_blank_unit
from sysid.language.delays import collect_past_values
from sysid.language.derivative import (
    ZERO,
    NoDerivativeError,
    add,
    differentiate,
    multiply,
)
from sysid.language.tree import (
    Binary,
    Expression,
    FunctionCall,
    Number,
    PastValue,
    Symbol,
    Unary,
    match_plain_state,
)
from sysid.models.model import (
    Correction,
    DerivedInitial,
    FixedInitial,
    Model,
    ModelSignal,
    Output,
)
from sysid.models.parameters import Parameter
from sysid.models.rest import NoRestError, solve_rest
from sysid.models.sections import STEADY, get_interval

_Pair = tuple[str, str]
_Slopes = Mapping[_Pair, Expression]
_Covariance = Mapping[frozenset[str], PastValue]

_PARAMETERS = ("load", "tau", "noise")
_SMALLEST, _LARGEST = 1e-3, 1e3  # deviation of a load at its input over the sensor's, by spans
_LONGEST = 10.0  # of the record: correlation time of a load
_SPAN = 4.0  # of an output in its deviations
_LEAST_SHARE, _MOST_SHARE = 1e-2, 1e4  # of the sensor's deviation: diffusion over the record


def is_noise_parameter(name: str) -> bool:
    """Whether a parameter is one that a filter adds: it says nothing of a free run."""
    return name.partition("[")[0] in _PARAMETERS and name.endswith("]")


class NoisePlace(NamedTuple):
    """Where noise acts inside the plant: as a load there, or as diffusion of a state."""

    place: str
    kind: Literal["load", "plant"]


@dataclass(frozen=True, slots=True)
class NoiseScales:
    """Sizes in the data that bound the noise.

    Attributes
    ----------
    spans : mapping of str to float
        Span of each input and output.
    period, duration : float
        Sampling period and duration (s).
    """

    spans: Mapping[str, float]
    period: float
    duration: float


class FilterReadings(NamedTuple):
    """What a smoother reads of a filter at each time, as outputs of the model.

    Attributes
    ----------
    states : tuple of str
        The n states that noise reaches.
    places : tuple of (str, NoisePlace)
        The noise among them: its state, and where it acts.
    outputs : tuple of Output
        n states; n² covariances, by rows; n² slopes ∂f/∂x, by rows; then for each output of the
        model its n slopes ∂h/∂x.
    """

    states: tuple[str, ...]
    places: tuple[tuple[str, NoisePlace], ...]
    outputs: tuple[Output, ...]


def list_filter_readings(model: Model) -> FilterReadings:
    """List what a smoother reads of a model with a filter."""
    equations = {one.name: tree for one, tree in zip(model.states, model.equations, strict=True)}
    noisy = [name for name in equations if _name_covariance((name, name)) in equations]
    places = [
        (name, NoisePlace(name[2:-1] if _is_load(name) else name, kind))
        for name in noisy
        for kind in [_find_kind(name, model)]
        if kind is not None
    ]
    trees: list[Expression] = [PastValue(name, "state") for name in noisy]
    for a, b in product(noisy, noisy):
        first, second = (a, b) if noisy.index(a) <= noisy.index(b) else (b, a)
        trees.append(PastValue(_name_covariance((first, second)), "state"))
    trees += [differentiate(equations[a], b) for a, b in product(noisy, noisy)]
    trees += [differentiate(one.expression, a) for one, a in product(model.outputs, noisy)]
    outputs = tuple(Output(f"filter {i}", tree) for i, tree in enumerate(trees))
    return FilterReadings(tuple(noisy), tuple(places), outputs)


def _find_kind(state: str, model: Model) -> Literal["load", "plant"] | None:
    """Find the kind of noise that drives a state; None if it only follows others."""
    if _is_load(state):
        return "load"
    names = {parameter.name for parameter in model.parameters}
    return "plant" if f"noise[{state}]" in names else None


def check_noise_changes(names: Iterable[str], requested: NoiseModel) -> None:
    """Check that parameters of a filter are changed only where one is asked for.

    Raises
    ------
    InvalidSettings
        If there is no filter yet: ``auto`` chooses one after the search, with sizes of its own.
    """
    for name in names:
        if is_noise_parameter(name) and requested not in FILTERED:
            kind = "plant" if name.startswith("noise[") else "load"
            raise InvalidSettings(
                f"/parameters/{name}",
                f"{name} is a parameter of noise inside the plant. Set loss: "
                f"{{noise_model: {kind}}} to change it",
            )


def list_plant_noise(model: Model) -> tuple[PlantNoise, ...]:
    """List the noise that ``auto`` may choose: where the document names its places, and drift.

    A load is nearly the drift of a sensor where the plant is fast, so one is not taken for the
    other only if both are compared.
    """
    named: dict[PlantNoise, tuple[str, ...]] = {
        "load": model.noise.load,
        "plant": model.noise.plant,
    }
    found = tuple(noise for noise, names in named.items() if names)
    return (*found, "drift") if found else ()


def add_kalman_filter(model: Model, noise: PlantNoise, scales: NoiseScales) -> Model:
    """Add a Kalman filter to a model, with the parameters of its noise.

    ``load`` adds loads: where the document names them, else at the first of those inputs that enter
    the same equations, whose loads nothing can tell apart. The parameters are ``load[u]``, its
    deviation over the sensor's, and ``tau[u]``, its correlation time (s). ``drift`` adds them at
    the outputs, as the drift of their sensors. ``plant`` lets states
    diffuse, with the parameter ``noise[x]``, per √s and over the sensor's deviation. These are
    the states that the document names, and its loads are added. Without them, they are all states
    that are not just the integral of another one.

    Raises
    ------
    InvalidSettings
        If the model has no place for such noise, or no filter.
    """
    if model.form != "differential":
        raise _refuse(noise, f"model {model.name!r} is not of the differential form")
    diffusion: dict[str, Expression] = {}
    if noise == "plant":
        model, diffusion = _add_diffusion(model, scales)
    if noise != "plant" or model.noise.load:
        signals = model.outputs if noise == "drift" else _list_loaded(model)
        model, loads = _add_loads(model, signals, scales)
        diffusion |= loads
    if not diffusion:
        raise _refuse(noise, "no input enters an equation, so there is no place for a load")
    try:
        return _add_covariance(model, diffusion)
    except NoDerivativeError as error:
        raise _refuse(noise, f"the filter cannot follow the function {error}") from None


def _refuse(noise: PlantNoise, reason: str) -> InvalidSettings:
    return InvalidSettings("/loss/noise_model", f"{noise} has no meaning here: {reason}")


def _add_loads(
    model: Model, signals: Sequence[ModelSignal | Output], scales: NoiseScales
) -> tuple[Model, dict[str, Expression]]:
    """Add a state for each load; return the squared diffusion of the states that have one."""
    diffusion: dict[str, Expression] = {}
    for signal in signals:
        load, deviation, time = f"d[{signal.name}]", f"load[{signal.name}]", f"tau[{signal.name}]"
        size, constant = Symbol(deviation, "parameter"), Symbol(time, "parameter")
        state = PastValue(load, "state")
        equations = tuple(_add_to_input(tree, signal.name, state) for tree in model.equations)
        outputs = tuple(
            replace(one, expression=Binary("+", one.expression, state))
            if one.name == signal.name
            else replace(one, expression=_add_to_input(one.expression, signal.name, state))
            for one in model.outputs
        )
        decay = Unary("-", Binary("/", state, constant))
        ratio = _divide_spans(scales, signal.name, model)
        shortest = min(scales.period, 0.1 * scales.duration)
        model = replace(
            model,
            states=(*model.states, ModelSignal(load, signal.unit)),
            equations=(*equations, decay),
            outputs=outputs,
            initial=(*model.initial, FixedInitial(0.0)),
            order=(*model.order, len(model.order)),
            parameters=(
                *model.parameters,
                Parameter(
                    deviation,
                    _SMALLEST * ratio,
                    _LARGEST * ratio,
                    _divide_by_sensor(signal.unit, model),
                    "log",
                ),
                Parameter(time, shortest, _LONGEST * scales.duration, "s", "log"),
            ),
        )
        power = Binary("*", Number(2.0), Binary("*", size, size))
        diffusion[load] = Binary("/", power, constant)
    return model, diffusion


def _list_loaded(model: Model) -> list[ModelSignal | Output]:
    """List the signals that the document names, or one input of those in the same equations."""
    if model.noise.load:
        signals: tuple[ModelSignal | Output, ...] = (*model.inputs, *model.outputs)
        return [one for one in signals if one.name in model.noise.load]
    found: dict[tuple[int, ...], ModelSignal | Output] = {}
    for signal in model.inputs:
        places = tuple(
            i
            for i, tree in enumerate(model.equations)
            if any(past.name == signal.name for past in collect_past_values(tree))
        )
        if places:
            found.setdefault(places, signal)
    return list(found.values())


def _divide_spans(scales: NoiseScales, name: str, model: Model) -> float:
    """Divide a signal's span by that of the output; several outputs count by their deviations."""
    spans = [scales.spans.get(key, 0.0) for key in (name, model.outputs[0].name)]
    if len(model.outputs) > 1:
        spans[1] = _SPAN
    return spans[0] / spans[1] if min(spans) > 0 else 1.0


def _divide_by_sensor(unit: str, model: Model) -> str:
    """Divide a unit by that of weighted residuals."""
    if len(model.outputs) > 1:
        return unit
    other = model.outputs[0].unit
    return "1" if is_blank_unit(unit) or is_blank_unit(other) else divide_units(unit, other)


def _add_to_input(tree: Expression, name: str, load: Expression) -> Expression:
    """Add a load wherever an input is read; not in delays, which contain no states."""
    match tree:
        case PastValue():
            return Binary("+", tree, load) if (tree.name, tree.kind) == (name, "input") else tree
        case Unary(operator, operand):
            return Unary(operator, _add_to_input(operand, name, load))
        case Binary(operator, left, right):
            return Binary(
                operator, _add_to_input(left, name, load), _add_to_input(right, name, load)
            )
        case FunctionCall(function, arguments):
            return FunctionCall(
                function, tuple(_add_to_input(argument, name, load) for argument in arguments)
            )
        case _:
            return tree


def _add_diffusion(model: Model, scales: NoiseScales) -> tuple[Model, dict[str, Expression]]:
    root = sqrt(scales.duration)
    diffusion: dict[str, Expression] = {}
    parameters = list(model.parameters)
    for state, equation in zip(model.states, model.equations, strict=True):
        is_position = match_plain_state(equation) is not None  # its rate alone is disturbed
        if state.name not in model.noise.plant if model.noise.plant else is_position:
            continue
        name = f"noise[{state.name}]"
        unit = _divide_by_sensor(state.unit, model)
        lower, upper = _LEAST_SHARE / root, _MOST_SHARE / root
        parameters.append(Parameter(name, lower, upper, f"{unit}/√s", "log"))
        size = Symbol(name, "parameter")
        diffusion[state.name] = Binary("*", size, size)
    return replace(model, parameters=tuple(parameters)), diffusion


def _add_covariance(model: Model, diffusion: Mapping[str, Expression]) -> Model:
    """Add the covariance of all states that noise reaches, and the corrections by samples."""
    names = [state.name for state in model.states]
    slopes = {
        (name, other): slope
        for name, equation in zip(names, model.equations, strict=True)
        for other in names
        if (slope := differentiate(equation, other)) != ZERO
    }
    noisy = _find_noisy(names, slopes, diffusion)
    pairs = [(a, b) for i, a in enumerate(noisy) for b in noisy[i:]]
    covariance = {frozenset(pair): PastValue(_name_covariance(pair), "state") for pair in pairs}
    changes = [_make_rate(pair, noisy, slopes, covariance, diffusion) for pair in pairs]
    resting = _list_resting(model)
    rates = {p: rate for p, rate in zip(pairs, changes, strict=True) if resting.issuperset(p)}
    state_of = {pair: covariance[frozenset(pair)].name for pair in pairs}
    solved = _solve_stationary(rates, state_of, model)
    starts = [_make_start(pair, solved.get(state_of[pair])) for pair in pairs]
    return replace(
        model,
        states=(*model.states, *(ModelSignal(covariance[frozenset(p)].name) for p in pairs)),
        equations=(*model.equations, *changes),
        initial=(*model.initial, *starts),
        order=(*model.order, *range(len(names), len(names) + len(pairs))),
        corrections=tuple(_make_corrections(model, noisy, pairs, covariance)),
    )


def _find_noisy(
    names: Sequence[str], slopes: _Slopes, diffusion: Mapping[str, Expression]
) -> list[str]:
    """Find the states that noise reaches, in the model's order."""
    noisy = set(diffusion)
    while reached := {a for a, b in slopes if b in noisy} - noisy:
        noisy |= reached
    return [name for name in names if name in noisy]


def _make_rate(
    pair: tuple[str, str],
    noisy: Sequence[str],
    slopes: _Slopes,
    covariance: _Covariance,
    diffusion: Mapping[str, Expression],
) -> Expression:
    """Make the rate of a covariance: an entry of A P + P Aᵀ + Q."""
    first, second = pair
    sides: list[Expression] = []
    for one, other in ((first, second), (second, first)):
        total: Expression = ZERO
        for name in noisy:
            slope = slopes.get((one, name), ZERO)
            total = add(total, multiply(slope, covariance[frozenset((name, other))]))
        sides.append(total)
    if first == second:
        return add(multiply(Number(2.0), sides[0]), diffusion.get(first, ZERO))
    return add(*sides)


def _list_resting(model: Model) -> set[str]:
    """List the loads, and the states that begin at rest: noise moved them before the record."""
    return {
        state.name
        for state, start in zip(model.states, model.initial, strict=True)
        if _is_load(state.name) or (isinstance(start, DerivedInitial) and start.text == STEADY)
    }


def _solve_stationary(
    pairs: Mapping[_Pair, Expression], names: Mapping[_Pair, str], model: Model
) -> dict[str, Expression]:
    """Solve A P + P Aᵀ + Q = 0 for some covariances by their rates; the others are 0.

    If they have no rest, as behind an integrator, or if it depends on an estimated start, loads
    alone are stationary.
    """
    known: dict[str, Expression] = {names[pair]: ZERO for pair in names if pair not in pairs}
    for state, start in zip(model.states, model.initial, strict=True):
        if isinstance(start, FixedInitial):
            known[state.name] = Number(start.value)
        elif isinstance(start, DerivedInitial):
            known[state.name] = start.expression
    intervals = {parameter.name: get_interval(parameter) for parameter in model.parameters}
    rates = {names[pair]: rate for pair, rate in pairs.items()}
    try:
        return solve_rest(rates, known, intervals, is_rate=True)
    except NoRestError:
        loads = {pair: rate for pair, rate in pairs.items() if all(map(_is_load, pair))}
        return _solve_stationary(loads, names, model) if len(loads) < len(pairs) else {}


def _make_start(pair: _Pair, solved: Expression | None) -> FixedInitial | DerivedInitial:
    """Make the start of a covariance; a variance is not negative, even of an unstable plant."""
    if solved is None:
        return FixedInitial(0.0)
    if pair[0] == pair[1]:
        solved = FunctionCall("max", (solved, ZERO))
    return DerivedInitial(solved, "stationary")


def _name_covariance(pair: _Pair) -> str:
    return f"P[{','.join(pair)}]"


def _is_load(state: str) -> bool:
    return state.startswith("d[")


def _make_corrections(
    model: Model,
    noisy: Sequence[str],
    pairs: Sequence[tuple[str, str]],
    covariance: _Covariance,
) -> Iterator[Correction]:
    for output in model.outputs:
        seen = {name: differentiate(output.expression, name) for name in noisy}
        shared: dict[str, Expression] = {}
        variance: Expression = ZERO
        for name in noisy:
            total: Expression = ZERO
            for other in noisy:
                total = add(total, multiply(covariance[frozenset((name, other))], seen[other]))
            shared[name] = total
            variance = add(variance, multiply(seen[name], total))
        losses = (
            (covariance[frozenset((a, b))].name, multiply(shared[a], shared[b])) for a, b in pairs
        )
        yield Correction(output.name, variance, tuple(shared.items()), tuple(losses))
