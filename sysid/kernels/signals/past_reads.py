"""Reads of a model: its past values and their positions on the time axis.

Positions are counted in half integration steps from the last finished step. The stages of a
Runge-Kutta step are at 0, 1 and 2. The sample that a difference equation computes is at 2.
"""

from typing import NamedTuple

from sysid.core.memo import cache_by_identity
from sysid.language.delays import collect_past_values, has_varying_delay, mentions_time
from sysid.language.time_switches import list_sides
from sysid.language.tree import Expression, PastValue
from sysid.models.model import Model

MAX_REGISTER_OFFSET = 8
"""Largest fixed offset (samples) that is held in registers; others are in the history."""

_MAX_GAP = 4  # half steps: two values at most this far apart share one read


class SignalRead(NamedTuple):
    """A past value and its position without its delay."""

    past: PastValue
    half_steps: int


def is_difference(model: Model) -> bool:
    """Whether the model is a recursion over samples (a polynomial is one too)."""
    return model.form != "differential"


def list_stages(model: Model) -> tuple[int, ...]:
    """List the positions at which the equations are evaluated in one step."""
    if is_difference(model):
        return (2,)
    return (0, 1, 2) if model.solver.method == "rk4" else (0,)


@cache_by_identity
def list_switch_sides(model: Model) -> tuple[Expression, ...]:
    """List the sides of the switches in time at which an integration step is divided."""
    return () if is_difference(model) else list_sides(model.equations)


def find_state_position(model: Model, stage: int, equation: int, state: int) -> int:
    """Find the position of a state's undelayed value, in an equation at a stage.

    The semi-implicit method reads updated states at the end of the step.
    """
    semi_implicit = not is_difference(model) and model.solver.method == "semi-implicit"
    return 2 if semi_implicit and state < equation else stage


@cache_by_identity  # called by every run
def collect_reads(model: Model) -> tuple[SignalRead, ...]:
    """Collect every past value that the equations and the outputs read."""
    numbers = {state.name: i for i, state in enumerate(model.states)}
    signal_reads: list[SignalRead] = []
    for i, equation in enumerate(model.equations):
        for stage in list_stages(model):
            for past in collect_past_values(equation):
                state = past.kind == "state"
                position = (
                    find_state_position(model, stage, i, numbers[past.name]) if state else stage
                )
                signal_reads.append(SignalRead(past, position - 2 * past.offset))
    for output in model.outputs:
        signal_reads += [
            SignalRead(past, -2 * past.offset) for past in collect_past_values(output.expression)
        ]
    return tuple(signal_reads)


def list_delayed_values(model: Model, kind: str) -> list[PastValue]:
    """List the delayed values of one kind of signal, each once."""
    return [
        *dict.fromkeys(r.past for r in collect_reads(model) if r.past.kind == kind and r.past.delay)
    ]


def list_delaying_inputs(model: Model) -> list[str]:
    """List the inputs that delays of other values read, each once."""
    delays = [past.delay for past in list_delayed_values(model, "input") if past.delay]
    values = [value for delay in delays for value in collect_past_values(delay)]
    return [*dict.fromkeys(value.name for value in values)]


def find_averaged_inputs(model: Model) -> frozenset[str]:
    """Find inputs with unknown delays only; if held, they are averaged over a step."""
    inputs = [r.past for r in collect_reads(model) if r.past.kind == "input"]
    unknown = {past.name for past in inputs if _has_unknown_delay(past)}
    return frozenset(unknown - {past.name for past in inputs if not _has_unknown_delay(past)})


def _has_unknown_delay(past: PastValue) -> bool:
    return past.delay is not None and mentions_time(past.delay, "parameter")


def reads_cubics(model: Model) -> bool:
    """Whether delayed states are read on the cubics of Runge-Kutta steps, with their slopes."""
    solver = model.solver
    is_runge_kutta = model.form == "differential" and solver.method == "rk4"
    return is_runge_kutta and solver.interpolation == "cubic"


class StoredHistory(NamedTuple):
    """A history in memory: the samples of a state, or what a delayed read of it gives.

    Attributes
    ----------
    state : str
    delay : Expression or None
        None: the samples; with three columns, also the rises of the steps that end there.
    columns : int
        Values in a row for each individual.
    """

    state: str
    delay: Expression | None
    columns: int


def list_stored_histories(model: Model) -> list[StoredHistory]:
    """List the histories that must be stored in memory."""
    if not reads_cubics(model):
        return [StoredHistory(name, None, 1) for name in _list_states_with_history(model)]
    positions = group_delayed_reads(model, "state")
    if list_switch_sides(model):  # a divided step reads at any place
        return [StoredHistory(name, None, 3) for name in _list_states_with_history(model)]
    return [StoredHistory(*past, 2 if max(positions[past]) > 0 else 1) for past in positions]


def group_delayed_reads(model: Model, kind: str) -> dict[tuple[str, Expression], set[int]]:
    """Group the positions of reads of one kind with a constant delay, by signal and delay."""
    positions: dict[tuple[str, Expression], set[int]] = {}
    for read in collect_reads(model):
        is_constant = read.past.delay is not None and not has_varying_delay(read.past)
        if read.past.kind == kind and read.past.delay is not None and is_constant:
            positions.setdefault((read.past.name, read.past.delay), set()).add(read.half_steps)
    return positions


def _list_states_with_history(model: Model) -> list[str]:
    """List the states whose samples must be stored, in the model's order."""
    needed = {
        r.past.name
        for r in collect_reads(model)
        if r.past.kind == "state"
        and (r.past.delay is not None or r.half_steps < -2 * MAX_REGISTER_OFFSET)
    }
    return [state.name for state in model.states if state.name in needed]


def corrects_past(model: Model) -> bool:
    """Whether measurements correct a state that is also read in the past."""
    corrected = {state for one in model.corrections for state, _ in one.gains}
    return not corrected.isdisjoint(stored.state for stored in list_stored_histories(model))


def count_register_samples(model: Model, state: str) -> int:
    """Count the finished samples of a state in registers, besides the last."""
    fixed = [
        -r.half_steps // 2
        for r in collect_reads(model)
        if r.past.name == state and r.past.kind == "state" and r.past.delay is None
    ]
    return max([0, *(back for back in fixed if back <= MAX_REGISTER_OFFSET)])


def find_furthest_offset(model: Model) -> int:
    """Find the largest offset of any read, in whole steps, without delays."""
    return max([0, *(-(r.half_steps // 2) for r in collect_reads(model))])


def group_positions(positions: set[int]) -> list[list[int]]:
    """Group positions so that each group needs one read; the others are earlier values of it.

    Each group holds the position that is read, followed step by step by the earlier positions.
    """
    groups: list[list[int]] = []
    for parity in (0, 1):
        for position in sorted((p for p in positions if p % 2 == parity), reverse=True):
            last = groups[-1] if groups else None
            if last and last[0] % 2 == parity and last[-1] - position <= _MAX_GAP:
                last.extend(range(last[-1] - 2, position - 1, -2))
            else:
                groups.append([position])
    return groups
