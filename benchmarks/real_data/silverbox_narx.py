"""Silverbox (measured): a NARX polynomial of 13 selected terms, free run on three tests."""

from pathlib import Path
from typing import Any

from benchmarks.real_data.session import identify, print_estimates, program
from benchmarks.real_data.silverbox import ESTIMATION, PUBLISHED, TESTS
from benchmarks.table import Row
from service.client.client import Client

TITLE = "Silverbox, NARX, free run on the test parts"
BARS_MV = {"multisine": 0.28, "arrow": 0.41, "arrow, first 32,000": 0.28}
SECONDS = 120.0
MODEL: dict[str, Any] = {
    "name": "silverbox-narx",
    "title": "Cubic NARX of 13 terms out of 84",
    "form": "polynomial",
    "output": {"y": "V"},
    "inputs": {"u": "V"},
    "degree": 3,
    "constant": True,
    "lags": {"y": [1, 2, 3], "u": [0, 1, 2]},
    "coefficients": {"lower": -10, "upper": 10},
    "terms": {"select": "frols", "keep": 13},
}
# Each simulation has 65,062 steps, and the search would use up all of its 400 generations: nearly
# all random coefficients diverge, so it never finds the champion again from random places.
SEARCH = {"generations": 100}
SELECTIONS = {error: MODEL["terms"] | {"error": error} for error in ("one-step", "simulation")}


def measure(client: Client, folder: Path) -> list[Row]:
    """Upload, derive, identify with terms selected by each error, print."""
    raw = client.add_dataset(folder / "silverbox" / "silverbox_snls80mv.csv", name="silverbox")

    def part(name: str, rows: list[int]) -> str:
        return str(client.derive(raw["id"], [{"trim": {"rows": rows}}], name=name)["id"])

    tests = {name: part(f"silverbox {name}", rows) for name, rows in TESTS.items()}
    data = {
        "datasets": [part("silverbox estimation", ESTIMATION)],
        "validation": {"datasets": list(tests.values())},
        "skip": 50,
        "algorithm": SEARCH,
    }
    rows: list[Row] = []
    for error, terms in SELECTIONS.items():
        name = f"terms by the {error} error"
        body = {"name": f"silverbox-narx-{error}", "model": MODEL | {"terms": terms}, **data}
        run = identify(client, body)
        print_estimates(f"Silverbox, {name}, 65,062 samples", run)
        _print_selection(run)
        rows += _rows(name, list(tests), run)
    print(f"\n{PUBLISHED}")
    return rows


def _rows(name: str, tests: list[str], run: dict[str, Any]) -> list[Row]:
    rms = [1e3 * channel["rms"] for channel in run["agreement"]["validation"]]
    return [
        *(
            Row(f"{name}: RMS, {test}", value, "mV", BARS_MV[test])
            for test, value in zip(tests, rms, strict=True)
        ),
        Row(f"{name}: number of terms", len(run["selection"]), "1", 13),
        Row(f"{name}: run", run["seconds"], "s", SECONDS),
    ]


def _print_selection(run: dict[str, Any]) -> None:
    print("\n| term | error-reduction ratio | left unexplained | coefficient before the search |")
    print("|---|--:|--:|--:|")
    for term in run["selection"]:
        left = 1.0 - term["cumulated"]
        print(f"| {term['term']} | {term['err']:.3g} | {left:.3g} | {term['coefficient']:.6g} |")


if __name__ == "__main__":
    program(TITLE, __doc__ or "", measure)
