"""Keep the answers to 200 identifications, and compare them with those of another version.

    python -m benchmarks.corpus --write FOLDER      before a change
    python -m benchmarks.corpus --compare FOLDER    after it; exits 1 if an answer differs

An answer is the document of the result with its verdict and warnings, and the printed summary. The
last bits of numbers depend on the processor, so both are made on one machine. A field that only one
side has is counted under its name; `--expect FIELD` allows it.

The records are those on which much can be said: sound ones, and such with a defect in the sensor,
the actuator, the clock, the plant or the noise. The models are those of the catalogue and own ones.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.systems import OTHERS, PAPER
from lagid import GeneticAlgorithm, Identification, Loss, Noise, identify, simulate
from service.jobs.stored_results import write_result_document
from sysid.core.types import FloatArray

Table = dict[str, FloatArray]
SEEDS = (81_101, 81_102, 81_103)
_SAMPLES, _PERIOD, _FINE = 400, 0.5, 50


@dataclass(frozen=True)
class Case:
    """One identification: its name, model, record or records, and options of `identify`."""

    name: str
    model: Any
    record: Any
    options: dict[str, Any] = field(default_factory=dict)


def draw_steps(random: np.random.Generator, rest: int = 20) -> FloatArray:
    """Draw an input of steps that each last 5 to 30 samples, after a rest."""
    u = np.zeros(_SAMPLES)
    start = rest
    while start < _SAMPLES:
        u[start:] = random.uniform(-1.0, 1.0)
        start += int(random.integers(5, 31))
    return u


def respond(u: FloatArray, gain: float, times: list[float], lag: FloatArray | float) -> FloatArray:
    """Response to a held input: dead time (s), first-order lags; a lag of 0 s integrates."""
    grid = np.arange(u.size * _FINE) * _PERIOD / _FINE
    index = np.floor((grid - np.broadcast_to(lag, grid.shape)) / _PERIOD + 1e-9).astype(int)
    x = gain * u[np.clip(index, 0, u.size - 1)]
    for time in times:
        pole = np.exp(-_PERIOD / _FINE / time) if time else 1.0
        share = 1.0 - pole if time else _PERIOD / _FINE
        y, out = x[0] if time else 0.0, np.empty_like(x)
        for k, value in enumerate(x.tolist()):
            out[k] = y
            y = pole * y + share * value
        x = out
    return x[::_FINE]


PROCESSES: dict[str, tuple[float, list[float], float]] = {
    "fopdt": (2.0, [4.0], 3.3),
    "sopdt": (1.5, [5.0, 2.0], 2.2),
    "ipdt": (0.3, [0.0], 4.7),
}
"""Gain, lags (s) and dead time (s) of the plants behind the records."""


def make_table(process: str, random: np.random.Generator) -> Table:
    """Make a sound record: steps, response, white noise of 1 % of the largest deviation."""
    u = draw_steps(random)
    y = respond(u, *PROCESSES[process])
    noise = 0.01 * np.abs(y).max() * random.normal(size=y.size)
    return {"t": np.arange(y.size) * _PERIOD, "u": u, "y": y + noise}


def _colour_noise(table: Table, random: np.random.Generator, pole: float) -> None:
    noise = random.normal(size=table["y"].size)
    for k in range(1, noise.size):
        noise[k] += pole * noise[k - 1]
    table["y"] += 0.01 * np.ptp(table["y"]) * noise


def _change_at(share: float) -> slice:
    return slice(int(share * _SAMPLES), None)


def spoil_lag(table: Table, random: np.random.Generator) -> None:
    """The dead time grows by 1.5 s at 60 % of the record."""
    grid = np.arange(_SAMPLES * _FINE)
    lag = np.where(grid < 0.6 * grid.size, 3.3, 4.8)
    y = respond(table["u"], 2.0, [4.0], lag)
    table["y"] = y + 0.02 * random.normal(size=y.size)


def spoil_unit(table: Table, _random: np.random.Generator) -> None:
    """The output changes its unit at 60 % of the record."""
    table["y"][_change_at(0.6)] = 32.0 + 1.8 * table["y"][_change_at(0.6)]


def spoil_gain(table: Table, _random: np.random.Generator) -> None:
    """The sensor's gain is 1.4 times as large from 55 % of the record on."""
    table["y"][_change_at(0.55)] *= 1.4


def spoil_drift(table: Table, _random: np.random.Generator) -> None:
    """The sensor drifts by half of the output's span."""
    table["y"] += 0.5 * np.ptp(table["y"]) * np.linspace(0.0, 1.0, _SAMPLES)


def spoil_limit(table: Table, _random: np.random.Generator) -> None:
    """The sensor is limited at 70 % of its largest value."""
    table["y"] = np.minimum(table["y"], 0.7 * table["y"].max())


def spoil_stuck(table: Table, _random: np.random.Generator) -> None:
    """The sensor holds one value for 60 samples."""
    table["y"][200:260] = table["y"][200]


def spoil_spikes(table: Table, random: np.random.Generator) -> None:
    """Twelve samples are far off."""
    at = random.choice(_SAMPLES, 12, replace=False)
    table["y"][at] += np.ptp(table["y"]) * random.uniform(1.0, 3.0, 12)


def spoil_step(table: Table, _random: np.random.Generator) -> None:
    """The output is rounded to steps of a twelfth of its span."""
    step = np.ptp(table["y"]) / 12.0
    table["y"] = step * np.round(table["y"] / step)


def spoil_rows(table: Table, _random: np.random.Generator) -> None:
    """Twenty rows were lost without a word."""
    keep = np.r_[:180, 200:_SAMPLES]
    for name in ("u", "y"):
        table[name] = table[name][keep]
    table["t"] = table["t"][: keep.size]


def spoil_input(table: Table, random: np.random.Generator) -> None:
    """The recorded input is noisy."""
    table["u"] = table["u"] + 0.3 * random.normal(size=_SAMPLES)


def spoil_start(table: Table, _random: np.random.Generator) -> None:
    """The record begins in the middle of a response."""
    for name in ("u", "y"):
        table[name] = table[name][75:]
    table["t"] = table["t"][:-75]


def spoil_loop(table: Table, random: np.random.Generator) -> None:
    """The input is the command of a proportional controller, sampled and held."""
    setpoint, x, lag = table["u"], 0.0, round(3.3 / _PERIOD * _FINE)
    u = np.zeros(_SAMPLES * _FINE)
    for k in range(_SAMPLES):
        table["y"][k] = x + 0.02 * random.normal()
        table["u"][k] = 0.6 * (setpoint[k] - table["y"][k])
        u[k * _FINE : (k + 1) * _FINE] = table["u"][k]
        for i in range(k * _FINE, (k + 1) * _FINE):
            past = u[i - lag] if i >= lag else 0.0
            x += _PERIOD / _FINE * (2.0 * past - x) / 4.0


def spoil_variance(table: Table, random: np.random.Generator) -> None:
    """The noise is ten times as large in the second half."""
    table["y"][_change_at(0.5)] += 0.1 * np.ptp(table["y"]) * random.normal(size=_SAMPLES // 2)


def colour_fast(table: Table, random: np.random.Generator) -> None:
    """The noise is of first order, with a correlation time of two samples."""
    _colour_noise(table, random, 0.6)


def colour_slow(table: Table, random: np.random.Generator) -> None:
    """The noise is of first order, with a correlation time of twenty samples."""
    _colour_noise(table, random, 0.95)


DEFECTS: dict[str, Callable[[Table, np.random.Generator], None] | None] = {
    "sound": None,
    "fast coloured noise": colour_fast,
    "slow coloured noise": colour_slow,
    "unit changes": spoil_unit,
    "gain changes": spoil_gain,
    "drift": spoil_drift,
    "limit": spoil_limit,
    "stuck": spoil_stuck,
    "spikes": spoil_spikes,
    "rounded": spoil_step,
    "rows lost": spoil_rows,
    "noisy input": spoil_input,
    "no rest": spoil_start,
    "variance": spoil_variance,
}


def list_defects() -> Iterator[Case]:
    """List every defect with every process."""
    for defect, spoil in DEFECTS.items():
        for process in PROCESSES:
            for seed in SEEDS:
                random = np.random.default_rng(seed)
                table = make_table(process, random)
                if spoil is not None:
                    spoil(table, random)
                yield Case(f"{defect}, {process}, {seed}", process, table, {"seed": seed})
    for name, spoil in (("lag changes", spoil_lag), ("sampled loop", spoil_loop)):
        for model in PROCESSES:
            random = np.random.default_rng(SEEDS[2])
            table = make_table("fopdt", random)
            spoil(table, random)
            yield Case(f"{name}, {model}", model, table)


def list_wrong_models() -> Iterator[Case]:
    """List records whose plant is not the model, and one without information."""
    for process, model in (("sopdt", "fopdt"), ("fopdt", "sopdt"), ("fopdt", "ipdt")):
        for seed in SEEDS:
            table = make_table(process, np.random.default_rng(seed))
            yield Case(f"{process} as {model}, {seed}", model, table, {"seed": seed})
    still = {"t": np.arange(200.0), "u": np.ones(200), "y": np.full(200, 0.3)}
    yield Case("constant record", "fopdt", still)


OPTIONS: dict[str, dict[str, Any]] = {
    "validation": {"validation_fraction": 0.3},
    "posterior": {"posterior": True},
    "one step ahead": {"prediction": "one-step"},
    "soft loss": {"loss": Loss("soft-l1", 0.05)},
    "white": {"loss": Loss(noise_model="white")},
    "ar1": {"loss": Loss(noise_model="ar1")},
    "skip": {"skip": 40},
    "held": {"hold": {"u": "zero"}},
    "straight lines": {"hold": {"u": "first"}},
    "at a bound": {"parameters": {"L": (0.0, 1.0)}},
    "fixed": {"parameters": {"K": 2.0}},
    "tied": {"parameters": {"T": {"tied": "1.2*L"}}},
    "logarithmic": {"parameters": {"T": {"lower": 0.1, "upper": 50.0, "scale": "log"}}},
    "added noise": {"noise": Noise(sigma=0.2, seed=3)},
    "one order": {"compare_orders": False},
    "warm": {"warm": {"K": 2.0, "T": 4.0, "L": 3.3}},
    "small search": {"settings": GeneticAlgorithm(population=16, generations=5)},
    "simple": {"settings": GeneticAlgorithm("simple", 40, 40)},
    "the paper's": {"settings": GeneticAlgorithm("improved-paper", 40, 40)},
    "no refinement": {"settings": GeneticAlgorithm(refine=False, generations=20)},
    "one island": {"settings": GeneticAlgorithm(islands=1)},
}


def list_options() -> Iterator[Case]:
    """List every option of `identify` on two records, and several records at once."""
    for option, options in OPTIONS.items():
        for seed in SEEDS[:2]:
            table = make_table("fopdt", np.random.default_rng(seed))
            yield Case(f"{option}, {seed}", "fopdt", table, options)
    tables = [make_table("fopdt", np.random.default_rng(seed)) for seed in SEEDS]
    yield Case("three records", "fopdt", tables)
    yield Case("three records, weighted", "fopdt", tables, {"weights": {"y": [1, 0.5, 0.1]}})
    yield Case("a record for validation", "fopdt", tables[:2], {"validation": tables[2]})


TWO_LAGS = """
form: differential
inputs: {u: V}
states: {p: '1', q: '1'}
parameters:
  a: {lower: 0.1, upper: 5, unit: 1/s}
  b: {lower: 0, upper: 5, unit: 1/s}
  c: {lower: 0.1, upper: 5, unit: 1/s}
  d: {lower: 0, upper: 5, unit: 1/s}
  L1: {lower: 0, upper: 4, unit: s}
  Lu: {lower: 0, upper: 4, unit: s}
equations:
  p: -a*p + b*q(t - L1)/(1 + q**2) + u(t - Lu)
  q: -c*q + d*p
outputs: {y: p, z: q}
initial: {p: 0, q: 0}
"""
NOT_APART = """
form: differential
inputs: {u: V}
states: {x: V}
parameters:
  k1: {lower: 0, upper: 5, unit: '1'}
  k2: {lower: 0, upper: 5, unit: '1'}
  T: {lower: 0.1, upper: 20, unit: s}
  L: {lower: 0, upper: 10, unit: s}
equations: {x: (k1*k2*u(t - L) - x)/T}
outputs: {y: x}
initial: {x: 0}
"""
UNUSED = """
form: differential
inputs: {u: V}
states: {x: V}
parameters:
  K: {lower: 0, upper: 5, unit: '1'}
  T: {lower: 0.1, upper: 20, unit: s}
  L: {lower: 0, upper: 10, unit: s}
  far: {lower: 1, upper: 2, unit: '1'}
equations: {x: (K*u(t - L) - x)/T + 1e-12*far*x**3}
outputs: {y: x}
initial: {x: {lower: -2, upper: 2}}
"""
NARX = """
form: polynomial
output: y
inputs: {u: V}
degree: 2
lags: {y: [1, 2], u: [6, 7, 8]}
coefficients: {lower: -2, upper: 2}
terms: {select: frols, keep: 5}
"""


def list_models() -> Iterator[Case]:
    """List the catalogue's models on their own responses, and own models."""
    for system in (*PAPER, *OTHERS):
        for seed in SEEDS[:2]:
            options = {"parameters": system.parameters, "seed": seed}
            yield Case(f"{system.name}, {seed}", system.parsed, system.record(seed), options)
    for seed in SEEDS[:2]:
        table = make_table("fopdt", np.random.default_rng(seed))
        truth = {"a": 1.1, "b": 2.0, "c": 0.7, "d": 0.9, "L1": 0.63, "Lu": 0.35}
        two = _simulate_own(TWO_LAGS, truth, table, seed)
        yield Case(f"two lags, {seed}", _to_document(TWO_LAGS), two)
        yield Case(f"not apart, {seed}", _to_document(NOT_APART), table)
        yield Case(f"hardly felt, {seed}", _to_document(UNUSED), table)
        yield Case(f"selected terms, {seed}", _to_document(NARX), table)


def _to_document(text: str) -> dict[str, Any]:
    return {"name": "own", **yaml.safe_load(text)}


def _simulate_own(text: str, truth: dict[str, float], table: Table, seed: int) -> Table:
    """Simulate own equations on the input of a record, with noise of 1 % of the span."""
    random = np.random.default_rng(seed)
    inputs = {name: table[name] for name in ("t", "u")}
    outputs = {
        channel.name: np.asarray(channel.values)
        for channel in simulate(_to_document(text), inputs, truth).channels
    }
    noise = {name: 0.01 * np.ptp(y) * random.normal(size=y.size) for name, y in outputs.items()}
    return inputs | {name: y + noise[name] for name, y in outputs.items()}


def answer_case(case: Case) -> dict[str, Any]:
    """Identify a case and write down what is said of it; an error is an answer too."""
    try:
        found = identify(case.model, case.record, **case.options)
    except Exception as error:  # noqa: BLE001 - whatever a version says is compared
        return {"error": f"{type(error).__name__}: {error}"}
    return {"document": to_document(found), "summary": repr(found)}


def to_document(found: Identification) -> Any:
    """Write a result as the service stores it."""
    return json.loads(json.dumps(write_result_document(found, 0.0)))


def list_cases() -> list[Case]:
    """List all cases; their names are unique."""
    cases = [*list_defects(), *list_wrong_models(), *list_options(), *list_models()]
    assert len({case.name for case in cases}) == len(cases)
    return cases


def find_differences(before: Any, after: Any, pointer: str = "") -> Iterator[tuple[str, str]]:
    """Find where two documents differ: the pointer, and both values."""
    if isinstance(before, dict) and isinstance(after, dict):
        for name in [*before, *(name for name in after if name not in before)]:
            if name in before and name in after:
                yield from find_differences(before[name], after[name], f"{pointer}/{name}")
            else:
                yield f"{pointer}/{name}", "only before" if name in before else "only after"
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for number, pair in enumerate(zip(before, after, strict=True)):
            yield from find_differences(*pair, f"{pointer}/{number}")
    elif before != after or type(before) is not type(after):
        yield pointer, f"{_shorten(before)} became {_shorten(after)}"


def _shorten(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 120 else f"{text[:117]}…"


def main() -> None:
    """Write or compare the answers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--write", type=Path, metavar="FOLDER")
    parser.add_argument("--compare", type=Path, metavar="FOLDER")
    parser.add_argument("--expect", action="append", default=[], metavar="FIELD")
    options = parser.parse_args()
    if (options.write is None) == (options.compare is None):
        parser.error("give one of --write FOLDER and --compare FOLDER")
    answers = {case.name: answer_case(case) for case in list_cases()}
    verdicts = Counter(
        answer["document"]["verdict"]["trust"] if "document" in answer else "an error"
        for answer in answers.values()
    )
    print(f"{len(answers)} answers:", ", ".join(f"{n} {name}" for name, n in verdicts.items()))
    if options.write is not None:
        options.write.mkdir(parents=True, exist_ok=True)
        text = json.dumps(answers, ensure_ascii=False, indent=1)
        (options.write / "answers.json").write_text(text)
        return
    before = json.loads((options.compare / "answers.json").read_text())
    differences = [
        (pointer, text)
        for pointer, text in find_differences(before, answers)
        if not any(pointer.endswith(f"/{name}") for name in options.expect)
    ]
    for pointer, text in differences[:60]:
        print(f"{pointer}: {text}")
    changed = {pointer.split("/")[1] for pointer, _ in differences}
    print(f"{len(changed)} answers differ, in {len(differences)} places")
    sys.exit(bool(differences))


if __name__ == "__main__":
    main()
