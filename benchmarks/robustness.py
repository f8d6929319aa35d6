"""Measure how often the search reaches the optimum, on every system, and compare optimisers.

Each search has its own noise draw and seed. None of them was used to develop the search. The method
is `improved` with its defaults and a budget of 20,000 simulations. A search succeeds if its result
lies within 0.01 % of the RMS of the record's least-squares optimum (noise-free records: 0.01 % of
the output's RMS). SciPy computes the optimum from the true values and from the search's result; the
lower one counts.

The target is 1.01 times the optimum's RMS (noise-free: the errors of the paper's tables).
*Evaluations to the target* are counted in two ways. In order, as for the peers: all simulations of
one process until an individual reaches the target. This process evolves the islands one after the
other, from migration to migration. Side by side: the simulations of all islands up to the first
generation in which one of them reaches the target.

CPU time *to the target* is the time of a repetition that ends with this generation. The prorated
time is the time of a whole search times the share of its simulations before the target. Failures
cost their whole time. The time after the search (refinement, standard errors, residual tests) is
reported separately. The peers stop at the target and refine nothing, so their time is direct.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median
from time import perf_counter
from typing import Literal

import numpy as np

from benchmarks.peer_searches import HAS_PYGMO, PEERS, run_peer
from benchmarks.searches import NEAR, Goal, Search, search
from benchmarks.systems import OTHERS, PAPER, System
from benchmarks.table import Row, Skipped, parser, report
from sysid.core.settings import SEARCH_METHODS

FIRST_SEED = 95_000
"""No search with these seeds was looked at while the method was made."""

SLOW_PEERS = {"SciPy dual_annealing": 5, "SciPy differential_evolution": 10}
"""Searches at most of peers that take long, so that the whole ends within 40 minutes."""

PROTOTYPE = {
    "A/300/1": 241,
    "A/300/5": 236,
    "A/1500/1": 1219,
    "A/1500/5": 1798,
    "B/300/1": 255,
    "B/300/5": 660,
    "B/1500/1": 3622,
    "B/1500/5": 4390,
}
"""Median evaluations to the target of the prototype that the design describes."""

FASTEST_PEER = {"A0": 0.64, "A/300/1": 0.30, "B0": 0.76, "B/300/1": 2.5}
"""CPU time to the target (ms) of the fastest optimiser in `bench/peers`."""

OTHERS_PEERS = 1
"""Searches of each peer on the systems that are not the paper's."""


@dataclass(frozen=True)
class Study:
    """All searches of one system."""

    system: System
    first: int
    searches: tuple[Search, ...]
    goals: tuple[Goal, ...]

    @property
    def successes(self) -> int:
        """Searches whose result is the optimum."""
        return sum(result.distance <= NEAR for result in self.searches)

    @property
    def misses(self) -> list[int]:
        """Seeds of the others."""
        return [self.first + i for i, s in enumerate(self.searches) if s.distance > NEAR]

    def to_target(self) -> float:
        """Median evaluations to the target; searches that never got there count as infinite."""
        return _median([s.in_order for s in self.searches])

    def side_by_side(self) -> float:
        """The same of islands that evolve at the same time."""
        return _median([s.to_target for s in self.searches])

    def milliseconds(self, which: Literal["direct", "prorated"]) -> float:
        """CPU time per hit: that of all searches, failures in full, over the hits."""
        total, hits = 0.0, 0
        for result in self.searches:
            hits += result.to_target is not None
            if result.to_target is None:
                total += result.seconds
            else:
                total += result.seconds_to_target if which == "direct" else result.prorated
        return 1e3 * total / hits if hits else float("inf")


def _median(counts: list[int | None]) -> float:
    return median(np.inf if count is None else count for count in counts)


def study(system: System, count: int, first: int = FIRST_SEED) -> Study:
    """Search a system's records `count` times; the first search, which compiles, is repeated."""
    search(system, first)
    pairs = [search(system, first + i) for i in range(count)]
    return Study(system, first, tuple(s for s, _ in pairs), tuple(g for _, g in pairs))


def own_rows(done: Study) -> Iterable[Row]:
    """Figures of lagid on one system."""
    name, count = done.system.name, len(done.searches)
    yield Row(f"{name}: searches at the optimum", done.successes, f"of {count}", count, ">=")
    reached = [s.distance for s in done.searches if s.distance <= NEAR]
    yield Row(f"{name}: largest distance of these", max(reached, default=np.nan), "of RMS", NEAR)
    bar = PROTOTYPE.get(name)
    yield Row(f"{name}: median evaluations to the target", done.to_target(), "simulations", bar)
    parallel = done.side_by_side()
    yield Row(f"{name}: the same, islands side by side", parallel, "simulations")
    most = max(s.evaluations for s in done.searches)
    yield Row(f"{name}: most evaluations of a search", most, "simulations", 20_000)
    bar_ms = FASTEST_PEER.get(name)
    yield Row(f"{name}: CPU to target, prorated", done.milliseconds("prorated"), "ms", bar_ms)
    yield Row(f"{name}: CPU to target, direct", done.milliseconds("direct"), "ms")
    yield Row(
        f"{name}: searches that settled", sum(s.is_settled for s in done.searches), f"of {count}"
    )
    middle = median(s.evaluations for s in done.searches)
    yield Row(f"{name}: median evaluations of a whole search", middle, "simulations")
    yield Row(f"{name}: whole search", 1e3 * median(s.seconds for s in done.searches), "ms CPU")
    after = 1e3 * median(s.after for s in done.searches)
    yield Row(f"{name}: refinement, standard errors, tests", after, "ms CPU")


def peer_rows(done: Study, count: int) -> Iterable[Row]:
    """Figures of the peers on the same records."""
    most = min(count, len(done.searches))
    for peer in PEERS if most else ():
        count = min(most, SLOW_PEERS.get(peer, most))
        run_peer(peer, done.system, done.first, done.goals[0])
        runs = [run_peer(peer, done.system, done.first + i, done.goals[i]) for i in range(count)]
        hits = [evaluations for evaluations, _ in runs if evaluations is not None]
        seconds = sum(cost for _, cost in runs)
        yield Row(f"{done.system.name}: {peer}, target hit", len(hits), f"of {count}")
        if hits:
            middle = median(e or np.inf for e, _ in runs)
            yield Row(f"{done.system.name}: {peer}, median evaluations", middle, "simulations")
            cost = 1e3 * seconds / len(hits)
            yield Row(f"{done.system.name}: {peer}, CPU to target", cost, "ms")


def paper_rows(first: int, count: int) -> Iterable[Row]:
    """How the paper's two methods do beside `improved`, all as the search left them."""
    for system in PAPER[2:]:
        if system.samples > 300:
            continue
        for method in SEARCH_METHODS:
            searches = [search(system, first + i, method)[0] for i in range(count)]
            middle = median(1 + result.distance for result in searches)
            yield Row(f"{system.name}: {method}, median RMS", middle, "of the optimum's")


def main() -> None:
    """Print the table."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--peers", type=int, metavar="N", help="searches per peer (20)")
    arguments.add_argument("--searches", type=int, metavar="N", help="searches per system (50)")
    arguments.add_argument(
        "--first-seed", type=int, default=FIRST_SEED, metavar="N", help="first seed of every system"
    )
    options = arguments.parse_args()
    count, peers = (4, 1) if options.quick else (50, 20)
    count = options.searches or count
    peers = peers if options.peers is None else options.peers
    rows: list[Row] = []
    start = perf_counter()
    for system in (*PAPER, *OTHERS):
        done = study(system, count, options.first_seed)
        rows += own_rows(done)
        if done.misses:
            print(f"{system.name}: not at the optimum with seeds {done.misses}")
        if system in PAPER and (not options.quick or system.samples <= 300):
            rows += peer_rows(done, peers)
        elif not options.quick:  # there a peer's simulation is a call of lagid's kernel, and slow
            rows += peer_rows(done, min(peers, OTHERS_PEERS))
        figures = f"{done.successes} of {count} at the optimum, median {done.to_target():g}"
        print(f"{system.name}: {figures}, after {perf_counter() - start:.0f} s", flush=True)
    rows += paper_rows(options.first_seed, count)
    reason = "pip install -r benchmarks/requirements-peers.txt"
    skipped = [] if HAS_PYGMO else [Skipped("pygmo de1220, sade, cmaes", reason)]
    report("Robustness: is the optimum always reached?", rows, skipped, options)


if __name__ == "__main__":
    main()
