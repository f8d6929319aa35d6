"""Silverbox (measured): a Duffing oscillator with a free input lag, free run on three tests."""

from typing import Any

from benchmarks.real_data.session import (
    data_folder,
    identify,
    parameter,
    peak_memory_row,
    print_estimates,
    service,
)
from benchmarks.table import Row, Skipped, parser, report

ESTIMATION = [40650, 60650]  # 20,000 of the first 75 % of rows 40650:127400
TESTS = {"multisine": [105712, 127400], "arrow": [100, 40575], "arrow, first 32,000": [100, 32100]}
BARS_MV = {"multisine": 0.32, "arrow": 0.40, "arrow, first 32,000": 0.33}
PUBLISHED = (
    "published, mV: linear 6.96 / 14.4 / 6.58, polynomial NARX 0.640 / 2.25 / 0.571, "
    "best per column 0.36 / 0.26 / 0.32"
)


def main() -> None:
    """Upload, derive, identify over REST, print."""
    options = parser(__doc__ or "").parse_args()
    folder = data_folder()
    if folder is None:
        report("Silverbox", [], [Skipped("silverbox", "LAGID_DATA is absent")], options)
        return
    with service() as (client, _):
        raw = client.add_dataset(folder / "silverbox" / "silverbox_snls80mv.csv", name="silverbox")
        held = {"hold": {"u": "band-limited"}}

        def part(name: str, rows: list[int]) -> str:
            steps: list[dict[str, Any]] = [{"trim": {"rows": rows}}, held]
            return str(client.derive(raw["id"], steps, name=name)["id"])

        tests = {name: part(f"silverbox {name}", rows) for name, rows in TESTS.items()}
        run = identify(
            client,
            {
                "name": "silverbox",
                "model": "silverbox",
                "datasets": [part("silverbox estimation", ESTIMATION)],
                "validation": {"datasets": list(tests.values())},
                "skip": 50,
            },
        )
    print_estimates("Silverbox, 20,000 samples", run)
    print(f"\n{PUBLISHED}")
    rms = [1e3 * one["rms"] for one in run["agreement"]["validation"]]
    rows = [
        Row(f"RMS, {name}", value, "mV", BARS_MV[name])
        for name, value in zip(tests, rms, strict=True)
    ]
    lag = parameter(run, "L")
    rows.append(Row("|L| / standard error", abs(lag["value"]) / lag["stderr"], "1", 1.0))
    rows.append(peak_memory_row())
    report("Silverbox, free run on the test parts", rows, [], options)


if __name__ == "__main__":
    main()
