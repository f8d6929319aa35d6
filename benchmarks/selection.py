"""Select the terms of polynomials whose true terms are known, and count what is told of them.

Each draw has its own input, noise and search seed. Candidates are all products up to the degree, of
past values that reach beyond the true ones. Noise is white in the equation, or it is added to the
output: white, or coloured. A term is spurious if its true coefficient is zero.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import prod
from time import process_time
from typing import Any

import numpy as np

from benchmarks.table import Row, parser, report
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.parse import parse_model
from sysid.results.identification import Identification

SAMPLES, DRAWS, QUICK = 600, 10, 2
FIRST_SEED = 91_000
FAR = 4.0  # standard errors
_COLOUR = 0.9  # of coloured noise: correlation of neighbouring samples

Past = tuple[str, int]
Monomial = tuple[Past, ...]


@dataclass(frozen=True)
class System:
    """A stable polynomial: true coefficients by term, and what candidates are built of."""

    name: str
    truth: dict[Monomial, float]
    lags: dict[str, list[int]]
    degree: int = 2
    amplitude: float = 1.0
    hold: int = 1

    @property
    def inputs(self) -> list[str]:
        """Names of the inputs."""
        return [name for name in self.lags if name != "y"]


def _y(lag: int) -> Past:
    return ("y", lag)


def _u(lag: int, name: str = "u") -> Past:
    return (name, lag)


SYSTEMS = (
    System(
        "bilinear",
        {(_y(1),): 0.6, (_y(2),): -0.3, (_u(1),): 0.8, (_y(1), _u(2)): 0.3, (_u(1), _u(1)): -0.2},
        {"y": [1, 2, 3], "u": [1, 2, 3, 4]},
    ),
    System(
        "slow, held input",
        {(_y(1),): 1.3, (_y(2),): -0.42, (_u(3),): 0.12, (_y(1), _y(1)): -0.03},
        {"y": [1, 2, 3], "u": [1, 2, 3, 4]},
        hold=5,
    ),
    System(
        "cubic spring",
        {(_y(1),): 1.1, (_y(2),): -0.5, (_u(1),): 0.4, (_y(1), _y(1), _y(1)): -0.12},
        {"y": [1, 2], "u": [1, 2]},
        degree=3,
        amplitude=1.5,
    ),
    System(
        "two inputs",
        {
            (_y(1),): 0.7,
            (_u(1),): 0.5,
            (_u(2, "v"),): -0.4,
            (_u(1), _u(2, "v")): 0.3,
            (_y(1), _u(1, "v")): 0.15,
        },
        {"y": [1, 2], "u": [1, 2], "v": [1, 2]},
    ),
    System(
        "late input",
        {(_y(1),): 0.5, (_y(3),): -0.2, (_u(2),): 0.6, (_u(7),): 0.3, (_y(2), _u(2)): 0.2},
        {"y": [1, 2, 3], "u": [1, 2, 3, 4, 5, 6, 7, 8]},
    ),
    System(
        "nearly linear",
        {(_y(1),): 0.8, (_u(1),): 0.5, (_u(2),): -0.2, (_y(1), _u(1)): 0.03},
        {"y": [1, 2, 3], "u": [1, 2, 3]},
    ),
)

NOISES = ("equation", "output 100", "output 30", "output 10", "coloured 30")
"""Where noise enters, and the ratio of the deviations of the clean output and the noise."""


def write_term(term: Monomial) -> str:
    """The term as lagid writes it."""
    counts = {past: term.count(past) for past in term}
    ordered = sorted(counts, key=lambda past: (past[0] != "y", f"{past[0]}(k-{past[1]})"))
    return "*".join(
        f"{n}(k-{k})" + (f"**{c}" if (c := counts[n, k]) > 1 else "") for n, k in ordered
    )


def respond(system: System, inputs: dict[str, FloatArray], errors: FloatArray) -> FloatArray:
    """Output of the system, with errors in its equation."""
    first = max(lag for lags in system.lags.values() for lag in lags)
    signals = {name: [0.0] * first + values.tolist() for name, values in inputs.items()}
    errors = np.concatenate([np.zeros(first), errors])
    signals["y"] = y = [0.0] * errors.size
    for k in range(first, errors.size):
        y[k] = float(errors[k]) + sum(
            value * prod(signals[name][k - lag] for name, lag in term)
            for term, value in system.truth.items()
        )
    return np.array(y[first:])


def draw_record(system: System, noise: str, seed: int) -> Record:
    """A recording of the system with one kind of noise."""
    rng = np.random.default_rng(seed)
    count = -(-SAMPLES // system.hold)
    inputs = {
        name: np.repeat(rng.uniform(-1, 1, count), system.hold)[:SAMPLES] * system.amplitude
        for name in system.inputs
    }
    kind, _, ratio = noise.partition(" ")
    y = respond(system, inputs, np.zeros(SAMPLES))
    white = rng.standard_normal(SAMPLES)
    if kind == "equation":
        y = respond(system, inputs, 0.05 * np.std(y) * white)
    else:
        if kind == "coloured":
            for k in range(1, SAMPLES):
                white[k] = _COLOUR * white[k - 1] + np.sqrt(1 - _COLOUR**2) * white[k]
        y = y + np.std(y) / float(ratio) * white
    times = 0.1 * np.arange(SAMPLES)
    channels = (Channel(name, times, values, "V") for name, values in inputs.items())
    return Record(tuple(channels), (Channel("y", times, y, "V"),))


def write_document(system: System, terms: dict[str, Any]) -> dict[str, Any]:
    """The document of a polynomial with all candidates."""
    return {
        "name": "polynomial",
        "form": "polynomial",
        "output": {"y": "V"},
        "inputs": dict.fromkeys(system.inputs, "V"),
        "degree": system.degree,
        "lags": system.lags,
        "coefficients": {"lower": -3, "upper": 3},
        "terms": {"select": "frols", **terms},
    }


@dataclass
class Count:
    """What was told of the terms, over several draws."""

    draws: int = 0
    complete: int = 0
    spurious: int = 0
    spurious_identified: int = 0
    true_terms: int = 0
    true_found: int = 0
    true_identified: int = 0
    far_identified: int = 0
    trusted_wrong: int = 0
    trusted: int = 0
    fits: list[float] = field(default_factory=list)
    seconds: float = 0.0

    def add(self, system: System, found: Identification, fit: float, seconds: float) -> None:
        """Count one draw."""
        truth = {write_term(term): value for term, value in system.truth.items()}
        chosen = {term.term for term in found.selection}
        estimates = {one.name[2:-1]: one for one in found.parameters if one.name[:2] == "a["}
        identified = {name for name, one in estimates.items() if one.status == "identified"}
        wrong = identified - truth.keys()
        is_trusted = found.verdict.trust == "trustworthy"
        far = [
            name
            for name in identified
            if (stderr := estimates[name].stderr) is None
            or abs(estimates[name].value - truth.get(name, 0.0)) > FAR * stderr
        ]
        self.draws += 1
        self.complete += truth.keys() <= chosen
        self.spurious += len(chosen - truth.keys())
        self.spurious_identified += len(wrong)
        self.true_terms += len(truth)
        self.true_found += len(truth.keys() & chosen)
        self.true_identified += len(truth.keys() & identified)
        self.far_identified += len(far)
        self.trusted += is_trusted
        self.trusted_wrong += is_trusted and bool(wrong or far)
        self.fits.append(fit)
        self.seconds += seconds


def compute_fresh_fit(system: System, found: Identification, seed: int) -> float:
    """Fit (%) of the estimated polynomial to the true one, without noise, on another input."""
    rng = np.random.default_rng(seed + 7)
    inputs = {name: system.amplitude * rng.uniform(-1, 1, SAMPLES) for name in system.inputs}
    terms = {one.name[2:-1]: one.value for one in found.parameters if one.name[:2] == "a["}
    read = {write_term(term): term for term in list_monomials(system)}
    estimated = System("", {read[name]: value for name, value in terms.items()}, system.lags)
    true, again = (respond(one, inputs, np.zeros(SAMPLES)) for one in (system, estimated))
    return float(100 * (1 - np.linalg.norm(true - again) / np.linalg.norm(true - true.mean())))


def list_monomials(system: System) -> Iterator[Monomial]:
    """All candidates."""
    past = [(name, lag) for name, lags in system.lags.items() for lag in lags]

    def extend(term: Monomial, first: int, left: int) -> Iterator[Monomial]:
        if term:
            yield term
        if left:
            for i in range(first, len(past)):
                yield from extend((*term, past[i]), i, left - 1)

    yield from extend((), 0, system.degree)


def measure(
    noise: str, terms: dict[str, Any], draws: int, first_seed: int, systems: tuple[System, ...]
) -> Count:
    """Identify all systems with one kind of noise."""
    count = Count()
    for number, system in enumerate(systems):
        model = parse_model(write_document(system, terms))
        for draw in range(draws):
            seed = first_seed + 1000 * number + draw
            record, start = draw_record(system, noise, seed), process_time()
            found = identify(model, record, seed=seed)
            seconds = process_time() - start
            with np.errstate(over="ignore", invalid="ignore"):
                count.add(system, found, compute_fresh_fit(system, found, seed), seconds)
    return count


def main() -> None:
    """Print one row for each kind of noise and each rule."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--seed", type=int, default=FIRST_SEED)
    arguments.add_argument("--draws", type=int)
    arguments.add_argument("--error", help="the error of the rule, instead of the default")
    options = arguments.parse_args()
    draws = options.draws or (QUICK if options.quick else DRAWS)
    error = {} if options.error is None else {"error": options.error}
    rules = {"bic": {"criterion": "bic", "keep": 12}, "keep 8": {"keep": 8}}
    rows: list[Row] = []
    print(
        "| noise | rule | all true terms | true found | identified | spurious a draw "
        "| identified | far and identified | trusted | and wrong | fit, % | CPU s |\n"
        "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|"
    )
    for noise in NOISES:
        for name, rule in rules.items():
            one = measure(noise, rule | error, draws, options.seed, SYSTEMS)
            print(
                f"| {noise} | {name} | {one.complete}/{one.draws} "
                f"| {one.true_found / one.true_terms:.3f} "
                f"| {one.true_identified / one.true_terms:.3f} | {one.spurious / one.draws:.2f} "
                f"| {one.spurious_identified / one.draws:.2f} | {one.far_identified} "
                f"| {one.trusted} | {one.trusted_wrong} | {np.median(one.fits):.2f} "
                f"| {one.seconds / one.draws:.2f} |",
                flush=True,
            )
            label = f"{noise}, {name}"
            rows += [
                Row(f"{label}: all true terms", one.complete / one.draws, "1"),
                Row(f"{label}: spurious and identified", one.spurious_identified / one.draws, "1"),
            ]
    report("Terms of polynomials", rows, [], options)


if __name__ == "__main__":
    main()
