"""Moves of estimates under findings, and reasons that no finding tells."""

from collections.abc import Iterable, Mapping, Sequence

from sysid.core.findings import Finding, Move
from sysid.core.text import join_names
from sysid.uncertainty.estimates import Estimate


def list_moves(
    estimates: Sequence[Estimate],
    values: Mapping[str, float],
    stderrs: Mapping[str, float | None],
    own: Mapping[str, float] | None = None,
) -> tuple[Move, ...]:
    """List how far other values are from estimates that have an error, the furthest first.

    They move from the `own` values, if these are not the estimates.

    Examples
    --------
    >>> lag = Estimate("L", "s", 5.0, 0.0, 9.0, 0.5, (4.0, 6.0), "identified")
    >>> list_moves([lag], {"L": 6.5}, {})
    (Move(parameter='L', value=6.5, stderr=None, stderrs=3.0),)
    """
    own = {one.name: one.value for one in estimates} if own is None else own
    moves = [
        Move(name, values[name], stderrs.get(name), (values[name] - own[name]) / one.stderr)
        for one in estimates
        if (name := one.name) in values and name in own and one.stderr
    ]
    return order_moves(moves)


def order_moves(moves: Iterable[Move]) -> tuple[Move, ...]:
    """Order moves, the furthest first."""
    return tuple(sorted(moves, key=lambda move: -abs(move.stderrs)))


def list_untold_reasons(estimates: Sequence[Estimate], findings: Sequence[Finding]) -> list[str]:
    """List the reasons of statuses that no finding tells, each once with its parameters.

    Examples
    --------
    >>> lag = Estimate("L", "s", 5.0, 0.0, 5.0, None, None, "fixed", "it was fixed")
    >>> list_untold_reasons([lag], [])
    ['L: it was fixed']
    """
    told = {name for one in findings for name in one.parameters}
    is_for_all = any(one.severity == "serious" and not one.parameters for one in findings)
    names: dict[str, list[str]] = {}
    for estimate in estimates:
        is_told = estimate.name in told or (is_for_all and estimate.status == "dependent")
        if estimate.reason and not is_told:
            names.setdefault(estimate.reason, []).append(estimate.name)
    return [f"{join_names(some)}: {reason}" for reason, some in names.items()]
