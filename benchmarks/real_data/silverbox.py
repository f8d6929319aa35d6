"""Silverbox (measured): a Duffing oscillator with a free input delay, free run on three tests."""

from pathlib import Path
from typing import Any

from benchmarks.real_data.session import identify, parameter, print_estimates, program
from benchmarks.table import Row
from service.client.client import Client

TITLE = "Silverbox, free run on the test parts"
ESTIMATION = [40650, 105712]  # the first 75 % of rows 40650:127400
TESTS = {"multisine": [105712, 127400], "arrow": [100, 40575], "arrow, first 32,000": [100, 32100]}
MODELS = {"silverbox": "6 parameters", "silverbox-9": "9 parameters"}
BARS_MV = {
    "silverbox": {"multisine": 0.31, "arrow": 0.39, "arrow, first 32,000": 0.32},
    "silverbox-9": {"multisine": 0.26, "arrow": 0.37, "arrow, first 32,000": 0.26},
}
PUBLISHED = (
    "published, mV: linear 6.96 / 14.4 / 6.58, polynomial NARX 0.640 / 2.25 / 0.571, "
    "best per column 0.36 / 0.26 / 0.32"
)


def measure(client: Client, folder: Path) -> list[Row]:
    """Upload, derive, identify both models on the whole estimation part, print."""
    raw = client.add_dataset(folder / "silverbox" / "silverbox_snls80mv.csv", name="silverbox")

    def part(name: str, rows: list[int], *, history: bool) -> str:
        steps: list[dict[str, Any]] = [
            {"trim": {"rows": rows, "history": history}},
            {"hold": {"u": "band-limited"}},
        ]
        name = f"silverbox {name}{'' if history else ' alone'}"
        return str(client.derive(raw["id"], steps, name=name)["id"])

    rows = []
    for history in (True, False):
        estimation = part("estimation", ESTIMATION, history=history)
        tests = [part(name, place, history=history) for name, place in TESTS.items()]
        for model, parameters in MODELS.items():
            words = parameters if history else f"{parameters}, input before the parts not used"
            run = identify(
                client,
                {
                    "name": f"{model}, {words}",
                    "model": model,
                    "datasets": [estimation],
                    "validation": {"datasets": tests},
                    "skip": 50,
                    "algorithm": {"generations": 60},  # each simulation has 130,124 steps
                },
            )
            print_estimates(f"Silverbox, {words}, 65,062 samples", run)
            rows += _rows(run, model, words)
    print(
        "\nthe input before a part goes with it, but where a row says that it is not used: the "
        "band-limited input between a part's first samples depends on it"
        f"\n{PUBLISHED}"
    )
    return rows


def _rows(run: dict[str, Any], model: str, words: str) -> list[Row]:
    rms = [1e3 * channel["rms"] for channel in run["agreement"]["validation"]]
    rows = [
        Row(f"RMS, {words}, {name}", value, "mV", bar)
        for (name, bar), value in zip(BARS_MV[model].items(), rms, strict=True)
    ]
    lag = parameter(run, "L")
    return [
        *rows,
        Row(f"L over its standard error, {words}", abs(lag["value"]) / lag["stderr"], "1", 1),
    ]


if __name__ == "__main__":
    program(TITLE, __doc__ or "", measure)
