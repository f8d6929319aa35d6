"""Defects of records, each made by itself on a plant of `judged_records`."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from sysid.core.types import FloatArray
from sysid.data.records import Record
from tests.support.library.judged_records import (
    FAST,
    FINE,
    NOISE,
    PLANTS,
    SLOW,
    TIMES,
    N,
    Process,
    draw_levels,
    draw_noise,
    hold,
    make_record,
)

Defect = Callable[[Process, int], Record]
LATE = np.arange(N) >= 230
"""The samples (n,) after a change."""


def _measure(plant: Process, seed: int, u: FloatArray | None = None) -> FloatArray:
    acting = draw_levels(seed) if u is None else u
    return plant.respond(hold(acting))[::FINE] + NOISE * draw_noise(seed)


def _change_output(change: Callable[[FloatArray], FloatArray]) -> Defect:
    return lambda plant, seed: make_record(draw_levels(seed), change(_measure(plant, seed)))


def _change_input(change: Callable[[FloatArray], FloatArray]) -> Defect:
    return lambda plant, seed: make_record(
        draw_levels(seed), _measure(plant, seed, change(draw_levels(seed)))
    )


def _change_plant(share: FloatArray, change: Callable[[Process], Process]) -> Defect:
    """Pass over from a plant to another one, by a share (n,)."""

    def draw(plant: Process, seed: int) -> Record:
        u = draw_levels(seed)
        first, second = (one.respond(hold(u))[::FINE] for one in (plant, change(plant)))
        y = (1.0 - share) * first + share * second + NOISE * draw_noise(seed)
        return make_record(u, y)

    return draw


def _switch_early(plant: Process, seed: int) -> Record:
    """Each change of the input comes up to a period before the sample that shows it."""
    random, u = np.random.default_rng(seed), draw_levels(seed)
    acting = hold(u)
    for k in np.flatnonzero(np.diff(u)) + 1:
        acting[FINE * k - random.integers(FINE) : FINE * k] = u[k]
    return make_record(u, plant.respond(acting)[::FINE] + NOISE * draw_noise(seed))


def _log_noise(plant: Process, seed: int) -> Record:
    """A smooth input whose record has noise that does not act."""
    white = np.random.default_rng([seed, 3]).standard_normal(N)
    u = np.asarray(lfilter([0.1], [1.0, -1.6, 0.65], white))
    y = plant.respond(np.interp(np.arange(N * FINE) / FINE, np.arange(N), u))[::FINE]
    logged = u + 0.3 * np.std(u) * draw_noise(seed + 50)
    return make_record(logged, y + NOISE * draw_noise(seed), reading="first")


def _load(plant: Process, seed: int) -> Record:
    """From 115 s on something acts beside the input."""
    return make_record(draw_levels(seed), _measure(plant, seed, draw_levels(seed) + 0.4 * LATE))


def _push(plant: Process, seed: int) -> Record:
    """At 115 s the slowest state jumps."""
    decay = np.exp(-(TIMES - TIMES[230]) / plant.times[0])
    jump = np.where(LATE, 0.5 * np.minimum(decay, 1.0), 0.0)
    return make_record(draw_levels(seed), _measure(plant, seed) + jump)


def _move_before(plant: Process, seed: int) -> Record:
    """The input is at another value until a sample before the record."""
    u, lead = draw_levels(seed), 8
    y = plant.respond(hold(np.concatenate([np.full(lead, 4.0), np.full(1, u[0]), u])), 4.0)
    y = y[::FINE][lead + 1 :]
    return make_record(u, y + NOISE * draw_noise(seed))


def _average_output(plant: Process, seed: int) -> Record:
    u = draw_levels(seed)
    fine = plant.respond(hold(u))
    y = fine.reshape(-1, FINE).mean(axis=1)
    return make_record(u, y + NOISE * draw_noise(seed))


def _interpolate(plant: Process, seed: int) -> Record:
    """What acts runs in straight lines, and is read as held."""
    u = draw_levels(seed, most=4)
    fine = np.interp(np.arange(N * FINE) / FINE, np.arange(N), u)
    y = plant.respond(fine)[::FINE]
    return make_record(u, y + NOISE * draw_noise(seed))


def _repeat(plant: Process, seed: int) -> Record:
    y = _measure(plant, seed)
    return make_record(draw_levels(seed), y[np.arange(N) // 3 * 3])


def _play(u: FloatArray) -> FloatArray:
    acting, last = np.empty(u.size), u[0]
    for k, value in enumerate(u):
        last = acting[k] = min(max(last, value - 0.2), value + 0.2)
    return acting


def _limit_rate(u: FloatArray) -> FloatArray:
    acting, last = np.empty(u.size), u[0]
    for k, value in enumerate(u):
        last = acting[k] = last + min(max(value - last, -0.15), 0.15)
    return acting


def _filter(samples: float) -> Callable[[FloatArray], FloatArray]:
    pole = np.exp(-1.0 / samples)
    return lambda y: np.asarray(lfilter([1 - pole], [1, -pole], y - y[0]) + y[0])


def _spoil(y: FloatArray) -> FloatArray:
    rows = np.random.default_rng(3).choice(N, 8, replace=False)
    spoiled = y.copy()
    spoiled[rows] += 1.5
    return spoiled


def _grow(plant: Process, seed: int) -> Record:
    u = draw_levels(seed)
    y, noise = plant.respond(hold(u))[::FINE], draw_noise(seed)
    return make_record(u, y + NOISE * noise * np.linspace(0.2, 3.0, N))


def _start_late(level: float) -> Defect:
    """The plant starts at a level of its input that the record does not have."""

    def draw(plant: Process, seed: int) -> Record:
        u = draw_levels(seed)
        return make_record(u, plant.respond(hold(u), level)[::FINE] + NOISE * draw_noise(seed))

    return draw


@dataclass(frozen=True)
class DefectCase:
    """A defect, and the explanations that are true of it.

    Several are if no data can tell them apart. An offset y0 that jumps is a sensor that jumps, and
    the time lag of a single input is an offset between two clocks.
    """

    name: str
    draw: Defect
    explanations: tuple[str, ...]
    plants: tuple[Process, ...] = PLANTS
    seed: int = 1


QUICK = (Process("fopdt", (0.8,)), Process("fopdt", (0.6,), gain=-3.0, delay=1.4))
"""Plants that follow what happens between two samples."""
LATER = (FAST, replace(SLOW, delay=3.4))

READINGS = ("reading of an input", "mean of a period")
"""A mean of the response to a held input is the response to straight lines, half a period later."""

CONSTANCY = (
    DefectCase(
        "the gain changes",
        _change_plant(LATE * 1.0, lambda p: replace(p, gain=1.3 * p.gain)),
        ("change of a parameter", "change of a unit"),
    ),
    DefectCase(
        "a time constant changes",
        _change_plant(LATE * 1.0, lambda p: replace(p, times=(1.6 * p.times[0], *p.times[1:]))),
        ("change of a parameter",),
    ),
    DefectCase(
        "the time lag changes",
        _change_plant(LATE * 1.0, lambda p: replace(p, delay=p.delay + 0.8)),
        ("change of a time lag", "jump of a clock"),
    ),
    DefectCase(
        "the gain drifts",
        _change_plant(TIMES / TIMES[-1], lambda p: replace(p, gain=1.3 * p.gain)),
        ("drift of a parameter",),
    ),
    DefectCase(
        "the time lag drifts",
        _change_plant(TIMES / TIMES[-1], lambda p: replace(p, delay=p.delay + 0.8)),
        ("drift of a time lag", "drift of a clock"),
    ),
)
SENSOR = (
    DefectCase(
        "the sensor drifts",
        _change_output(lambda y: y + 0.3 * TIMES / TIMES[-1]),
        ("drift of a sensor", "drift of a parameter"),
    ),
    DefectCase(
        "the sensor jumps",
        _change_output(lambda y: y + 0.3 * LATE),
        ("step of a sensor", "change of a parameter"),
    ),
    DefectCase(
        "the unit changes",
        _change_output(lambda y: np.where(LATE, 1.3 * y - 0.6, y)),
        ("change of a unit",),
    ),
    DefectCase(
        "the sensor is curved",
        _change_output(lambda y: y + 0.15 * (y - 1.0) ** 2),
        ("curve of a sensor",),
    ),
    DefectCase(
        "the sensor is at its limit",
        _change_output(lambda y: np.clip(y, *np.quantile(y, [0.0, 0.8]))),
        ("limit of a sensor",),
    ),
    DefectCase("readings repeat", _repeat, ("repeated reading",)),
    DefectCase(
        "the sensor is filtered",
        _change_output(_filter(6.0)),
        ("filter of a sensor", "one more time constant", "zero of the response"),
        seed=2,
    ),
    DefectCase(
        "the input leaks into the output",
        lambda plant, seed: make_record(
            draw_levels(seed), _measure(plant, seed) + 0.03 * draw_levels(seed)
        ),
        ("direct path",),
    ),
)
ACTUATOR = (
    DefectCase(
        "the actuator is at its limit",
        _change_input(lambda u: np.minimum(u, 1.3)),
        ("limit of an actuator",),
    ),
    DefectCase(
        "the actuator is curved", _change_input(lambda u: 0.5 * u**2), ("curve of an actuator",)
    ),
    DefectCase("the actuator has backlash", _change_input(_play), ("backlash",)),
    DefectCase(
        "the actuator has a dead zone",
        _change_input(lambda u: np.sign(u - 1.0) * np.maximum(np.abs(u - 1.0) - 0.3, 0.0)),
        ("dead zone",),
    ),
    DefectCase("the actuator is slow", _change_input(_limit_rate), ("limit of the rate",), seed=2),
    DefectCase("the logged input is noisy", _log_noise, ("noise of an input",), QUICK),
)
LOADS = (
    DefectCase("a load begins", _load, ("load",), seed=2),
    DefectCase("a state jumps", _push, ("jump of the states",)),
)
READING = (
    DefectCase("the input runs in lines", _interpolate, READINGS, QUICK),
    DefectCase("the output is a mean", _average_output, READINGS, QUICK),
    DefectCase("the input switches between samples", _switch_early, ("switches between samples",)),
)
HISTORY = (
    DefectCase(
        "the input moved before the record",
        _move_before,
        ("input before the record",),
        LATER,
    ),
)
STRUCTURE = (
    DefectCase(
        "a time constant is missing",
        _change_plant(TIMES * 0 + 1, lambda p: replace(p, times=(*p.times, 2.0))),
        ("one more time constant", "zero of the response", "missing dynamics"),
        seed=4,
    ),
)
NOISES = (
    DefectCase("there are outliers", _change_output(_spoil), ("outliers",), seed=4),
    DefectCase("the noise grows", _grow, ("unequal variance",)),
)
