"""`lagid sweep noise`: errors of the estimates under noise, as one job and one table."""

from collections.abc import Mapping
from decimal import Decimal, InvalidOperation
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.common import (
    Document,
    FieldOrigins,
    ModelName,
    apply_setting,
    check_succeeded,
    fail_usage,
    out,
    parse_channels,
    parse_number,
    parse_pairs,
    print_job,
    print_json,
    print_note,
    print_table,
    read_model,
    report_faults,
    server_command,
    show_examples,
    split_names,
)
from service.cli.watch import follow_job
from service.core.bodies.job_fields import METHOD_PATH, SIGMA_PATH
from service.sweeps.group_cramer_rao import scale_to_median
from sysid.core.settings import SEARCH_METHODS
from sysid.core.text import RELATIVE_UNIT, append_unit

if TYPE_CHECKING:
    from service.client.client import Client


app = typer.Typer(
    help="Repeat an identification under noise: how far the estimates move.", no_args_is_help=True
)

MAX_SIGMA_VALUES = 100_000
RELATIVE_KEY = "relative"
# With a relative σ, rows show the typed value and the value in the output's unit.
GROUP_KEYS = {False: None, True: [RELATIVE_KEY, SIGMA_PATH, METHOD_PATH]}
RELATIVE_NOTE = "relative σ is in standard deviations of the output, σ is in the output's unit"
PARAMETERS_PER_TABLE = 4
LOW_INDEX, MEDIAN_INDEX, HIGH_INDEX = (
    0,
    2,
    4,
)  # places of 5, 50 and 95 % among the quantiles of a summary

NamedValues = list[str] | None
FIELD_ORIGINS = FieldOrigins(
    {
        "/model": "--model …",
        "/sigma": "--sigma",
        "/relative": "--relative",
        "/place": "--place",
        "/replicates": "--replicates",
        "/methods": "--methods",
        "/seed": "--seed",
        "/name": "--name",
        "/datasets": "--data",
        "/channels": "--channels {}",
        "/truth": "--true",
        "/truth/parameters": "--true {}",
        "/truth/inputs": "--input {}",
        "/truth/samples": "--samples",
        "/truth/sample_time": "--sample-time",
    }
)

Data = Annotated[
    str | None,
    typer.Option("--data", help="Datasets on the server: ids or names, separated by commas."),
]
Sigma = Annotated[
    list[str],
    typer.Option("--sigma", help="start:stop:step including stop, or numbers: 0,0.1,0.3."),
]
TrueParameters = Annotated[
    NamedValues,
    typer.Option(
        "--true", metavar="NAME=VALUE", help="True value of a parameter of the simulation."
    ),
]
Input = Annotated[
    NamedValues,
    typer.Option(
        "--input", metavar="NAME=EXPRESSION", help="Input as a function of t: 'q=10*cos(5*t)'."
    ),
]
Relative = Annotated[
    bool, typer.Option("--relative", help="σ is in standard deviations of the output.")
]
Place = Annotated[
    str, typer.Option(help="Where noise enters: sensor, or plant, as φ of the paper's recursion.")
]
Replicates = Annotated[
    int, typer.Option(help="Runs per σ and method, each with its own noise and search seed.")
]
ClientMethods = Annotated[str, typer.Option(help=f"Search methods: {', '.join(SEARCH_METHODS)}.")]
Seed = Annotated[
    int, typer.Option(help="Seed of the sweep; the replicates' seeds are derived from it.")
]
Channels = Annotated[str | None, typer.Option(help="Which channel is which signal: u=P1,y=P2.")]
Changes = Annotated[
    NamedValues, typer.Option("--set", help="path=value of the job: algorithm.population=100.")
]
Wait = Annotated[bool, typer.Option("--wait", help="Show progress, then the table.")]
IdempotencyKey = Annotated[str | None, typer.Option(help="The same key returns the same job.")]


@app.command(
    "noise",
    epilog=show_examples(
        "lagid sweep noise --model fopdt --data recording --sigma 0:0.2:0.05 --wait",
        "lagid sweep noise --model mine.yaml --data recording --sigma 0,0.1,0.5",
    ),
)
@server_command(print_job)
def sweep_noise(
    client: "Client",
    model: ModelName,
    sigma: Sigma,
    data: Data = None,
    true: TrueParameters = None,
    inputs: Input = None,
    samples: Annotated[int | None, typer.Option(help="Number of samples to simulate.")] = None,
    sample_time: Annotated[float | None, typer.Option(help="Sampling period in s.")] = None,
    relative: Relative = False,
    place: Place = "sensor",
    replicates: Replicates = 20,
    methods: ClientMethods = "simple,improved",
    seed: Seed = 1,
    channels: Channels = None,
    changes: Changes = None,
    name: Annotated[str | None, typer.Option(help="Name of the job.")] = None,
    wait: Wait = False,
    idempotency_key: IdempotencyKey = None,
    as_json: bool = False,
) -> Document | None:
    """Identify under noise: σ × replicates × methods; errors and Cramér–Rao bounds.

    The record is simulated (--true, --input, --samples, --sample-time) or a dataset (--data).
    With more replicates, or another grid, only new runs are computed.
    """
    truth = _build_truth(true, inputs, samples, sample_time)
    body: dict[str, Any] = {
        "model": read_model(model),
        "sigma": [sigma_value for text in sigma for sigma_value in parse_sigma_grid(text)],
        "relative": relative,
        "place": place,
        "replicates": replicates,
        "methods": split_names(methods),
        "seed": seed,
        "channels": parse_channels(channels),
        **_choose_source(data, truth),
        **({} if name is None else {"name": name}),
    }
    for change in changes or []:
        apply_setting(body, change)
    with report_faults(FIELD_ORIGINS):
        job = client.noise_sweep(body, idempotency_key=idempotency_key)
    if not wait:
        return job
    ended = follow_job(client, job["id"], quiet=as_json)
    _print_sweep(client, ended, is_relative=relative, as_json=as_json)
    return None


def parse_sigma_grid(text: str) -> list[float]:
    """Parse values of σ from ``0:1:0.05`` (including both ends) or from ``0,0.1,0.3``.

    The steps are computed in decimals, so that the fourth value of 0:1:0.05 is exactly 0.15.
    """
    sigmas: list[float] = []
    for part in split_names(text):
        ends = [_parse_decimal(text, number_text) for number_text in part.split(":")]
        if len(ends) == 1:
            sigmas.append(float(ends[0]))
        elif len(ends) == 3 and ends[2] > 0 and ends[1] >= ends[0]:
            start, stop, step = ends
            count = int((stop - start) / step) + 1
            if count > MAX_SIGMA_VALUES:
                fail_usage(
                    f"--sigma {text}: {count} values; at most {MAX_SIGMA_VALUES} are allowed"
                )
            sigmas += [float(start + step * number) for number in range(count)]
        else:
            fail_usage(
                f"--sigma {text}: found {part!r}; need start:stop:step with start ≤ stop and a "
                "positive step, such as 0:1:0.05"
            )
    if not sigmas:
        fail_usage(f"--sigma {text!r}: need numbers, such as 0:1:0.05 or 0,0.1,0.3")
    return sigmas


def build_sweep_tables(summary: Mapping[str, Any]) -> list[tuple[list[str], list[list[str]]]]:
    """Build headings and rows of the tables of a noise sweep, a row for each σ and method.

    The first table has the runs and the error of the response. The others have the errors of the
    parameters.
    """
    groups = summary["groups"]
    units = {
        parameter["name"]: parameter["unit"]
        for group in groups
        for parameter in group["parameters"]
    }
    others = [key for key in summary["by"] if key not in (SIGMA_PATH, RELATIVE_KEY)]
    relative = [f">{RELATIVE_KEY} σ"] if RELATIVE_KEY in summary["by"] else []
    cells = [
        [
            *(_format_short(group["key"][RELATIVE_KEY], 4) for _ in relative),
            _format_short(group["sigma"], 4),
            *(str(group["key"][key]) for key in others),
        ]
        for group in groups
    ]
    unit = summary["rms_unit"]
    one_output = None if unit == RELATIVE_UNIT else unit
    keys = [
        *relative,
        f">{append_unit('σ', one_output)}",
        *(key.rsplit("/", 1)[-1] for key in others),
    ]
    tables = [
        (
            [
                *keys,
                ">runs",
                ">success",
                ">evaluations",
                f"RMS error{'' if unit in (None, '1') else f' in {unit}'} [5 %, 95 %]",
                ">bound",
            ],
            [[*cell, *_group_cells(group)] for cell, group in zip(cells, groups, strict=True)],
        )
    ]
    names = list(units)
    for first in range(0, len(names), PARAMETERS_PER_TABLE):
        some, headings = names[first : first + PARAMETERS_PER_TABLE], list(keys)
        for name in some:
            headings += [
                f"{name}{'' if units[name] == '1' else f' in {units[name]}'}: error [5 %, 95 %]",
                ">bound",
            ]
        rows = [
            [*cell, *_error_cells(group, some)] for cell, group in zip(cells, groups, strict=True)
        ]
        tables.append((headings, rows))
    return tables


def _group_cells(group: Mapping[str, Any]) -> list[str]:
    ended = group["succeeded"] + group["failed"]
    return [
        f"{ended}" if ended == group["runs"] else f"{ended}/{group['runs']}",
        f"{100 * group['success_rate']:.0f} %" if ended else "–",
        "–" if group["evaluations"] is None else f"{group['evaluations']:.0f}",
        _format_band(group["rms_noise_free"]),
        _format_short(scale_to_median(group)),
    ]


def _error_cells(group: Mapping[str, Any], names: list[str]) -> list[str]:
    by_name = {parameter["name"]: parameter for parameter in group["parameters"]}
    parameters = [by_name.get(name, {"error": None, "cramer_rao_bound": None}) for name in names]
    return [
        text
        for parameter in parameters
        for text in (
            _format_band(parameter["error"], signed=True),
            _format_short(parameter["cramer_rao_bound"]),
        )
    ]


def _print_sweep(
    client: "Client", job: Mapping[str, Any], *, is_relative: bool, as_json: bool
) -> None:
    summary = client.summary(job["id"], GROUP_KEYS[is_relative])
    if as_json:
        print_json({**job, "summary": summary})
    else:
        for headings, rows in build_sweep_tables(summary):
            print_table(headings, rows, empty="no runs")
            out.print()
        for note in [*summary["notes"], *([RELATIVE_NOTE] if is_relative else [])]:
            print_note(note)
        out.print(
            f"{job['id']}: {summary['reused']} of {summary['runs']} runs reused", markup=False
        )
    check_succeeded(job)


def _build_truth(
    true: NamedValues, inputs: NamedValues, samples: int | None, sample_time: float | None
) -> dict[str, Any]:
    return {
        "parameters": {
            name: parse_number(f"--true {name}={value}", value)
            for name, value in parse_pairs("--true", true or ()).items()
        },
        "inputs": {
            name: {"kind": "expression", "expression": text}
            for name, text in parse_pairs("--input", inputs or ()).items()
        },
        "samples": samples,
        "sample_time": sample_time,
    }


def _choose_source(data: str | None, truth: Mapping[str, Any]) -> dict[str, Any]:
    present = {name: value for name, value in truth.items() if value}
    if (data is None) == (not present):
        fail_usage(
            "need either --data, or --true, --input, --samples and --sample-time to simulate"
        )
    return {"truth": present} if data is None else {"datasets": split_names(data)}


def _parse_decimal(text: str, part: str) -> Decimal:
    try:
        value = Decimal(part)
    except InvalidOperation:
        value = Decimal("NaN")
    if not value.is_finite():
        fail_usage(f"--sigma {text}: found {part!r}; need a number, or start:stop:step")
    return value


def _format_short(value: float | None, digits: int = 2) -> str:
    return "–" if value is None else f"{value:.{digits}g}"


def _format_band(quantiles: list[float] | None, *, signed: bool = False) -> str:
    if quantiles is None:
        return "–"
    low, middle, high = (
        f"{quantiles[index]:{'+' if signed else ''}.2g}"
        for index in (LOW_INDEX, MEDIAN_INDEX, HIGH_INDEX)
    )
    return f"{middle} [{low}, {high}]"
