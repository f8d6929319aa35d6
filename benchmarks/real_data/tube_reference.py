"""Tube of 5 to 80 m (gas-dynamic reference): the FOPDT table, and both patterns at 40 m."""

from pathlib import Path
from typing import Any

from benchmarks.real_data.session import identify_all, parameter, program
from benchmarks.table import Row
from service.client.client import Client

TITLE = "tube reference, first order plus dead time"
# Reference by least squares (T in s, L in s), patterns 1 and 2, printed to 0.1 ms.
REFERENCE = {
    5: ((0.0153, 0.0181), (0.0145, 0.0173)),
    10: ((0.0469, 0.0268), (0.0437, 0.0260)),
    20: ((0.1287, 0.0494), (0.1184, 0.0517)),
    40: ((0.3492, 0.1127), (0.3410, 0.1052)),
    80: ((0.9786, 0.2939), (0.9804, 0.2540)),
}
LAST_DIGIT = 1e-4


def measure(client: Client, folder: Path) -> list[Row]:
    """Upload, identify each record over REST in one job, print."""
    places = [(length, pattern) for length in REFERENCE for pattern in (1, 2)]
    sources = [
        folder / "tube_reference" / f"tube_{length:03d}m_pattern{pattern}.csv"
        for length, pattern in places
    ]
    sets = [client.add_dataset(source, name=source.stem)["id"] for source in sources]
    axis = {"path": "/datasets", "values": [[run] for run in sets]}
    body = {
        "name": "tube reference",
        "model": "tube",
        "datasets": [sets[0]],
        "channels": {"u": "P1_meas_Pa", "y": "P2_meas_Pa"},
        "sweep": {"axes": [axis]},
    }
    runs = dict(zip(places, identify_all(client, body), strict=True))
    _print_runs(runs)
    return [
        *(row for (length, pattern), run in runs.items() for row in _rows(length, pattern, run)),
        *_agreement(runs[40, 1], runs[40, 2]),
    ]


def _print_runs(runs: dict[tuple[int, int], dict[str, Any]]) -> None:
    print("\n| length, m | pattern | K | T, s | L, s | standard error of L, s | RMS, kPa |")
    print("|--:|--:|--:|--:|--:|--:|--:|")
    for (length, pattern), run in runs.items():
        gain, constant, lag = (parameter(run, name) for name in ("K", "T", "L"))
        print(
            f"| {length} | {pattern} | {gain['value']:.4f} | {constant['value']:.4f} "
            f"| {lag['value']:.4f} | {lag['stderr']:.2g} | {run['rms'] / 1e3:.1f} |"
        )


def _rows(length: int, pattern: int, run: dict[str, Any]) -> list[Row]:
    """Deviations from the reference, beyond what its printed digits leave open."""
    constant, lag = REFERENCE[length][pattern - 1]
    t = max(abs(parameter(run, "T")["value"] - constant) - LAST_DIGIT / 2, 0.0)
    off = max(abs(parameter(run, "L")["value"] - lag) - LAST_DIGIT / 2, 0.0)
    place = f"{length} m, pattern {pattern}"
    return [
        Row(f"{place}, T off the reference", 100 * t / constant, "%", 1.0),
        Row(f"{place}, L off the reference", 1e3 * off, "ms", 2.0),
    ]


def _agreement(first: dict[str, Any], second: dict[str, Any]) -> list[Row]:
    lags = [parameter(run, "L")["value"] for run in (first, second)]
    constants = [parameter(run, "T")["value"] for run in (first, second)]
    apart = abs(constants[0] - constants[1]) / (sum(constants) / 2)
    return [
        Row("40 m, L of both patterns apart", 1e3 * abs(lags[0] - lags[1]), "ms", 10.0),
        Row("40 m, T of both patterns apart", 100 * apart, "%", 3.0),
    ]


if __name__ == "__main__":
    program(TITLE, __doc__ or "", measure)
