"""Hair dryer PT326 (dryer2, measured): second order with dead time, validation on the last half."""

from benchmarks.real_data.session import (
    data_folder,
    identify,
    peak_memory_row,
    print_estimates,
    service,
)
from benchmarks.table import Row, Skipped, parser, report


def main() -> None:
    """Upload, derive, identify over REST, print."""
    options = parser(__doc__ or "").parse_args()
    folder = data_folder()
    if folder is None:
        report("dryer2", [], [Skipped("dryer2", "LAGID_DATA is absent")], options)
        return
    with service() as (client, _):
        raw = client.add_dataset(folder / "dryer2" / "dryer2.csv", name="dryer2")
        common = [
            {"offset": {"u": 5.0}},
            {"hold": {"u": "zero"}},
        ]
        first = client.derive(raw["id"], [{"trim": {"rows": [0, 500]}}, *common], name="dryer2 a")
        last = client.derive(raw["id"], [{"trim": {"rows": [500, 1000]}}, *common], name="dryer2 b")
        runs = {
            model: identify(
                client,
                {
                    "name": f"dryer2 {model}",
                    "model": model,
                    "datasets": [first["id"]],
                    "validation": {"datasets": [last["id"]]},
                },
            )
            for model in ("sopdt", "fopdt")
        }
    rows = []
    for model, run in runs.items():
        print_estimates(f"dryer2, {model}", run)
        bar = 85.0 if model == "sopdt" else None
        fit = run["fit_percent"]["validation"]
        rows.append(Row(f"validation fit, {model}", fit, "%", bar, ">="))
    print("\npublished: ARX(3,4,2) 85.9 %; first order + delay 82.3 %, second order + delay 85.5 %")
    rows.append(peak_memory_row())
    report("dryer2", rows, [], options)


if __name__ == "__main__":
    main()
