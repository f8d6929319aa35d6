"""Count how often the data are said to prefer a wrong order, and how often a missing part is found.

Plants are K e^(-Ls) and one or two first-order parts, with random values, input and noise. The
second time constant is 0.15 to 0.6 of the first. Records come from an integrator of their own, with
200 steps in a sampling period. Noise is white or AR(1), from 0.5 to 10 % of the output. Nothing is
set but the model.

The order is right where `fopdt` or `sopdt` has as many parts as the plant. A time constant is
missing where `fopdt` is fitted to a plant with two.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from benchmarks.table import Row, parser, report
from benchmarks.traps import make_record, respond
from sysid.core.types import FloatArray
from sysid.data.records import Record
from sysid.identification.identify import identify
from sysid.results.identification import Identification

DRAWS, QUICK = 60, 5
"""Plants of each kind and noise."""
FIRST_SEED = 91_000
WRONG_BAR, FOUND_BAR = 5.0, 90.0  # %
COVERED = 2.5  # standard errors


class Kind(NamedTuple):
    """Plants with so many parts, and the model that is fitted to them."""

    model: str
    parts: int
    is_coloured: bool

    @property
    def title(self) -> str:
        """What the table calls it."""
        noise = "AR(1) noise" if self.is_coloured else "white noise"
        return f"{self.model}, {self.parts} part{'s' if self.parts > 1 else ''}, {noise}"


def draw_noise(random: np.random.Generator, count: int, pole: float) -> FloatArray:
    """Draw AR(1) noise of unit variance; white with the pole 0."""
    values = random.standard_normal(count)
    for k in range(1, count):
        values[k] = pole * values[k - 1] + np.sqrt(1.0 - pole**2) * values[k]
    return values


def draw_record(random: np.random.Generator, kind: Kind) -> tuple[Record, float]:
    """Draw a plant and simulate its record; return the dead time too."""
    period, count = 0.2, int(random.integers(100, 801))
    slow, delay = random.uniform(1.0, 3.0), random.uniform(0.3, 2.0)
    times = [slow, random.uniform(0.15, 0.6) * slow][: kind.parts]
    held = random.integers(8, 40, count)
    u = np.repeat(random.uniform(-1.0, 1.0, count), held)[:count]
    u[:10] = 0.0
    clean = respond(u, period, delay, times, random.uniform(0.5, 3.0))
    pole = random.uniform(0.5, 0.9) if kind.is_coloured else 0.0
    size = 0.005 * 20.0 ** random.random() * float(np.std(clean))
    y = clean + size * draw_noise(random, count, pole)
    return make_record(period, u, y, ("V", "V")), delay


def identify_plants(kind: Kind, draws: int) -> Iterator[tuple[Identification, float]]:
    """Identify plants of a kind; yield the results with the true dead times."""
    for number in range(draws):
        seed = FIRST_SEED + number
        record, delay = draw_record(np.random.default_rng([seed, *map(int, kind[1:])]), kind)
        yield identify(kind.model, record, seed=seed), delay


def count_verdicts(kind: Kind, draws: int) -> Counter[str]:
    """Count the preferred models of a kind, and where the dead time is off."""
    counts: Counter[str] = Counter()
    for found, delay in identify_plants(kind, draws):
        compared = found.order_comparison
        verdict = "none" if compared is None else compared.preferred_model or "undecided"
        counts[verdict] += 1
        counts["warned"] += any(
            one.explanation == "order" and one.parameters for one in found.findings
        )
        own = found["L"]
        counts["own off"] += own.stderr is None or abs(own.value - delay) > COVERED * own.stderr
        if compared is not None:
            counts["all off"] += not any(
                fit.delay_stderr is not None
                and abs(fit.delay - delay) <= COVERED * fit.delay_stderr
                for fit in compared.open_fits
            )
    return counts


def main(options: argparse.Namespace) -> None:
    """Print the table."""
    draws, rows = QUICK if options.quick else DRAWS, []
    wrong = total = found = missing = 0
    for is_coloured in (False, True):
        for model, parts in (("fopdt", 1), ("sopdt", 2), ("fopdt", 2)):
            kind = Kind(model, parts, is_coloured)
            counts = count_verdicts(kind, draws)
            right = "fopdt" if parts == 1 else "sopdt"
            misled = draws - counts[right] - counts["undecided"] - counts["none"]
            if model == right:
                wrong, total = wrong + misled, total + draws
            else:
                found, missing = found + counts[right], missing + draws
            rows += [
                Row(f"{kind.title}: right order preferred", counts[right], f"of {draws}"),
                Row(f"{kind.title}: wrong order preferred", misled, f"of {draws}"),
                Row(f"{kind.title}: undecided", counts["undecided"], f"of {draws}"),
                Row(f"{kind.title}: not compared", counts["none"], f"of {draws}"),
                Row(f"{kind.title}: L told to depend on the order", counts["warned"], ""),
                Row(f"{kind.title}: L of the model off", counts["own off"], ""),
                Row(f"{kind.title}: L of all open orders off", counts["all off"], ""),
            ]
    rows += [
        Row(f"wrong order preferred, {total} right models", 100 * wrong / total, "%", WRONG_BAR),
        Row(
            f"missing time constant found, {missing} plants",
            100 * found / missing,
            "%",
            FOUND_BAR,
            ">=",
        ),
    ]
    report(f"Order of a process, {draws} plants each", rows, [], options)


if __name__ == "__main__":
    main(parser(__doc__ or "").parse_args())
