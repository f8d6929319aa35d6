"""Kalman filter of a model whose noise acts inside the plant: more states, corrected by samples.

The noise of a plant is a slow load at an input, or diffusion of its states. The filter adds its
loads and its covariance P to the states of the model, so that one integrator serves all of them::

    d' = -d/τ + √(2/τ) λ·w              a load, an Ornstein-Uhlenbeck process of deviation λ
    P' = A P + P Aᵀ + Q,  A = ∂f/∂x     between samples
    x ← x + P c (y - ŷ)/S,  P ← P - P c cᵀ P/S,  S = 1 + cᵀ P c,  c = ∂h/∂x     at a sample

(Jazwinski 1970, Theorem 8.1; Kristensen, Madsen and Jørgensen, Automatica 40 (2004) 225.) In a
recursion noise is added to each sample of a state, as φ(k) of Eq. 16. Its fixed lags become states
(`sysid.models.lagged_states`), and P moves from sample to sample::

    d(k) = ρ d(k-1) + √(1 - ρ²) λ·w,  ρ = exp(-h/τ);    P ← A P Aᵀ + G Q Gᵀ

All deviations are relative to that of the sensor, so its variance is 1 here and has a closed form
in the likelihood. A linear model whose states have no delays, or short ones in a recursion, has its
exact filter. Others have the extended one, in which delayed states count as known.

A load enters where its input does, but without the input's delay: before or after a dead time is
the same for a stationary process. The innovations y - ŷ are the residuals, and their sum of squares
is minimised: the filter-error method (Maine and Iliff 1981) in innovations form.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import inf, sqrt
from typing import Any, Literal, NamedTuple

from sysid.core.errors import InvalidSettings
from sysid.core.settings import FILTERED, NoiseModel, PlantNoise
from sysid.core.units import divide_units, is_blank_unit
from sysid.language.delays import collect_past_values
from sysid.language.derivative import (
    ONE,
    ZERO,
    NoDerivativeError,
    add,
    differentiate,
    multiply,
)
from sysid.language.transform import substitute
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
from sysid.models.covariance import (
    Pair,
    Slopes,
    StateCovariance,
    Tangent,
    follow_rates,
    follow_recursion,
    is_covariance,
    list_noisy,
    make_rate,
    make_step,
)
from sysid.models.lagged_states import add_lagged_states, hold_first_samples
from sysid.models.model import (
    Correction,
    DerivedInitial,
    FixedInitial,
    MeasuredInitial,
    Model,
    ModelSignal,
    Output,
)
from sysid.models.parameters import Parameter, override_parameters
from sysid.models.rest import NoRestError, solve_rest
from sysid.models.sections import STEADY, get_interval

ParameterChanges = Mapping[str, Mapping[str, Any]]
"""Changes of parameters by name, such as ``{"L": {"upper": 2.0}}``."""

_PARAMETERS = ("load", "tau", "noise")
_SMALLEST, _LARGEST = 1e-3, 1e3  # deviation of a load at its input over the sensor's, by spans
_ANY_LOWER, _ANY_UPPER = 1e-100, 1e100  # of a size, before the data are known
_LONGEST = 10.0  # of the record: correlation time of a load
_SPAN = 4.0  # of an output in its deviations
_LEAST_SHARE, _MOST_SHARE = 1e-2, 1e4  # of the sensor's deviation: diffusion over the record
_GROWTH = 1.5  # power of the samples with which noise of each grows when it is summed twice
_UNKNOWN = 1e6  # variance of a measured start over the sensor's: rounding grows with its square


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
    least_distance : float
        Least distance (s) of two samples of an output.
    """

    spans: Mapping[str, float]
    period: float
    duration: float
    least_distance: float


class FilterReadings(NamedTuple):
    """What a smoother reads of a filter at each time, as outputs of the model.

    Attributes
    ----------
    states : tuple of str
        The n states that noise reaches.
    places : tuple of (str, NoisePlace)
        The noise among them: its state, and where it acts.
    outputs : tuple of Output
        n states; n² covariances, by rows; n² slopes ∂f/∂x, by rows, in a recursion those of the
        step that ends there; then for each output of the model its n slopes ∂h/∂x.
    """

    states: tuple[str, ...]
    places: tuple[tuple[str, NoisePlace], ...]
    outputs: tuple[Output, ...]


def list_filter_readings(model: Model) -> FilterReadings:
    """List what a smoother reads of a model with a filter."""
    noisy = list_noisy(_name_states(model))
    covariance = StateCovariance(noisy)
    places = [
        (name, NoisePlace(name[2:-1] if _is_load(name) else name, kind))
        for name in noisy
        for kind in [_find_kind(name, model)]
        if kind is not None
    ]
    slopes = _follow_filter(model, noisy)
    trees: list[Expression] = [PastValue(name, "state") for name in noisy]
    trees += [covariance.read(pair) for pair in product(noisy, noisy)]
    trees += [slopes.get(pair, ZERO) for pair in product(noisy, noisy)]
    trees += [
        differentiate(one.expression, PastValue(name, "state"))
        for one, name in product(model.outputs, noisy)
    ]
    outputs = tuple(Output(f"filter {i}", tree) for i, tree in enumerate(trees))
    return FilterReadings(tuple(noisy), tuple(places), outputs)


def _follow_filter(model: Model, noisy: Sequence[str]) -> Slopes:
    """Differentiate the equations of a filter's states, those of its covariance left out.

    In the first samples of a recursion, measured states do not follow those before.
    """
    rows = [i for i, name in enumerate(_name_states(model)) if not is_covariance(name)]
    plain = replace(
        model,
        states=tuple(model.states[i] for i in rows),
        equations=tuple(model.equations[i] for i in rows),
        order=tuple(i for i in model.order if i in rows),
    )
    if not _is_recursion(model):
        return follow_rates(plain).states
    measured = {
        state
        for state, start in zip(_name_states(model), model.initial, strict=True)
        if isinstance(start, MeasuredInitial)
    }
    return {
        pair: hold_first_samples(model, ZERO, slope) if pair[0] in measured else slope
        for pair, slope in follow_recursion(plain).states.items()
    }


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


def list_noise_parameters(model: Model, noise: NoiseModel) -> tuple[Parameter, ...]:
    """List the parameters that a filter would add, with bounds that hold for any data.

    Raises
    ------
    InvalidSettings
        If the model has no place for such noise, or no filter.
    """
    if noise not in FILTERED:
        return ()
    filtered = add_kalman_filter(model, noise, NoiseScales({}, 1.0, 1.0, 1.0), {})
    added = filter(lambda one: is_noise_parameter(one.name), filtered.parameters)
    return tuple(replace(one, lower=_ANY_LOWER, upper=_ANY_UPPER) for one in added)


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


def add_kalman_filter(
    model: Model, noise: PlantNoise, scales: NoiseScales, changes: ParameterChanges
) -> Model:
    """Add a Kalman filter to a model, with the parameters of its noise.

    `changes` of the model's own parameters say how far lags of states reach.

    ``load`` adds loads: where the document names them, else at the first of those inputs that enter
    the same equations, whose loads nothing can tell apart. The parameters are ``load[u]``, its
    deviation over the sensor's, and ``tau[u]``, its correlation time (s). ``drift`` adds them at
    the outputs, as the drift of their sensors. ``plant`` lets states diffuse, with the parameter
    ``noise[x]``, over the sensor's deviation: per √s, in a recursion per sample. These are the
    states that the document names, and its loads are added. Without them, they are all states that
    are not just the integral of another one, or its last sample.

    Raises
    ------
    InvalidSettings
        If the model has no place for such noise, or no filter.
    """
    given, diffusion = model, dict[str, Expression]()
    if noise == "plant":
        model, diffusion = _add_diffusion(model, scales)
    if noise != "plant" or model.noise.load:
        signals = model.outputs if noise == "drift" else _list_loaded(model)
        model, loads = _add_loads(model, signals, scales)
        diffusion |= loads
    if not diffusion:
        raise _refuse(noise, "no input enters an equation, so there is no place for a load")
    try:
        if _is_recursion(model):
            intervals = _bound_parameters(given, changes)
            return _add_recursive_covariance(given, model, diffusion, scales, intervals)
        tangent = follow_rates(model)
        covariance = StateCovariance(tangent.find_noisy(_name_states(model), diffusion))
        rates = {pair: make_rate(pair, tangent, covariance, diffusion) for pair in covariance.pairs}
        return _add_covariance(model, covariance, rates, rates, {})
    except NoDerivativeError as error:
        raise _refuse(noise, f"the filter cannot follow the function {error}") from None


def match_measured_state(output: Output) -> str | None:
    """Return the state that an output measures by itself, with drift or without; None of others."""
    match output.expression:
        case Binary("+", left, PastValue(name)) if _is_load(name):
            return match_plain_state(left)
        case tree:
            return match_plain_state(tree)


def _is_recursion(model: Model) -> bool:
    return model.form != "differential"


def _bound_parameters(model: Model, changes: ParameterChanges) -> dict[str, tuple[float, float]]:
    """Bound the changed parameters; one that is tied may have any value."""
    own = {one.name: changes[one.name] for one in model.parameters if one.name in changes}
    return {
        one.name: get_interval(one) if one.tied is None else (-inf, inf)
        for one in override_parameters(model.parameters, own)
    }


def _name_states(model: Model) -> list[str]:
    return [state.name for state in model.states]


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
        before = replace(state, offset=1) if _is_recursion(model) else state
        equations = tuple(_add_to_input(tree, signal.name, before) for tree in model.equations)
        outputs = tuple(
            replace(one, expression=Binary("+", one.expression, state))
            if one.name == signal.name
            else replace(one, expression=_add_to_input(one.expression, signal.name, state))
            for one in model.outputs
        )
        ratio = _divide_spans(scales, signal.name, model)
        shortest = min(scales.period, 0.1 * scales.duration)
        model = replace(
            model,
            states=(*model.states, ModelSignal(load, signal.unit)),
            equations=(*equations, _decay(before, constant, model)),
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
        diffusion[load] = _excite(size, constant, model)
    return model, diffusion


def _decay(load: Expression, time: Expression, model: Model) -> Expression:
    """Make the rate of a load, or its next sample."""
    if not _is_recursion(model):
        return Unary("-", Binary("/", load, time))
    return Binary("*", _keep(1.0, time), load)


def _excite(size: Expression, time: Expression, model: Model) -> Expression:
    """Make the squared diffusion of a load, or the variance that a sample adds."""
    square = Binary("*", size, size)
    if not _is_recursion(model):
        return Binary("/", Binary("*", Number(2.0), square), time)
    return Binary("*", square, Binary("-", ONE, _keep(2.0, time)))


def _keep(steps: float, time: Expression) -> Expression:
    """Make the share of a load that is left after some samples."""
    share = Binary("/", Binary("*", Number(-steps), Symbol("h", "period")), time)
    return FunctionCall("exp", (share,))


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
    is_recursion = _is_recursion(model)
    root = sqrt(scales.duration)
    lower, upper, per = _LEAST_SHARE / root, _MOST_SHARE / root, "/√s"
    if is_recursion:
        steps = model.solver.substeps * max(scales.duration / scales.period, 1.0)
        lower, upper, per = _LEAST_SHARE / steps**_GROWTH, _MOST_SHARE, ""
    diffusion: dict[str, Expression] = {}
    parameters = list(model.parameters)
    for state, equation in zip(model.states, model.equations, strict=True):
        is_copy = isinstance(equation, PastValue) and equation.kind == "state"
        if state.name not in model.noise.plant if model.noise.plant else is_copy:
            continue
        name = f"noise[{state.name}]"
        unit = _divide_by_sensor(state.unit, model)
        parameters.append(Parameter(name, lower, upper, f"{unit}{per}", "log"))
        size = Symbol(name, "parameter")
        diffusion[state.name] = Binary("*", size, size)
    return replace(model, parameters=tuple(parameters)), diffusion


def _add_recursive_covariance(
    given: Model,
    model: Model,
    diffusion: Mapping[str, Expression],
    scales: NoiseScales,
    intervals: Mapping[str, tuple[float, float]],
) -> Model:
    """Add the covariance of a recursion, whose first samples are the start of the given model.

    There its states keep their values. Of a state that starts at measured values each of them is
    unknown, until the sample corrects it.
    """
    step = scales.least_distance / model.solver.substeps
    model = add_lagged_states(model, intervals, step)
    unknown = {
        state: _measure_unknown(state, model, scales)
        for state, start in zip(_name_states(given), given.initial, strict=True)
        if isinstance(start, MeasuredInitial)
    }
    tangent = follow_recursion(model)
    covariance = StateCovariance(tangent.find_noisy(_name_states(model), {**diffusion, **unknown}))
    own = set(_name_states(given))
    kept = {(name, name): ONE for name in own if name not in unknown}
    held = Tangent(
        {pair: slope for pair, slope in tangent.states.items() if pair[0] not in own} | kept,
        {pair: slope for pair, slope in tangent.noises.items() if pair[0] == pair[1]},
    )
    first = {name: one for name, one in diffusion.items() if name not in own} | unknown
    steps = {pair: make_step(pair, tangent, covariance, diffusion) for pair in covariance.pairs}
    changes = {
        pair: hold_first_samples(model, make_step(pair, held, covariance, first), step)
        for pair, step in steps.items()
    }
    equations = (
        hold_first_samples(model, PastValue(name, "state", 1), tree) if name in own else tree
        for name, tree in zip(_name_states(model), model.equations, strict=True)
    )
    model = replace(model, equations=tuple(equations))
    return _add_covariance(model, covariance, changes, steps, unknown)


def _measure_unknown(state: str, model: Model, scales: NoiseScales) -> Expression:
    """Measure a variance that is large beside the sensor's, of which a single one is 1."""
    output = next(one for one in model.outputs if match_measured_state(one) == state)
    deviation = scales.spans.get(output.name, 0.0) / _SPAN if len(model.outputs) > 1 else 1.0
    return Number(_UNKNOWN * deviation**2)


def _add_covariance(
    model: Model,
    covariance: StateCovariance,
    changes: Mapping[Pair, Expression],
    steady: Mapping[Pair, Expression],
    unknown: Mapping[str, Expression],
) -> Model:
    """Add the covariance of all states that noise reaches, and the corrections by samples.

    `steady` are its changes at rest, `unknown` the variances of states that start unknown.
    """
    resting = _list_resting(model)
    rates = {pair: steady[pair] for pair in steady if resting.issuperset(pair)}
    state_of = {pair: covariance.name(pair) for pair in changes}
    solved = _solve_stationary(rates, state_of, model)
    solved |= {covariance.name((name, name)): one for name, one in unknown.items()}
    starts = [_make_start(pair, solved.get(state_of[pair])) for pair in changes]
    names = len(model.states)
    return replace(
        model,
        states=(*model.states, *map(ModelSignal, state_of.values())),
        equations=(*model.equations, *changes.values()),
        initial=(*model.initial, *starts),
        order=(*model.order, *range(names, names + len(changes))),
        corrections=tuple(_make_corrections(model, covariance)),
    )


def _list_resting(model: Model) -> set[str]:
    """List the loads, and the states that begin at rest: noise moved them before the record."""
    return {
        state.name
        for state, start in zip(model.states, model.initial, strict=True)
        if _is_load(state.name) or (isinstance(start, DerivedInitial) and start.text == STEADY)
    }


def _solve_stationary(
    pairs: Mapping[Pair, Expression], names: Mapping[Pair, str], model: Model
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
            known[state.name] = substitute(start.expression, _find_start(known))
    intervals = {parameter.name: get_interval(parameter) for parameter in model.parameters}
    rates = {names[pair]: rate for pair, rate in pairs.items()}
    try:
        return solve_rest(rates, known, intervals, is_rate=not _is_recursion(model))
    except NoRestError:
        loads = {pair: rate for pair, rate in pairs.items() if all(map(_is_load, pair))}
        return _solve_stationary(loads, names, model) if len(loads) < len(pairs) else {}


def _find_start(known: Mapping[str, Expression]) -> Callable[[Expression], Expression | None]:
    return lambda node: known.get(node.name) if isinstance(node, PastValue) else None


def _make_start(pair: Pair, solved: Expression | None) -> FixedInitial | DerivedInitial:
    """Make the start of a covariance; a variance is not negative, even of an unstable plant."""
    if solved is None:
        return FixedInitial(0.0)
    if pair[0] == pair[1]:
        solved = FunctionCall("max", (solved, ZERO))
    return DerivedInitial(solved, "stationary")


def _is_load(state: str) -> bool:
    return state.startswith("d[")


def _make_corrections(model: Model, covariance: StateCovariance) -> Iterator[Correction]:
    for output in model.outputs:
        seen = {
            name: differentiate(output.expression, PastValue(name, "state"))
            for name in covariance.noisy
        }
        shared: dict[str, Expression] = {}
        variance: Expression = ZERO
        for name in covariance.noisy:
            total: Expression = ZERO
            for other in covariance.noisy:
                total = add(total, multiply(covariance.read((name, other)), seen[other]))
            shared[name] = total
            variance = add(variance, multiply(seen[name], total))
        losses = (
            (covariance.name((a, b)), multiply(shared[a], shared[b])) for a, b in covariance.pairs
        )
        yield Correction(output.name, variance, tuple(shared.items()), tuple(losses))
