"""Determination: what the data do not tell of single parameters, and bounds that hold them."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sysid.core.findings import Finding, Severity, note
from sysid.core.text import join_names
from sysid.core.types import RANK_TOLERANCE
from sysid.core.units import format_unit
from sysid.identifiability.combinations import IdentifiableCombination
from sysid.judgement.levels import NOTABLE_MOVE, SEPARABLE
from sysid.models.kalman_filter import is_noise_parameter
from sysid.models.parameters import BoundSide, Parameter
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis, compute_physical_scale
from sysid.uncertainty.estimates import Estimate, Uncertainty

_RIDGE_CORRELATION = 0.9  # of a time lag that is not separable from 0: it shares its effect
_VAGUE_SHARE = 0.5  # of its value: standard error from which a group is practically unidentifiable


def find_undetermined(
    problem: Problem, analysis: Analysis, delays: set[str], *, are_residuals_noise: bool
) -> Iterator[Finding]:
    """Find what the data do not determine: alone, in combination, or beyond a bound.

    Sizes of noise that they leave open are a note: intervals of the others average over them.
    """
    free = [e for e in analysis.estimates if e.is_free and not is_noise_parameter(e.name)]
    known = analysis.uncertainty
    yield from _find_open_noise(analysis.estimates)
    yield from _find_bounds(problem, analysis, free, are_residuals_noise=are_residuals_noise)
    yield from _find_limits(analysis, free, are_residuals_noise=are_residuals_noise)
    yield from _find_unidentifiable(free, () if known is None else known.groups)
    yield from _find_constant_inputs(problem, free)
    if known is not None:
        yield from _find_insignificant(free, delays)
        yield from _find_vague_groups(known.groups)
        yield from _find_inseparable(known, free, delays)


def _find_open_noise(estimates: Sequence[Estimate]) -> Iterator[Finding]:
    open_sizes = [
        one
        for one in estimates
        if is_noise_parameter(one.name) and one.is_free and one.status != "identified"
    ]
    if open_sizes:
        names = join_names([one.name for one in open_sizes])
        reasons = "; ".join(f"{one.name}: {one.reason or one.status}" for one in open_sizes)
        yield note(
            "size of noise",
            "noise",
            f"the data leave {names} open ({reasons}). Intervals of the other parameters allow "
            "for it",
        )


def find_ambiguous(estimates: Sequence[Estimate]) -> Iterator[Finding]:
    """Find values of other minima that fit as well."""
    found = [one for one in estimates if one.status == "ambiguous"]
    if found:
        names = join_names([one.name for one in found])
        values = "; ".join(f"{one.name}: {one.reason}" for one in found)
        yield Finding(
            "other minimum",
            "search",
            "caution",
            f"another value of {names} fits as well",
            f"another minimum fits as well, with other values of {names} ({values}).",
            "Use an input that tells them apart, or narrower bounds.",
            parameters=tuple(one.name for one in found),
            status="ambiguous",
        )


def _find_bounds(
    problem: Problem,
    analysis: Analysis,
    free: Sequence[Estimate],
    *,
    are_residuals_noise: bool,
) -> Iterator[Finding]:
    """Find estimates at a bound of the search; it may be why residuals are not noise."""
    bounded = [one for one in free if one.status == "at bound" and one.name not in analysis.limits]
    active = [one for one in analysis.active_bounds if not is_noise_parameter(one.name)]
    if not bounded and not active:
        return
    names = [bound.name for bound in active] or [one.name for one in bounded]
    lies = "lies at its bound" if len(names) == 1 else "lie at their bounds"
    texts = [str(bound) for bound in active]
    listed = {bound.name for bound in active}
    texts += [_describe_bound(one) for one in bounded if one.name not in listed]
    cures = join_names([bound.advice for bound in active]) if active else ""
    by_name = {parameter.name: parameter for parameter in problem.free_parameters}
    settings = [_write_limit(one, by_name[one.name]) for one in free if one.name in names]
    limits = "it is a physical limit" if len(names) == 1 else "they are physical limits"
    is_serious = bool(active) and not are_residuals_noise
    cause = " The residuals are not noise, which the bound may cause." if is_serious else ""
    at_bound = {*names, *(one.name for one in bounded)}
    followers = [name for name in _find_followers(problem, analysis) if name not in at_bound]
    follow = "follow it" if len(followers) != 1 else "follows it"
    yield Finding(
        "bound",
        "identifiability",
        "serious" if is_serious else "caution",
        f"{join_names(names)} {lies}",
        f"{join_names(texts)}. The best value may be outside, and "
        f"{join_names(followers) if followers else 'other estimates'} {follow}.{cause}",
        f"{f'To widen: {cures}. Or' if cures else 'Widen the range, or'} set "
        f"{join_names(settings)} if {limits}.",
        parameters=(*([one.name for one in bounded] or names), *followers),
    )


def _find_followers(problem: Problem, analysis: Analysis) -> list[str]:
    """Find the parameters that move notably in the linear model without the bounds that hold some.

    At a bound the others are the best *given* the bound. Their standard errors do not tell how far
    they move without it (White, Econometrica 50 (1982) 1).
    """
    if analysis.residuals_and_sensitivities is None:
        return []
    known = {one.name: one for one in analysis.estimates}
    theta = np.array([known[name].value for name in problem.free_names])
    error, columns = analysis.residuals_and_sensitivities
    step = np.linalg.lstsq(columns, -error, rcond=RANK_TOLERANCE)[0]
    moved = np.abs(step * compute_physical_scale(problem, theta))
    return [
        name
        for name, move in zip(problem.free_names, moved.tolist(), strict=True)
        if (stderr := known[name].stderr) and move > NOTABLE_MOVE * stderr
    ]


def _find_limits(
    analysis: Analysis, free: Sequence[Estimate], *, are_residuals_noise: bool
) -> Iterator[Finding]:
    """Find estimates at a physical limit, which is a doubt only where the data pull them over it.

    The likelihood ratio at a limit that holds is no larger than inside (Self and Liang 1987).
    """
    severity: Severity = "caution" if are_residuals_noise else "serious"
    for one in free:
        if one.name not in analysis.limits:
            continue
        if one.status == "at bound":
            brief = f"the data pull {one.name} over its physical limit"
            yield Finding(
                "bound",
                "identifiability",
                severity,
                brief,
                f"{_describe_bound(one)}, a limit of the quantity, and the data pull it beyond. "
                "The model lacks something then, or the record is at fault.",
                parameters=(one.name,),
                status="at bound",
            )
        elif one.status == "identified":
            text = f"{_describe_bound(one)}, a limit of the quantity"
            yield replace(note("bound", "identifiability", text), parameters=(one.name,))


def _describe_bound(estimate: Estimate) -> str:
    side, bound = _find_bound(estimate)
    return f"{estimate.name} lies at its {side} bound {bound:g}{format_unit(estimate.unit)}"


def _find_bound(estimate: Estimate) -> tuple[BoundSide, float]:
    """Find the nearer bound of an estimate."""
    is_low = estimate.value < 0.5 * (estimate.lower + estimate.upper)
    return ("lower", estimate.lower) if is_low else ("upper", estimate.upper)


def _write_limit(estimate: Estimate, parameter: Parameter) -> str:
    """Write the setting that calls a bound a physical limit; one of the data is given with it."""
    side, bound = _find_bound(estimate)
    if parameter.follows_data(side):
        return f"parameters: {{{estimate.name}: {{{side}: {bound:.6g}, physical: {side}}}}}"
    return f"parameters: {{{estimate.name}: {{physical: {side}}}}}"


def _find_unidentifiable(
    free: Sequence[Estimate], groups: Sequence[IdentifiableCombination]
) -> Iterator[Finding]:
    alone = [one for one in free if one.status == "unidentifiable"]
    if alone:
        names = [one.name for one in alone]
        reasons = dict.fromkeys(f"{one.name}: {one.reason}" for one in alone)
        yield Finding(
            "no information",
            "identifiability",
            "caution",
            f"the data do not determine {join_names(names)}",
            f"the data do not determine {join_names(names)} ({'; '.join(reasons)}).",
            f"Fix {'it' if len(names) == 1 else 'them'}, or excite the system differently.",
            parameters=tuple(names),
            status="unidentifiable",
        )
    grouped = [one for one in free if one.status == "group"]
    if grouped:
        names = [one.name for one in grouped]
        listed = ", ".join(group.text for group in groups if set(group.members) & set(names))
        yield Finding(
            "combination",
            "identifiability",
            "caution",
            f"the data determine {join_names(names)} only in combination",
            f"the data do not determine {join_names(names)} alone, only in combination"
            f"{f': {listed}' if listed else ''}.",
            "Use the combinations, or fix a parameter that you know.",
            parameters=tuple(names),
            status="group",
        )


def _find_constant_inputs(problem: Problem, free: Sequence[Estimate]) -> Iterator[Finding]:
    """Find inputs that are constant in every record, and the parameters that they leave open."""
    unknown = [one.name for one in free if one.status in ("group", "unidentifiable")]
    for quantity in problem.model.inputs:
        values = [
            channel.values
            for record in problem.records
            for channel in record.inputs
            if channel.name == quantity.name
        ]
        if unknown and all(float(np.ptp(signal)) == 0.0 for signal in values):
            yield Finding(
                "constant input",
                "record",
                "caution",
                f"{quantity.name} is constant",
                f"input {quantity.name!r} is constant, so it excites nothing. These data leave "
                f"unidentified: {', '.join(unknown)}.",
                "Choose another channel, or a record in which it moves.",
            )


def _find_insignificant(free: Sequence[Estimate], delays: set[str]) -> Iterator[Finding]:
    """Find quantities that cannot be negative and are not distinguishable from 0."""
    for one in free:
        if one.status != "identified" or not one.stderr or one.lower < 0:
            continue
        unit = format_unit(one.unit)
        if one.name in delays and abs(one.value) < SEPARABLE * one.stderr:
            yield Finding(
                "no time lag",
                "identifiability",
                "caution",
                f"{one.name} may be 0",
                f"{one.name} = {one.value:.3g} ± {one.stderr:.3g}{unit} is less than two of its "
                "standard errors from 0: the data show no time lag.",
            )
        elif one.stderr >= one.value:
            yield note(
                "insignificant",
                "identifiability",
                f"the standard error of {one.name}, {one.stderr:.3g}{unit}, is as large as its "
                f"value, {one.value:.3g}{unit}",
            )


def _find_vague_groups(groups: Sequence[IdentifiableCombination]) -> Iterator[Finding]:
    for group in groups:
        if group.stderr and group.stderr >= _VAGUE_SHARE * abs(group.value):
            yield note(
                "vague combination",
                "identifiability",
                f"{group.text} is practically unidentifiable: {group.value:.3g} with a standard "
                f"error of {group.stderr:.3g}",
            )


def _find_inseparable(
    uncertainty: Uncertainty, free: Sequence[Estimate], delays: set[str]
) -> Iterator[Finding]:
    """Find time lags not distinguishable from 0 that share their effect with a parameter."""
    known = {one.name: one for one in free if one.stderr and one.status != "at bound"}
    small = {
        name
        for name in delays
        if name in known and abs(known[name].value) < SEPARABLE * (known[name].stderr or 0.0)
    }
    names = uncertainty.names
    for i, first in enumerate(names):
        for j, second in enumerate(names[i + 1 :], i + 1):
            if not {first, second} & small or not {first, second} <= known.keys():
                continue
            r = float(uncertainty.correlation[i, j])
            alike = float(uncertainty.sensitivity_correlation[i, j])
            if max(abs(r), abs(alike)) > _RIDGE_CORRELATION:
                yield note(
                    "ridge",
                    "identifiability",
                    f"{first} and {second} are not separable (correlation {r:.3f}): the data fix "
                    "only a combination of them",
                )
