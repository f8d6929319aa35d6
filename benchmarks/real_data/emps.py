"""EMPS (measured): a drive with Coulomb friction, free run on another test; asymmetric friction."""

from pathlib import Path
from typing import Any

from benchmarks.real_data.session import identify, print_estimates, program
from benchmarks.table import Row
from service.client.client import Client

TITLE = "EMPS, free run on the test with pulses"
SKIP = 20
SQUARES = {"loss": {"noise_model": "white"}}
ASYMMETRIC = ("Fp", "Fn", "o")
RIDGE = (20.5, 21.0, 21.5, 22.0, 22.5, 23.0)
"""Values of Fc (N) at which the others are estimated again, to show how flat the ridge is."""


def asymmetric(symmetric: dict[str, Any]) -> dict[str, Any]:
    """Return the catalogue's model with a friction level of its own for either direction."""
    parameters = dict(symmetric["parameters"])
    friction = parameters.pop("Fc")
    step = "h*F{}/(M + h*Fv)"
    return {
        **symmetric,
        "name": "emps-asymmetric",
        "parameters": {**parameters, "Fp": dict(friction), "Fn": dict(friction)},
        "equations": {
            **symmetric["equations"],
            "v": f"where(p > 0, max(p - {step.format('p')}, 0), min(p + {step.format('n')}, 0))",
        },
    }


def measure(client: Client, folder: Path) -> list[Row]:
    """Upload, identify, and identify with an offset that asymmetric friction makes redundant."""
    train, test = (
        client.add_dataset(folder / "emps" / f"emps_{part}.csv", name=f"EMPS {part}")["id"]
        for part in ("train", "test_pulses")
    )
    common = {"datasets": [train], "validation": {"datasets": [test]}, "skip": SKIP}
    run = identify(client, {**common, "name": "EMPS", "model": "emps"})
    print_estimates("EMPS, symmetric friction", run)
    rows = [
        Row("RMS, train", 1e3 * run["agreement"]["estimation"][0]["rms"], "mm"),
        Row("RMS, test", 1e3 * run["agreement"]["validation"][0]["rms"], "mm", 5.7),
    ]
    rows.append(Row("correlation time", run["correlation_times"].get("y", 0.0), "s"))
    squares = identify(client, {**common, **SQUARES, "name": "EMPS, squares", "model": "emps"})
    print_estimates("EMPS, symmetric friction, least squares", squares)
    rms = [1e3 * squares["agreement"][part][0]["rms"] for part in ("estimation", "validation")]
    rows += [
        Row("RMS, train, least squares", rms[0], "mm"),
        Row("RMS, test, least squares", rms[1], "mm"),
    ]
    _print_ridge(client, common)
    document = asymmetric(client.model("emps")["document"])
    both = identify(client, {**common, "name": "EMPS, asymmetric friction", "model": document})
    print_estimates("EMPS, asymmetric friction and an offset", both)
    unidentified = [
        parameter["name"]
        for parameter in both["parameters"]
        if parameter["name"] in ASYMMETRIC and parameter["status"] in ("group", "unidentifiable")
    ]
    print("\npublished, mm: linear 5.53, pNARX 5.17, CT-SUBNET 4.61, best 2.64")
    rows.append(Row("of Fp, Fn and o reported as not identified", len(unidentified), "1", 3, ">="))
    return rows


def _print_ridge(client: Client, common: dict[str, Any]) -> None:
    print("\nalong the ridge of Fv and Fc (Fc given, the others estimated again)\n")
    print("| Fc, N | Fv, N·s/m | RMS train, mm | RMS test, mm |\n|--:|--:|--:|--:|")
    for level in RIDGE:
        fixed = {**common, **SQUARES, "parameters": {"Fc": {"fixed": level}}}
        run = identify(client, {**fixed, "name": "ridge", "model": "emps"})
        fv = next(
            parameter["value"] for parameter in run["parameters"] if parameter["name"] == "Fv"
        )
        rms = [1e3 * run["agreement"][part][0]["rms"] for part in ("estimation", "validation")]
        print(f"| {level:g} | {fv:.1f} | {rms[0]:.3f} | {rms[1]:.3f} |")


if __name__ == "__main__":
    program(TITLE, __doc__ or "", measure)
