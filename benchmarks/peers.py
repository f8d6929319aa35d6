"""Compare the CPU time to the target: `improved` and the installed optimisers.

A0 and B0 are the paper's examples without noise. The others have noise of sd 0.01. A/300/1 and
B/300/1 are the paper's; 1500 samples or a time lag of up to 5 s make them harder. The target is
1.01 times the RMS of the record's least-squares optimum; without noise, the errors of the paper's
tables. All optimisers get the same records and 20,000 simulations; each has its own seeds.
Compilation is excluded. Counters of this program decide when the target is hit. A failed search
costs its whole time: the time per hit is the time of all searches over the number of hits.

lagid's time is counted in two ways. *Prorated*, as in the table of `bench/peers`: the time of a
whole search times the share of its simulations before the hit. *Direct*: a search that ends with
the generation of the hit, from the start to the run's state. Direct is longer for two reasons.
Costs that every search has once (plans, each island's first population) fall on few simulations.
The other islands also finish that generation. The peers stop at the simulation that hits, so their
time is direct.

Bars: the fastest peer of this run. On harder records: the fastest peer that hits in all runs.
"""

import argparse
from dataclasses import dataclass
from statistics import median

import numpy as np

from benchmarks.peer_searches import HAS_PYGMO, PEERS, run_peer
from benchmarks.robustness import FASTEST_PEER, Study, study
from benchmarks.systems import PAPER
from benchmarks.table import Row, Skipped, parser, report

FIRST_SEED = 90_000
"""Of these searches; robustness has others."""

EASY = ("A0", "B0", "A/300/1", "B/300/1")


@dataclass(frozen=True)
class Peer:
    """What one optimiser did on the records of one system."""

    name: str
    hits: int
    runs: int
    evaluations: float
    milliseconds: float

    @property
    def always_hits(self) -> bool:
        """Whether every run hit the target."""
        return self.hits == self.runs


def measure_peers(done: Study, first: int, count: int) -> list[Peer]:
    """Every installed peer on the first `count` records of a study."""
    peers = []
    for name in PEERS:
        run_peer(name, done.system, first, done.goals[0])  # compiles and warms
        runs = [run_peer(name, done.system, first + i, done.goals[i]) for i in range(count)]
        hits = [evaluations for evaluations, _ in runs if evaluations is not None]
        cost = 1e3 * sum(seconds for _, seconds in runs) / max(len(hits), 1)
        middle = median(np.inf if evaluations is None else evaluations for evaluations, _ in runs)
        peers.append(Peer(name, len(hits), count, middle, cost if hits else np.inf))
    return peers


def build_rows(done: Study, peers: list[Peer]) -> list[Row]:
    """Our figures against the fastest peer, then every peer's."""
    name, count = done.system.name, len(done.searches)
    able = [peer for peer in peers if peer.always_hits or name in EASY]
    best = min((peer.milliseconds for peer in able), default=np.inf)
    hits = sum(search.to_target is not None for search in done.searches)
    prorated, direct = done.milliseconds("prorated"), done.milliseconds("direct")
    rows = [
        Row(f"{name}: lagid, target hit", hits, f"of {count}", count, ">="),
        Row(f"{name}: lagid, median simulations to the target", done.to_target(), ""),
        Row(f"{name}: the same, islands side by side", done.side_by_side(), ""),
        Row(
            f"{name}: lagid, CPU to the target, prorated",
            prorated,
            "ms",
            best if np.isfinite(best) else None,
        ),
        Row(f"{name}: lagid, CPU to the target, direct", direct, "ms"),
    ]
    if name in FASTEST_PEER:
        published = FASTEST_PEER[name]
        rows.append(
            Row(f"{name}: fastest in bench/peers, on its machine, prorated", published, "ms")
        )
    for peer in peers:
        rows.append(Row(f"{name}: {peer.name}, target hit", peer.hits, f"of {peer.runs}"))
        if peer.hits:
            rows.append(Row(f"{name}: {peer.name}, median simulations", peer.evaluations, ""))
            rows.append(Row(f"{name}: {peer.name}, CPU to the target", peer.milliseconds, "ms"))
    return rows


def main(options: argparse.Namespace) -> None:
    """Measure and print."""
    count = options.searches or (5 if options.quick else 20)
    rows: list[Row] = []
    for system in PAPER:
        if options.quick and system.name not in EASY:
            continue
        done = study(system, count, FIRST_SEED)
        rows += build_rows(done, measure_peers(done, FIRST_SEED, count))
    reason = "pip install -r benchmarks/requirements-peers.txt"
    skipped = [] if HAS_PYGMO else [Skipped("pygmo de1220, sade, cmaes", reason)]
    report("Beside other optimisers", rows, skipped, options)


if __name__ == "__main__":
    arguments = parser(__doc__ or "")
    arguments.add_argument("--searches", type=int, metavar="N", help="searches per optimiser (20)")
    main(arguments.parse_args())
