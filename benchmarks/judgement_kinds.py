"""Kinds of records with a known truth: sound ones, and such with one defect each.

A kind changes one thing of a drawn scene: the input, the actuator, the plant, the sensor, the
noise, the clocks, or what the log keeps. `write_record` gives a record of a kind from Python.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal
from zlib import crc32

import numpy as np
from scipy.signal import lfilter

from benchmarks.judgement_plants import (
    FINE,
    PLANTS,
    Control,
    Plant,
    draw_log,
    integrate,
    write_document,
)
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording

Group = Literal["defect", "dirty", "white", "coloured"]
"""A defect; sound but rough; sound with white noise; sound with coloured noise."""
Detectable = Literal["misfit", "always", "never"]
"""By what the record can show a defect: as far as the model misfits, by its design, by nothing."""
Truth = Mapping[str, tuple[float, ...]]
"""For each parameter the values that are true in some part of the record."""
Logged = dict[str, FloatArray]
"""Columns of the log: `t`, the inputs, `y`."""

PROCESSES = ("fopdt", "sopdt", "ipdt")
LEVELLING = ("fopdt", "sopdt")
OWN = ("tank", "feedback", "valve", "cooler")
ALL = (*PROCESSES, *OWN)
DRIVES = ("steps", "prbs", "step", "smooth")
FAMILIES = frozenset(
    [
        "constancy",
        "clocks",
        "sensor",
        "actuator",
        "variance",
        "input",
        "reading",
        "start",
        "history",
        "structure",
        "noise",
        "search",
        "record",
    ]
)
"""Families of explanations; other words in the reasons of a kind are names of explanations."""
LIVELY = ("steps", "prbs", "smooth")
HELD = ("steps", "prbs")
MANY = ("steps", "smooth")
"""Inputs of more than two levels: between two levels every characteristic is a straight line."""


@dataclass
class Scene:
    """One experiment before it is run; a kind changes it.

    Attributes
    ----------
    random : Generator
    plant : Plant
    drive : str
        Kind of the input.
    shape : FloatArray, shape (before + count,)
        Input at the samples, within ± 1 of its range.
    before : int
        Samples before the record.
    snr : float
        Standard deviation of the output over that of the noise.
    values : dict
        Parameters; an array gives one for each step of the integrator.
    """

    random: np.random.Generator
    plant: Plant
    drive: str
    shape: FloatArray
    snr: float
    noise_sd: float = 0.0
    before: int = 0
    held: bool = True
    values: dict[str, Any] = field(default_factory=dict)
    truth: dict[str, tuple[float, ...]] = field(default_factory=dict)
    model: Any = None
    second: FloatArray | None = None
    load: FloatArray | None = None
    control: Control | None = None
    actuator: Callable[[FloatArray], FloatArray] | None = None
    sensor: Callable[[FloatArray], FloatArray] | None = None
    sample: Callable[[FloatArray], FloatArray] | None = None
    sample_input: Callable[[FloatArray], FloatArray] | None = None
    noise: Callable[[FloatArray, float], FloatArray] | None = None
    log: Callable[[Logged], Logged] | None = None
    respond: Callable[[FloatArray], FloatArray] | None = None

    @property
    def count(self) -> int:
        """Samples of the record."""
        return self.shape.size - self.before

    @property
    def times(self) -> FloatArray:
        """Times of the record's samples (s)."""
        return self.plant.period * np.arange(self.count)

    @property
    def duration(self) -> float:
        """From the first to the last sample (s)."""
        return self.plant.period * (self.count - 1)

    @property
    def clock(self) -> FloatArray:
        """Times of the integrator's steps, from the record's start (s)."""
        return self.plant.step * (np.arange(self.shape.size * FINE) - self.before * FINE)

    @property
    def input_values(self) -> FloatArray:
        """First input at the samples, those before the record too."""
        return self.plant.base + self.plant.span * self.shape

    def refine(self, values: FloatArray) -> FloatArray:
        """Values of each step: held from sample to sample, or straight lines between them."""
        if self.held:
            return np.repeat(values, FINE)
        middle = (np.arange(values.size * FINE) + 0.5) / FINE
        return np.interp(middle, np.arange(values.size), values)

    def read_at(self, fine: FloatArray, moments: FloatArray) -> FloatArray:
        """A fine signal at moments from the record's start (s)."""
        return np.interp(moments, self.clock, fine[: self.clock.size])

    def run(self) -> Logged:
        """Run the experiment and return its log."""
        drive = self.refine(self.input_values)
        acting = drive if self.actuator is None else self.actuator(drive)
        y = self._answer(drive, acting)
        if self.sensor is not None:
            y = self.sensor(y)
        u = drive[::FINE] if self.control is not None else self.input_values
        clean = y[: drive.size : FINE][self.before :] if self.sample is None else self.sample(y)
        u = u[self.before :] if self.sample_input is None else self.sample_input(drive)
        logged = {"t": self.times, "u": u}
        if self.second is not None:
            logged["v"] = self.second[self.before :]
        size = self.noise_sd = float(np.std(clean)) / self.snr
        if self.noise is None:
            logged["y"] = clean + size * self.random.standard_normal(clean.size)
        else:
            logged["y"] = clean + self.noise(clean, size)
        return logged if self.log is None else self.log(logged)

    def _answer(self, drive: FloatArray, acting: FloatArray) -> FloatArray:
        if self.respond is not None:
            return self.respond(acting)
        drives = [acting]
        if len(self.plant.inputs) > 1:
            assert self.second is not None
            drives.append(self.refine(self.second))
        y = integrate(self.plant, self.values, drives, self.load, self.control)
        if self.control is not None:
            drive[:] = drives[0]
        return y


@dataclass(frozen=True)
class Kind:
    """A kind of record.

    Attributes
    ----------
    name : str
    change : callable
        Changes a scene.
    reasons : frozenset of str
        Families and names of the explanations that are the true reason.
    group : Group
    detectable : Detectable
    plants : tuple of str
        Taken in turn by the seed.
    drives : tuple of str
        One of them is drawn.
    snr : tuple of float
        Range of the signal-to-noise ratio.
    resolution : float
        Share of a value that is no error, whatever the standard error: that of the integrators.
    """

    name: str
    change: Callable[[Scene], None]
    reasons: frozenset[str]
    group: Group
    detectable: Detectable
    plants: tuple[str, ...]
    drives: tuple[str, ...]
    snr: tuple[float, float]
    resolution: float


KINDS: dict[str, Kind] = {}


def kind(
    reasons: str = "",
    *,
    group: Group = "defect",
    detectable: Detectable = "misfit",
    plants: tuple[str, ...] = ALL,
    drives: tuple[str, ...] = LIVELY,
    snr: tuple[float, float] = (15.0, 100.0),
    resolution: float = 0.0,
    name: str | None = None,
) -> Callable[[Callable[[Scene], None]], Callable[[Scene], None]]:
    """Register a change of a scene as a kind; `reasons` are words."""

    def register(change: Callable[[Scene], None]) -> Callable[[Scene], None]:
        title = name or change.__name__
        told = frozenset(reasons.split())
        KINDS[title] = Kind(title, change, told, group, detectable, plants, drives, snr, resolution)
        return change

    return register


@dataclass(frozen=True)
class Case:
    """A record of a kind: what is fitted, the recording, the truth, and the plant's name.

    `noise_sd` is the standard deviation of the noise before the log.
    """

    kind: Kind
    seed: int
    plant: str
    model: str | dict[str, Any]
    logged: Logged
    truth: Truth
    noise_sd: float

    @property
    def clean(self) -> FloatArray:
        """Logged output of the same experiment without noise."""
        return draw_case(self.kind.name, self.seed, quiet=True).logged["y"]

    @property
    def recording(self) -> Recording:
        """The log as a recording."""
        times = self.logged["t"]
        names = [key for key in self.logged if key != "t"]
        return Recording(tuple(Channel(key, times, self.logged[key]) for key in names))


def draw_case(name: str, seed: int, *, quiet: bool = False) -> Case:
    """Draw the record of a kind and a seed; `quiet` leaves out the noise, and nothing else."""
    kind = KINDS[name]
    random = np.random.default_rng([seed, crc32(name.encode())])
    plant_name = kind.plants[seed % len(kind.plants)]
    plant = PLANTS[plant_name](random)
    drive = str(random.choice(kind.drives))
    scene = Scene(
        random,
        plant,
        drive,
        draw_shape(random, plant, drive),
        draw_log(random, *kind.snr) if kind.snr[1] < np.inf else np.inf,
        held=drive != "smooth",
        values=dict(plant.truth),
        truth={key: (value,) for key, value in plant.truth.items()},
        model=plant.model,
    )
    if len(plant.inputs) > 1:
        other = draw_steps(random, scene.count, plant, rest=0)
        scene.second = plant.base + 5.0 + 2.0 * other if plant.base else other
        scene.held = True
    if quiet:
        scene.snr = np.inf
    kind.change(scene)
    logged = scene.run()
    return Case(kind, seed, plant_name, scene.model, logged, scene.truth, scene.noise_sd)


def write_record(name: str, seed: int) -> tuple[str | dict[str, Any], Recording, Truth]:
    """The model to fit, the recording and the truth of a kind and a seed."""
    case = draw_case(name, seed)
    return case.model, case.recording, case.truth


# Inputs


def draw_shape(random: np.random.Generator, plant: Plant, drive: str) -> FloatArray:
    """Draw an input within ± 1; it begins at rest."""
    count = int(random.integers(300, 601))
    if drive == "step":
        return draw_single_step(random, plant)
    if drive == "smooth":
        return draw_smooth(random, count, plant)
    if drive == "prbs":
        every = max(2, round(random.uniform(0.6, 1.5) * plant.slow / plant.period))
        levels = random.choice([-1.0, 1.0], count // every + 1)
        return np.repeat(levels, every)[:count]
    return draw_steps(random, count, plant, rest=int(random.integers(5, 30)))


def draw_steps(random: np.random.Generator, count: int, plant: Plant, rest: int) -> FloatArray:
    """Draw random levels that each last 0.4 to 3 slow time constants."""
    shape, level = np.zeros(count), 0.0
    start = rest
    while start < count:
        level = random.uniform(-1.0, 1.0)
        shape[start:] = level
        start += max(2, round(random.uniform(0.4, 3.0) * plant.slow / plant.period))
    return shape


def draw_single_step(random: np.random.Generator, plant: Plant) -> FloatArray:
    """Draw a rest and one step; an integrator gets a pulse."""
    slow = plant.slow / plant.period
    rest = int(random.uniform(1.0, 2.0) * slow) + 5
    shape = np.zeros(rest + int((plant.truth["L"] + 8.0 * plant.slow) / plant.period))
    shape[rest:] = random.choice([-1.0, 1.0]) * random.uniform(0.6, 1.0)
    if plant.name == "ipdt":
        shape[rest + int(2.0 * slow) :] = 0.0
    return shape


def draw_smooth(random: np.random.Generator, count: int, plant: Plant) -> FloatArray:
    """Draw a multisine with periods from 5 to 40 slow time constants that begins at rest."""
    times = plant.period * np.arange(count)
    periods = np.exp(random.uniform(np.log(5.0), np.log(30.0), 7)) * plant.slow
    waves = np.sin(2.0 * np.pi * times[:, None] / periods + random.uniform(0.0, 6.28, 7))
    rising = 1.0 - np.exp(-((times / plant.slow) ** 2))
    shape = rising * waves.sum(axis=1)
    return shape / np.max(np.abs(shape))


# Parts of kinds


def draw_moment(scene: Scene, low: float = 0.35, high: float = 0.65) -> float:
    """Draw a moment within the record (s)."""
    return float(scene.random.uniform(low, high)) * scene.duration


def change_value(scene: Scene, name: str, factor: float, *, slowly: bool = False) -> None:
    """Let a parameter change by a factor, at a moment or along a straight line."""
    before, factor = scene.plant.truth[name], float(factor)
    if slowly:
        share = np.clip(scene.clock / scene.duration, 0.0, 1.0)
    else:
        share = np.where(scene.clock > draw_moment(scene), 1.0, 0.0)
    scene.values[name] = before * (1.0 + (factor - 1.0) * share)
    scene.truth[name] = (before, before * factor)


def find_gain(plant: Plant) -> str:
    """Name of the parameter that scales the first input."""
    return next(name for name in ("K", "q", "b", "V") if name in plant.truth)


def find_time(plant: Plant) -> str:
    """Name of the parameter that sets the slowest time constant."""
    return next(name for name in ("T1", "T", "c", "a") if name in plant.truth)


def filter_noise(scene: Scene, coefficients: list[float], size: float, count: int) -> FloatArray:
    """Autoregressive noise of a standard deviation; coefficients of the denominator."""
    white = scene.random.standard_normal(count + 500)
    noise = lfilter([1.0], coefficients, white)[500:]
    reference = lfilter([1.0], coefficients, np.r_[1.0, np.zeros(2000)])
    return noise * size / float(np.sqrt(np.sum(reference**2)))


def smooth_back(fine: FloatArray, width: int) -> FloatArray:
    """Mean over the last `width` steps at each step."""
    total = np.cumsum(np.r_[np.full(width, fine[0]), fine])
    return (total[width:] - total[:-width]) / width


def hold_values(values: FloatArray, every: int) -> FloatArray:
    """Only each so manieth value, held."""
    return values[(np.arange(values.size) // every) * every]


def spread(values: FloatArray) -> float:
    """Standard deviation."""
    return float(np.std(values))


# Sound records

_TELLING = {"sopdt": (20.0, 100.0), "cooler": (20.0, 100.0), "valve": (10.0, 100.0)}
"""Ranges of the signal-to-noise ratio from where on the record determines all parameters."""
for _plant in PLANTS:
    _drives = DRIVES if _plant in ("fopdt", "ipdt") else HELD
    _snr = _TELLING.get(_plant, (5.0, 100.0))
    kind(group="white", plants=(_plant,), drives=_drives, snr=_snr, name=f"sound_{_plant}")(
        lambda _scene: None
    )


@kind(group="white", plants=("fopdt", "tank", "valve"), drives=("smooth",), snr=(10.0, 100.0))
def sound_smooth(scene: Scene) -> None:
    """A smooth input."""


@kind(group="white", plants=("fopdt", "sopdt", "valve"), snr=(10.0, 100.0))
def sound_warm(scene: Scene) -> None:
    """The plant is at rest, but far from zero."""
    scene.shape += 0.8 if "y0" in scene.values else 0.0


@kind(group="white", plants=("fopdt", "sopdt", "tank"), drives=HELD)
def sound_long(scene: Scene) -> None:
    """5,000 samples."""
    parts = [draw_shape(scene.random, scene.plant, scene.drive) for _ in range(17)]
    scene.shape = np.concatenate([scene.shape, *parts])[:5000]


@kind(
    group="white",
    plants=("fopdt", "sopdt", "cooler"),
    drives=HELD,
    snr=(1.0, np.inf),
    resolution=1e-4,
)
def sound_noise_free(scene: Scene) -> None:
    """No noise but the rounding to 12 digits."""
    scene.log = lambda log: log | {"y": np.array([float(f"{one:.12g}") for one in log["y"]])}


def colour(scene: Scene, poles: list[complex], white: float = 0.0) -> None:
    """Make the noise autoregressive with these poles, plus a share of white noise."""
    coefficients = np.real(np.poly(poles)).tolist()

    def draw(clean: FloatArray, size: float) -> FloatArray:
        coloured = filter_noise(scene, coefficients, size, clean.size)
        return coloured + white * size * scene.random.standard_normal(clean.size)

    scene.noise = draw


@kind(group="coloured", plants=("fopdt", "sopdt", "tank", "valve"))
def sound_ar1(scene: Scene) -> None:
    """First-order noise."""
    colour(scene, [scene.random.uniform(0.5, 0.95)])


@kind(group="coloured", plants=("fopdt", "sopdt", "cooler"))
def sound_ar1_white(scene: Scene) -> None:
    """First-order noise and white noise."""
    colour(scene, [scene.random.uniform(0.7, 0.95)], white=scene.random.uniform(0.3, 1.0))


@kind(group="coloured", plants=("fopdt", "sopdt", "feedback"))
def sound_ar2(scene: Scene) -> None:
    """Second-order noise, with an oscillation."""
    pole = scene.random.uniform(0.6, 0.9) * np.exp(1j * scene.random.uniform(0.2, 1.2))
    colour(scene, [pole, np.conj(pole)])


@kind(group="coloured", plants=("twin", "mixer"), drives=HELD)
def sound_two_inputs_ar1(scene: Scene) -> None:
    """Two inputs and first-order noise."""
    colour(scene, [scene.random.uniform(0.5, 0.9)])


@kind(group="coloured", plants=("fopdt", "sopdt"), drives=HELD)
def sound_long_ar1(scene: Scene) -> None:
    """3,000 samples with first-order noise."""
    sound_long(scene)
    scene.shape = scene.shape[:3000]
    colour(scene, [scene.random.uniform(0.5, 0.9)])


# Clocks


@kind("clocks", detectable="never")
def clock_offset_hidden(scene: Scene) -> None:
    """The clock of y is late by less than can be seen."""
    late = scene.random.uniform(0.2, 0.6) * scene.plant.slow
    scene.sample = lambda fine: scene.read_at(fine, scene.times - late)


@kind("clocks input reading record search")
def clock_offset_acausal(scene: Scene) -> None:
    """The clock of y is early by more than the delay: y answers before u."""
    early = scene.plant.truth["L"] + scene.random.uniform(0.1, 0.4) * scene.plant.slow
    scene.sample = lambda fine: scene.read_at(fine, scene.times + early)


@kind("clocks reading variance constancy")
def stamps_rounded(scene: Scene) -> None:
    """Stamps are rounded down to a grid that the sampling period is no multiple of."""
    grid = scene.plant.period / scene.random.uniform(1.3, 2.6)
    scene.log = lambda log: log | {"t": np.floor(log["t"] / grid + 1e-9) * grid}


@kind("clocks reading variance noise", drives=("smooth",))
def stamps_jittered(scene: Scene) -> None:
    """Samples of y are taken at moments that scatter about their stamps."""
    moments = scene.times + scene.random.uniform(-0.5, 0.5, scene.count) * scene.plant.period
    scene.sample = lambda fine: scene.read_at(fine, moments)


@kind("clocks constancy")
def clock_drift(scene: Scene) -> None:
    """The clock of y gains or loses 3 to 8 sampling periods over the record."""
    total = scene.random.uniform(3.0, 8.0) * scene.plant.period * scene.random.choice([-1, 1])
    moments = scene.times * (1.0 + total / scene.duration)
    scene.sample = lambda fine: scene.read_at(fine, moments)
    lag = scene.plant.truth["L"]
    scene.truth["L"] = (lag, max(lag - total, 0.0))


@kind("clocks constancy")
def clock_jump(scene: Scene) -> None:
    """The clock of y jumps by 3 to 8 sampling periods."""
    jump = scene.random.uniform(3.0, 8.0) * scene.plant.period
    moments = scene.times - np.where(scene.times > draw_moment(scene), jump, 0.0)
    scene.sample = lambda fine: scene.read_at(fine, moments)
    scene.truth["L"] = (scene.plant.truth["L"], scene.plant.truth["L"] + jump)


@kind("clocks constancy record")
def clock_gap(scene: Scene) -> None:
    """Rows are lost, and the stamps go on as if none were."""
    first = int(scene.count * scene.random.uniform(0.3, 0.7))
    lost = int(scene.random.uniform(0.7, 2.0) * scene.plant.slow / scene.plant.period)

    def drop(log: Logged) -> Logged:
        kept = np.delete(np.arange(scene.count), np.arange(first, first + lost))
        return {key: one[kept] for key, one in log.items()} | {"t": log["t"][: kept.size]}

    scene.log = drop


@kind("clocks record reading constancy input history")
def rows_deleted(scene: Scene) -> None:
    """Rows are deleted, and the stamps show it."""
    first = int(scene.count * scene.random.uniform(0.3, 0.7))
    lost = int(scene.random.uniform(0.7, 2.0) * scene.plant.slow / scene.plant.period)
    gone = np.arange(first, first + lost)
    scene.log = lambda log: {key: np.delete(one, gone) for key, one in log.items()}


# Constancy


@kind("constancy clocks")
def lag_change(scene: Scene) -> None:
    """The delay changes."""
    change_value(scene, "L", scene.random.choice([0.55, 0.7, 1.35, 1.6]))


@kind("constancy actuator sensor", plants=(*PROCESSES, "tank", "valve"))
def gain_change(scene: Scene) -> None:
    """The gain changes."""
    change_value(scene, find_gain(scene.plant), scene.random.choice([0.7, 0.8, 1.25, 1.5]))


@kind("constancy", plants=(*LEVELLING, "valve", "cooler"))
def time_change(scene: Scene) -> None:
    """The time constant changes."""
    change_value(scene, find_time(scene.plant), scene.random.choice([0.5, 0.65, 1.5, 2.0]))


@kind("constancy sensor actuator", plants=(*PROCESSES, "tank", "valve"))
def gain_drift(scene: Scene) -> None:
    """The gain drifts over the record."""
    factor = scene.random.choice([0.6, 0.75, 1.3, 1.6])
    change_value(scene, find_gain(scene.plant), factor, slowly=True)


@kind("constancy clocks")
def lag_drift(scene: Scene) -> None:
    """The delay drifts over the record."""
    change_value(scene, "L", scene.random.choice([0.5, 1.6]), slowly=True)


@kind("constancy structure actuator clocks", plants=("fopdt", "sopdt", "tank", "valve"))
def lag_follows_flow(scene: Scene) -> None:
    """The delay is shorter where the input is larger."""
    lag = scene.plant.truth["L"]
    scene.values["L"] = lag * (1.0 - 0.4 * scene.refine(scene.shape))
    scene.truth["L"] = (0.7 * lag, 1.3 * lag)


# Sensor


@kind("sensor")
def saturated(scene: Scene) -> None:
    """The logger cuts y off."""
    share = scene.random.uniform(0.7, 0.88)
    scene.log = lambda log: log | {"y": np.minimum(log["y"], np.quantile(log["y"], share))}


@kind("sensor actuator")
def saturated_noisy(scene: Scene) -> None:
    """The sensor is at its limit, and noise comes after it."""
    share = scene.random.uniform(0.7, 0.88)
    scene.sensor = lambda y: np.minimum(y, np.quantile(y, share))


@kind("sensor noise reading variance", group="dirty")
def quantised_output(scene: Scene) -> None:
    """Y comes in steps of about its noise or more."""

    def round_off(log: Logged) -> Logged:
        grid = spread(log["y"]) * scene.random.uniform(0.05, 0.3)
        return log | {"y": np.round(log["y"] / grid) * grid}

    scene.log = round_off


@kind("sensor noise variance")
def sensor_dropouts(scene: Scene) -> None:
    """Some samples are zero or far away."""

    def drop(log: Logged) -> Logged:
        y = log["y"].copy()
        bad = scene.random.random(y.size) < scene.random.uniform(0.01, 0.04)
        y[bad] = np.min(y) - scene.random.uniform(0.5, 3.0) * np.ptp(y)
        return log | {"y": y}

    scene.log = drop


@kind("sensor reading variance structure")
def stale_samples(scene: Scene) -> None:
    """The sensor answers only each 3rd to 6th sample; the value is repeated."""
    every = int(scene.random.integers(3, 7))
    scene.log = lambda log: log | {"y": hold_values(log["y"], every)}


@kind("sensor reading variance")
def deadband_sensor(scene: Scene) -> None:
    """A historian stores y only if it has changed enough, and repeats it else."""

    def store(log: Logged) -> Logged:
        y, band = log["y"].copy(), spread(log["y"]) * scene.random.uniform(0.15, 0.4)
        for k in range(1, y.size):
            if abs(y[k] - y[k - 1]) < band:
                y[k] = y[k - 1]
        return log | {"y": y}

    scene.log = store


@kind("sensor actuator structure")
def sensor_curve(scene: Scene) -> None:
    """The sensor's characteristic bends by a fifth to a third."""
    bend = scene.random.uniform(0.2, 0.35) * scene.random.choice([-1.0, 1.0])

    def curve(y: FloatArray) -> FloatArray:
        middle, half = 0.5 * (np.max(y) + np.min(y)), 0.5 * np.ptp(y)
        z = (y - middle) / half
        return middle + half * (z + bend * (z**2 - 1.0))

    scene.sensor = curve


@kind("actuator sensor structure input", drives=HELD)
def crosstalk(scene: Scene) -> None:
    """A part of u stands in y at once."""
    share = scene.random.uniform(0.08, 0.2)

    def add(log: Logged) -> Logged:
        return log | {"y": log["y"] + share * spread(log["y"]) / spread(log["u"]) * log["u"]}

    scene.log = add


def shift_from(scene: Scene, change: Callable[[FloatArray], FloatArray]) -> None:
    """Change what is logged of y from a moment on."""
    moment = draw_moment(scene, 0.35, 0.75)
    scene.log = lambda log: log | {"y": np.where(log["t"] > moment, change(log["y"]), log["y"])}


@kind("sensor constancy")
def unit_jump(scene: Scene) -> None:
    """Y changes its unit from degrees C to degrees F."""
    shift_from(scene, lambda y: 1.8 * y + 32.0)


@kind("sensor constancy", plants=PROCESSES)
def sensor_gain_jump(scene: Scene) -> None:
    """The range of the sensor is switched."""
    factor = scene.random.choice([0.5, 0.8, 1.3, 2.0])
    shift_from(scene, lambda y: factor * y)


@kind("sensor constancy noise structure")
def sensor_drift(scene: Scene) -> None:
    """Y drifts along a straight line."""
    share = scene.random.uniform(0.5, 1.5) * scene.random.choice([-1.0, 1.0])
    scene.log = lambda log: (
        log | {"y": log["y"] + share * spread(log["y"]) * log["t"] / log["t"][-1]}
    )


@kind("sensor constancy noise")
def sensor_step(scene: Scene) -> None:
    """Y gets an offset from a moment on."""
    share = scene.random.uniform(0.3, 1.0) * scene.random.choice([-1.0, 1.0])
    shift_from(scene, lambda y: y + share * spread(y))


@kind("sensor constancy")
def stuck_sensor(scene: Scene) -> None:
    """Y keeps its value for a while."""
    first = int(scene.count * scene.random.uniform(0.3, 0.7))
    length = int(scene.count * scene.random.uniform(0.08, 0.2))

    def stick(log: Logged) -> Logged:
        y = log["y"].copy()
        y[first : first + length] = y[first]
        return log | {"y": y}

    scene.log = stick


@kind("sensor structure reading")
def sensor_filter(scene: Scene) -> None:
    """The transmitter gives the mean over a time."""
    width = round(scene.random.uniform(0.4, 1.2) * scene.plant.slow / scene.plant.step)
    scene.sensor = lambda y: smooth_back(y, width)


@kind("sensor constancy noise")
def sensor_swap(scene: Scene) -> None:
    """Y has the wrong sign from a moment on, as after a change of the wiring."""
    moment = draw_moment(scene, 0.5, 0.8)

    def turn(log: Logged) -> Logged:
        return log | {
            "y": np.where(log["t"] > moment, 2.0 * np.mean(log["y"]) - log["y"], log["y"])
        }

    scene.log = turn


# Noise and disturbances


@kind("noise sensor variance", group="dirty")
def heavy_tails(scene: Scene) -> None:
    """Noise by Student's t with 2 to 3 degrees of freedom."""
    degrees = scene.random.uniform(2.0, 3.0)
    scene.noise = lambda clean, size: size * scene.random.standard_t(degrees, clean.size)


@kind("variance noise sensor", group="dirty")
def multiplicative(scene: Scene) -> None:
    """Noise grows with the distance from rest."""
    scene.noise = lambda clean, size: (
        2.0
        * size
        * (0.1 + np.abs(clean - clean[0]) / spread(clean))
        * scene.random.standard_normal(clean.size)
    )


@kind("variance noise constancy", group="dirty")
def variance_jump(scene: Scene) -> None:
    """The noise is several times larger from a moment on."""
    moment, factor = draw_moment(scene), scene.random.uniform(4.0, 10.0)
    scene.noise = lambda clean, size: (
        size
        * np.where(scene.times > moment, factor, 1.0)
        * scene.random.standard_normal(clean.size)
    )


@kind("noise sensor", group="dirty")
def random_walk(scene: Scene) -> None:
    """Y drifts at random."""

    def walk(clean: FloatArray, size: float) -> FloatArray:
        steps = scene.random.standard_normal(clean.size) / np.sqrt(clean.size)
        return 6.0 * size * np.cumsum(steps) + size * scene.random.standard_normal(clean.size)

    scene.noise = walk


@kind("noise input structure", group="dirty")
def periodic_load(scene: Scene) -> None:
    """A sine of y that no input explains."""
    period = scene.random.uniform(0.8, 4.0) * scene.plant.slow
    wave = np.sin(2.0 * np.pi * scene.times / period + scene.random.uniform(0.0, 6.0))
    share = scene.random.uniform(2.0, 6.0)
    scene.noise = lambda clean, size: (
        size * (share * wave + scene.random.standard_normal(clean.size))
    )


@kind("noise input", group="dirty")
def aliasing(scene: Scene) -> None:
    """A fast hum appears as a slow one."""
    period = scene.plant.period * scene.random.uniform(1.03, 1.09)
    wave = np.sin(2.0 * np.pi * scene.times / period)
    scene.noise = lambda clean, size: size * (4.0 * wave + scene.random.standard_normal(clean.size))


def scale_load(scene: Scene, shape: FloatArray) -> FloatArray:
    """A load that would move the plant a quarter as much as its input."""
    plain = integrate(scene.plant, scene.plant.truth, [scene.refine(scene.input_values)])
    driven = integrate(
        scene.plant, scene.plant.truth, [scene.refine(scene.input_values)], load=shape
    )
    return shape * 0.25 * spread(plain) / spread(driven - plain)


@kind("noise input structure", drives=HELD)
def load_noise(scene: Scene) -> None:
    """Noise acts inside the plant."""
    shape = np.repeat(scene.random.standard_normal(scene.shape.size), FINE)
    scene.load = scale_load(scene, shape)


@kind("noise input structure constancy", drives=HELD)
def load_steps(scene: Scene) -> None:
    """An unmeasured load changes now and then."""
    scene.load = scale_load(
        scene,
        np.repeat(draw_steps(scene.random, scene.shape.size, scene.plant, rest=20), FINE),
    )


@kind("noise input constancy sensor", drives=HELD)
def load_pulse(scene: Scene) -> None:
    """One unmeasured pulse acts inside the plant."""
    begin = draw_moment(scene)
    within = (scene.clock > begin) & (scene.clock < begin + 2.0 * scene.plant.slow)
    scene.load = 2.0 * scale_load(scene, within.astype(float))


# Closed loops


def close_loop(scene: Scene, target: FloatArray, strength: float) -> None:
    """Control y by a proportional and integral controller with noise in what it sees."""
    plant, total = scene.plant, scene.shape.size
    gain = plant.truth.get("K", 1.0) if plant.name != "ipdt" else plant.truth["K"] * plant.slow
    proportional = strength * plant.slow / (plant.truth["L"] + 0.3 * plant.slow) / gain
    level = float(plant.rest((plant.base,), plant.truth)[-1]) + plant.truth.get("y0", 0.0)
    size = abs(gain) * plant.span / scene.snr
    noise = scene.random.standard_normal(total) * size
    sums = [0.0]

    def control(k: int, y: float) -> float:
        error = level + target[k] * abs(gain) * plant.span - (y + noise[k])
        if plant.name != "ipdt":
            sums[0] += proportional * error * plant.period / (2.0 * plant.slow)
        return plant.base + proportional * error + sums[0]

    scene.control = control
    scene.noise = lambda clean, _: noise[: clean.size]


@kind(
    "noise input record search feedback",
    plants=("fopdt", "sopdt", "ipdt"),
    drives=("steps",),
    detectable="always",
)
def loop_without_dither(scene: Scene) -> None:
    """A loop that only a load and noise move."""
    close_loop(scene, np.zeros(scene.shape.size), 0.35)
    load = 0.0
    walk = np.zeros(scene.shape.size)
    for k in range(walk.size):
        load = 0.98 * load + 0.2 * scene.random.standard_normal()
        walk[k] = load
    rate = 0.3 * scene.plant.span / scene.plant.slow
    scene.load = np.repeat(walk, FINE) * rate


@kind(
    "noise input record feedback",
    group="dirty",
    plants=PROCESSES,
    drives=("steps",),
    detectable="always",
)
def loop_with_dither(scene: Scene) -> None:
    """A loop with changes of its set point."""
    close_loop(scene, scene.shape.copy(), 0.3)


@kind(
    "noise input record search feedback",
    group="dirty",
    plants=PROCESSES,
    drives=("steps",),
    detectable="always",
)
def loop_relay(scene: Scene) -> None:
    """A relay with hysteresis keeps y about its target."""
    plant = scene.plant
    gain = plant.truth["K"] * (plant.slow if plant.name == "ipdt" else 1.0)
    level = float(plant.rest((plant.base,), plant.truth)[-1]) + plant.truth.get("y0", 0.0)
    band, state = 0.05 * abs(gain) * plant.span, [1.0]

    def control(k: int, y: float) -> float:
        error = (y - level) * np.sign(gain)
        if error > band:
            state[0] = -1.0
        elif error < -band:
            state[0] = 1.0
        return plant.base + plant.span * (state[0] if k > 5 else 0.0)

    scene.control = control


# Actuator


@kind("actuator", drives=MANY)
def input_limit(scene: Scene) -> None:
    """The actuator ends at a part of its range."""
    edge = scene.plant.base + scene.random.uniform(0.2, 0.5) * scene.plant.span
    scene.actuator = lambda u: np.minimum(u, edge)


@kind("actuator structure", drives=HELD)
def rate_limit(scene: Scene) -> None:
    """The actuator moves at a limited rate."""
    most = scene.plant.span / (scene.random.uniform(0.7, 2.0) * scene.plant.slow)

    def move(u: FloatArray) -> FloatArray:
        out, now, step = np.empty_like(u), float(u[0]), most * scene.plant.step
        for k, wanted in enumerate(u.tolist()):
            now += min(max(wanted - now, -step), step)
            out[k] = now
        return out

    scene.actuator = move


@kind("actuator", drives=MANY)
def backlash(scene: Scene) -> None:
    """The actuator has play."""
    half = scene.random.uniform(0.15, 0.35) * scene.plant.span

    def play(u: FloatArray) -> FloatArray:
        out, now = np.empty_like(u), float(u[0])
        for k, wanted in enumerate(u.tolist()):
            now = min(max(now, wanted - half), wanted + half)
            out[k] = now
        return out

    scene.actuator = play


@kind("actuator", plants=(*PROCESSES, "feedback", "cooler"), drives=MANY)
def dead_zone(scene: Scene) -> None:
    """Small inputs do nothing."""
    half = scene.random.uniform(0.2, 0.4) * scene.plant.span
    base = scene.plant.base
    scene.actuator = lambda u: base + np.sign(u - base) * np.maximum(np.abs(u - base) - half, 0.0)


@kind("actuator structure constancy", plants=(*PROCESSES, "cooler", "feedback"), drives=MANY)
def heat_and_cool(scene: Scene) -> None:
    """The gain of one direction is smaller than that of the other."""
    share, base = scene.random.uniform(0.45, 0.75), scene.plant.base
    scene.actuator = lambda u: np.where(u > base, u, base + share * (u - base))
    name = find_gain(scene.plant)
    scene.truth[name] = (scene.plant.truth[name], share * scene.plant.truth[name])


@kind("actuator structure sensor", plants=LEVELLING, drives=MANY)
def actuator_curve(scene: Scene) -> None:
    """The valve's characteristic bends."""
    base, span = scene.plant.base, scene.plant.span
    bend = scene.random.uniform(0.25, 0.45) * scene.random.choice([-1.0, 1.0])
    scene.actuator = lambda u: u + bend * span * (((u - base) / span) ** 2 - 1.0)


@kind("actuator constancy", drives=HELD)
def stuck_actuator(scene: Scene) -> None:
    """The actuator does not move for a while."""
    begin = int(scene.shape.size * FINE * scene.random.uniform(0.3, 0.6))
    length = int(scene.shape.size * FINE * scene.random.uniform(0.12, 0.25))

    def stick(u: FloatArray) -> FloatArray:
        out = u.copy()
        out[begin : begin + length] = u[begin]
        return out

    scene.actuator = stick


# Inputs that are not what was logged


@kind("input", drives=HELD)
def input_noise(scene: Scene) -> None:
    """The logged input has noise of 10 to 30 %."""
    size = scene.random.uniform(0.1, 0.3) * spread(scene.input_values)
    noise = scene.random.standard_normal(scene.count) * size
    scene.log = lambda log: log | {"u": log["u"] + noise}


@kind("input", drives=("smooth",))
def input_noise_smooth(scene: Scene) -> None:
    """The logged input is smooth but for noise of 10 to 30 %."""
    input_noise(scene)


@kind("input reading", drives=("steps", "smooth"))
def quantised_input(scene: Scene) -> None:
    """The logged input is rounded to a sixth to a third of its range."""
    grid = 2.0 * scene.plant.span * scene.random.uniform(0.16, 0.3)
    scene.log = lambda log: log | {"u": np.round(log["u"] / grid) * grid}


def add_second_input(scene: Scene) -> FloatArray:
    """Let a second input act on y through a first-order part; return it."""
    other = draw_steps(scene.random, scene.shape.size, scene.plant, rest=10)
    pole = np.exp(-scene.plant.step / (0.7 * scene.plant.slow))
    moved = lfilter([1.0 - pole], [1.0, -pole], scene.refine(other))
    share = scene.random.uniform(0.3, 0.7)
    scene.sensor = lambda y: y + share * spread(y) / spread(moved) * np.r_[moved, moved[-1]]
    return other[scene.before :]


@kind("structure input noise", drives=HELD)
def missing_input(scene: Scene) -> None:
    """A second input acts, and is not recorded."""
    add_second_input(scene)


@kind("structure input", drives=HELD)
def missing_input_recorded(scene: Scene) -> None:
    """A second input acts and is recorded, but the model does not have it."""
    other = add_second_input(scene)
    scene.log = lambda log: log | {"w": other}


@kind(
    "record search input history reading",
    plants=("fopdt", "tank", "valve"),
    drives=("steps",),
    detectable="always",
)
def periodic_input(scene: Scene) -> None:
    """Cut from a longer record under an exactly periodic input."""
    every = max(6, round(scene.random.uniform(1.5, 3.0) * scene.plant.slow / scene.plant.period))
    scene.before = 12 * every
    wave = np.arange(scene.before + 400) % every < 0.4 * every
    scene.shape = np.where(wave, 0.8, -0.6)


# Reading


def take_means(scene: Scene, shift: float) -> Callable[[FloatArray], FloatArray]:
    """Read means over a sampling period that ends at the stamp plus `shift` periods."""

    def take(fine: FloatArray) -> FloatArray:
        return scene.read_at(
            np.r_[fine[0], smooth_back(fine, FINE)][: scene.clock.size],
            scene.times + shift * scene.plant.period,
        )

    return take


def switch_early(scene: Scene) -> Callable[[FloatArray], FloatArray]:
    """Let each step of the input come before the sample that shows it, by less than a period."""
    early = scene.random.integers(0, FINE, scene.shape.size)

    def switch(u: FloatArray) -> FloatArray:
        out = u.copy()
        for k in np.flatnonzero(np.diff(u)) + 1:
            out[k - early[k // FINE] : k] = u[k]
        return out

    return switch


@kind("reading input", drives=("steps",), detectable="always")
def block_means(scene: Scene) -> None:
    """The log has means of both channels, and the input switches at any time."""
    shift = float(scene.random.choice([0.0, 1.0]))
    scene.sample = take_means(scene, shift)
    scene.actuator = switch = switch_early(scene)
    scene.sample_input = lambda u: take_means(scene, shift)(np.r_[switch(u), u[-1]])


@kind("reading clocks structure", drives=("steps", "prbs", "smooth"))
def block_mean_start(scene: Scene) -> None:
    """Y is the mean over the period that begins at its stamp."""
    scene.sample = take_means(scene, 1.0)


@kind("reading clocks structure", drives=("steps", "prbs", "smooth"))
def block_mean_end(scene: Scene) -> None:
    """Y is the mean over the period that ends at its stamp."""
    scene.sample = take_means(scene, 0.0)


@kind("reading input clocks", drives=("steps", "prbs"))
def switched_between_samples(scene: Scene) -> None:
    """The input switches between two samples."""
    scene.actuator = switch_early(scene)


@kind("reading record noise structure", drives=("steps", "smooth"), detectable="always")
def resampled(scene: Scene) -> None:
    """The log was interpolated to a denser grid."""
    dense = scene.plant.period / scene.random.uniform(1.7, 3.3)

    def interpolate(log: Logged) -> Logged:
        times = dense * np.arange(int(log["t"][-1] / dense))
        return {"t": times} | {
            key: np.interp(times, log["t"], one) for key, one in log.items() if key != "t"
        }

    scene.log = interpolate


@kind("reading record noise sensor variance", drives=("steps", "smooth"), detectable="always")
def repeated_rows(scene: Scene) -> None:
    """Each row is written three times, at its own stamp."""

    def repeat(log: Logged) -> Logged:
        return {"t": scene.plant.period / 3.0 * np.arange(3 * scene.count)} | {
            key: np.repeat(one, 3) for key, one in log.items() if key != "t"
        }

    scene.log = repeat


@kind("reading", drives=("steps",))
def lines_drawn_as_steps(scene: Scene) -> None:
    """The input moves along straight lines, and is logged at the corners only."""
    every = int(scene.random.integers(3, 6))
    corners = np.arange(0, scene.shape.size + every, every)
    levels = np.r_[scene.shape[0], scene.random.uniform(-1.0, 1.0, corners.size - 1)]
    scene.shape = np.interp(np.arange(scene.shape.size), corners, levels)
    scene.held = False
    scene.log = lambda log: log | {"u": hold_values(log["u"], every)}


# Structure


def use_process(scene: Scene, model: str, *names: str) -> None:
    """Fit another model of the catalogue; only these parameters keep their truth."""
    scene.model = model
    scene.truth = {name: scene.truth[name] for name in names}


@kind("structure", plants=("sopdt",), drives=DRIVES)
def missing_order(scene: Scene) -> None:
    """First order is fitted to two parts."""
    use_process(scene, "fopdt", "K", "L")


@kind("structure", plants=("sopdt",), drives=DRIVES)
def two_missing_orders(scene: Scene) -> None:
    """First order is fitted to three parts."""
    time = scene.random.uniform(0.3, 0.6) * scene.plant.slow
    pole = np.exp(-scene.plant.step / time)
    scene.sensor = lambda y: y[0] + lfilter([1.0 - pole], [1.0, -pole], y - y[0])
    use_process(scene, "fopdt", "K", "L")


@kind("structure", plants=("fopdt",), drives=DRIVES, group="dirty", detectable="always")
def too_high_order(scene: Scene) -> None:
    """Second order is fitted to first order: sound, but for what is not there."""
    scene.truth["T1"] = scene.truth["T"]
    use_process(scene, "sopdt", "K", "T1", "L")


def chain(scene: Scene, u: FloatArray, times: list[float], gain: float) -> FloatArray:
    """Response of first-order parts in a row, from rest."""
    x = gain * (u - u[0])
    for time in times:
        pole = np.exp(-scene.plant.step / time)
        x = np.r_[0.0, lfilter([1.0 - pole], [1.0, -pole], x)[:-1]]
    return np.r_[x, x[-1]] + gain * u[0] + scene.plant.truth.get("y0", 0.0)


@kind("structure", plants=("fopdt",), drives=DRIVES)
def diffusion(scene: Scene) -> None:
    """Twenty equal parts and no dead time."""
    times = [scene.plant.slow * 1.5 / 20.0] * 20
    scene.respond = lambda u: chain(scene, u, times, scene.plant.truth["K"])
    scene.truth["L"] = (0.0,)
    use_process(scene, "fopdt", "K", "L")


@kind("structure", plants=("fopdt",), drives=DRIVES)
def heat_rod(scene: Scene) -> None:
    """A diffusion line whose parts load each other: time constants go down as 1/k²."""
    times = [1.5 * scene.plant.slow / (2 * k - 1) ** 2 for k in range(1, 6)]
    scene.respond = lambda u: chain(scene, u, times, scene.plant.truth["K"])
    scene.truth["L"] = (0.0,)
    use_process(scene, "fopdt", "K", "L")


def lag_input(scene: Scene, u: FloatArray, lag: float) -> FloatArray:
    """An input that is late by a time."""
    back = round(lag / scene.plant.step)
    return np.r_[np.full(back, u[0]), u][: u.size]


@kind("structure", plants=("fopdt", "sopdt"), drives=("steps", "prbs", "step"))
def non_minimum_phase(scene: Scene) -> None:
    """The response begins in the wrong direction."""
    plant = scene.plant
    slow, fast = plant.slow, scene.random.uniform(0.3, 0.6) * plant.slow
    back = scene.random.uniform(0.4, 0.9) * slow
    gain = plant.truth["K"]

    def respond(u: FloatArray) -> FloatArray:
        late = lag_input(scene, u, plant.truth["L"])
        share = (slow + back) / (slow - fast)  # partial fractions of (1 − back s)/(…)(…)
        first = chain(scene, late, [slow], gain)
        second = chain(scene, late, [fast], gain)
        return share * first + (1.0 - share) * second

    scene.respond = respond
    use_process(scene, plant.name, "K", "L")


@kind("structure", plants=("fopdt",), drives=("steps", "prbs", "step"))
def tube_line(scene: Scene) -> None:
    """A line with echoes at both ends."""
    plant, echo = scene.plant, scene.random.uniform(0.35, 0.6)

    def respond(u: FloatArray) -> FloatArray:
        total = sum(
            (1.0 - echo) * echo**k * (lag_input(scene, u, (2 * k + 1) * plant.truth["L"]) - u[0])
            for k in range(8)
        )
        return chain(scene, u[0] + total, [0.4 * plant.slow], plant.truth["K"])

    scene.respond = respond
    use_process(scene, "fopdt", "L")


@kind("structure", plants=("fopdt", "sopdt"), drives=DRIVES)
def oscillating(scene: Scene) -> None:
    """The plant swings; the model cannot."""
    plant = scene.plant
    w, damping = 1.2 / plant.slow, scene.random.uniform(0.15, 0.45)

    def respond(u: FloatArray) -> FloatArray:
        late = lag_input(scene, u, plant.truth["L"]) - u[0]
        h, x, v, out = plant.step, 0.0, 0.0, [0.0]
        for drive in (plant.truth["K"] * late).tolist():
            a = w * w * (drive - x) - 2.0 * damping * w * v
            x += h * v + 0.5 * h * h * a
            v += 0.5 * h * (a + w * w * (drive - x) - 2.0 * damping * w * (v + h * a))
            out.append(x)
        return np.array(out) + plant.truth["K"] * u[0] + plant.truth.get("y0", 0.0)

    scene.respond = respond
    use_process(scene, plant.name, "K", "L")


@kind("structure", plants=("fopdt",), drives=HELD)
def leaking_integrator(scene: Scene) -> None:
    """An integrator is fitted to a slow first order."""
    plant = scene.plant
    slow = scene.duration * scene.random.uniform(0.1, 0.4)
    scene.respond = lambda u: chain(
        scene, lag_input(scene, u - plant.base, plant.truth["L"]), [slow], plant.truth["K"]
    )
    scene.log = lambda log: log | {"u": log["u"] - plant.base}
    scene.truth["K"] = (plant.truth["K"] / slow,)
    use_process(scene, "ipdt", "K", "L")


@kind("structure", plants=("fopdt",), drives=("steps", "prbs", "step"))
def two_paths(scene: Scene) -> None:
    """A second path has another delay."""
    plant, share = scene.plant, scene.random.uniform(0.3, 0.5)
    other = plant.truth["L"] + scene.random.uniform(1.0, 2.0) * plant.slow

    def respond(u: FloatArray) -> FloatArray:
        near, far = lag_input(scene, u, plant.truth["L"]), lag_input(scene, u, other)
        return chain(scene, (1.0 - share) * near + share * far, [plant.slow], plant.truth["K"])

    scene.respond = respond
    use_process(scene, "fopdt", "L")


@kind("structure search record ambiguous combination", plants=("fopdt",), detectable="always")
def two_lags_sum(scene: Scene) -> None:
    """The model has two delays that only act as a sum."""
    plant = scene.plant
    scene.model = write_document(
        "two-lags",
        {"x": "(K*(u(t - L - M)) - x)/T"},
        {
            "K": (-20.0, 20.0),
            "T": (0.02 * plant.slow, 20.0 * plant.slow),
            "L": (0.0, 3.0 * plant.slow),
            "M": (0.0, 3.0 * plant.slow),
            "y0": (-200.0 * plant.span, 200.0 * plant.span),
        },
        output="x + y0",
        start=100.0 * plant.span,
    )
    lag = plant.truth["L"]
    scene.truth |= {"L": (0.0, lag), "M": (0.0, lag)}


@kind("structure search sensor record", plants=("fopdt",), detectable="always")
def sign_reversed(scene: Scene) -> None:
    """The model allows no gain of this sign."""
    plant = scene.plant
    scene.values |= {"K": -abs(plant.truth["K"])}
    scene.model = write_document(
        "positive",
        {"x": "(K*u(t - L) - x)/T"},
        {
            "K": (0.05, 20.0),
            "T": (0.02 * plant.slow, 20.0 * plant.slow),
            "L": (0.0, 5.0 * plant.slow),
            "y0": (-200.0 * plant.span, 200.0 * plant.span),
        },
        output="x + y0",
        start=100.0 * plant.span,
    )
    scene.truth["K"] = (scene.values["K"],)


@kind(
    "structure record input reading search",
    plants=("fopdt", "sopdt"),
    drives=HELD,
    detectable="always",
)
def swapped_channels(scene: Scene) -> None:
    """Input and output are exchanged."""
    scene.log = lambda log: {"t": log["t"], "u": log["y"], "y": log["u"]}


# Start and end of the record


@kind(
    "record start history search",
    plants=("fopdt", "tank", "valve"),
    drives=("step",),
    detectable="always",
)
def step_at_0(scene: Scene) -> None:
    """The step is made as the record begins: the logged input is constant."""
    scene.before = int(np.argmax(scene.shape != 0.0))


@kind(
    "record start history",
    group="dirty",
    plants=("fopdt", "tank"),
    drives=("step",),
    detectable="always",
)
def step_at_first_row(scene: Scene) -> None:
    """Only one sample is before the step."""
    scene.before = int(np.argmax(scene.shape != 0.0)) - 1


@kind(
    "record start structure search",
    plants=("fopdt", "sopdt"),
    drives=("smooth",),
    detectable="always",
)
def ramp_only(scene: Scene) -> None:
    """The input is one long ramp."""
    rest = int(2.0 * scene.plant.slow / scene.plant.period)
    scene.shape = np.maximum(np.arange(300) - rest, 0.0) / (300.0 - rest)


@kind("record search structure", plants=LEVELLING, drives=("step",), detectable="always")
def short_record(scene: Scene) -> None:
    """The record ends soon after the response has begun."""
    rest = int(np.argmax(scene.shape != 0.0))
    seen = (scene.plant.truth["L"] + 0.6 * scene.plant.slow) / scene.plant.period
    scene.shape = scene.shape[: rest + int(seen)]


@kind("history start", plants=(*LEVELLING, "tank", "valve"), drives=HELD)
def moving_before(scene: Scene) -> None:
    """The input moved before the record."""
    lag = round(scene.plant.truth["L"] / scene.plant.period)
    scene.before = lag + round(8.0 * scene.plant.slow / scene.plant.period)
    early = np.zeros(scene.before)
    early[-max(2, lag // 2) :] = scene.random.choice([-1.0, 1.0])
    early[: -max(2, lag // 2)] = scene.random.uniform(-1.0, 1.0)
    scene.shape = np.r_[early, scene.shape]


@kind("start history", plants=("fopdt", "cooler", "twin"), drives=HELD)
def not_at_rest(scene: Scene) -> None:
    """The model starts at zero; the plant does not."""
    plant = scene.plant
    bounds = {
        "K": (-20.0, 20.0),
        "T": (0.02 * plant.slow, 20.0 * plant.slow),
        "L": (0.0, 5.0 * plant.slow),
    }
    extra = {"fopdt": "", "cooler": " - q*x*abs(x)", "twin": " + M*v"}[plant.name]
    if plant.name == "cooler":
        bounds["q"] = (0.0, 10.0)
    if plant.name == "twin":
        bounds["M"] = (-20.0, 20.0)
    scene.model = write_document(
        "cold", {"x": f"(K*u(t - L) - x{extra})/T"}, bounds, inputs=plant.inputs, start=None
    )
    scene.values.pop("y0", None)
    scene.truth.pop("y0", None)
    scene.before = round(2.0 * plant.slow / plant.period) + 10
    early = np.full(scene.before, scene.random.choice([-1.0, 1.0]))
    early[-3:] = scene.shape[0]
    scene.shape = np.r_[early, scene.shape]
    if scene.second is not None:
        scene.second = np.r_[np.full(scene.before, scene.second[0]), scene.second]


@kind(
    "start record history",
    plants=(*LEVELLING, "valve", "cooler"),
    drives=("step",),
    detectable="always",
)
def short_rest(scene: Scene) -> None:
    """Two samples of rest before the step."""
    rest = int(np.argmax(scene.shape != 0.0))
    scene.before = rest - 2


@kind("start record structure", plants=("fopdt", "sopdt"), drives=("step",))
def two_records_joined(scene: Scene) -> None:
    """Two tests are written one after the other, without the rest between them."""
    lost = round(2.0 * scene.plant.slow / scene.plant.period)
    first = scene.shape
    scene.shape = np.r_[first, np.zeros(8 * lost), first]
    span = np.arange(first.size, first.size + 8 * lost)

    def join(log: Logged) -> Logged:
        kept = {key: np.delete(one, span) for key, one in log.items()}
        return kept | {"t": log["t"][: kept["t"].size]}

    scene.log = join


@kind("record", group="dirty")
def nan_blocks(scene: Scene) -> None:
    """Samples of y are missing."""

    def lose(log: Logged) -> Logged:
        y = log["y"].copy()
        for _ in range(4):
            start = int(scene.random.integers(10, y.size - 20))
            y[start : start + int(scene.random.integers(3, 15))] = np.nan
        return log | {"y": y}

    scene.log = lose


@kind("clocks record", detectable="never", plants=LEVELLING)
def minutes_called_seconds(scene: Scene) -> None:
    """Times are minutes, and nothing says so."""
    scene.log = lambda log: log | {"t": log["t"] / 60.0}
