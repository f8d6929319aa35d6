"""Judge the judge: what is said of records with a known truth, as `lagid identify` says it.

    python -m benchmarks.judgement --seeds 10 --workers 2
    python -m benchmarks.judgement --kinds 'lag_.*|sound_ar1' --seeds 3 --each
    python -m benchmarks.judgement --kinds unit_jump --write FOLDER
    python -m benchmarks.judgement --halves

The kinds are in `benchmarks/judgement_kinds.py`, the plants in `benchmarks/judgement_plants.py`.
Nothing is set but the model. A parameter is wrong if its status is `identified` and its value is
more than four standard errors from a value that was true in some part of the record. A verdict
names up to two causes. Its reason is true if one of them is of a family, or an explanation, that
the kind names. Advice that is a setting or a model is followed. It made an estimate worse if an
error grew by over one standard error.
"""

import argparse
import json
import re
import shlex
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import click
import numpy as np
import yaml

from benchmarks.judgement_kinds import KINDS, Case, draw_case
from benchmarks.real_data.session import data_folder
from benchmarks.table import Row, Skipped, parser, report
from lagid import Identification, Recording, read_recording
from service.cli.common import apply_setting
from service.jobs.job_schemas import JobIn
from service.jobs.to_core import read_run_settings
from sysid.core.errors import SysidError
from sysid.core.findings import Finding
from sysid.core.text import rewrite_settings
from sysid.identification.identify import identify_records
from sysid.identification.identify_arguments import read_records
from sysid.models.catalogue.load import resolve_model

SEEDS, QUICK = 10, 1
FIRST_SEED = 71_000
WRONG = 4.0  # standard errors
APART = 3.0  # errors of the difference of two halves


@dataclass(frozen=True)
class Judged:
    """An estimate of a parameter whose truth is known.

    `z` is the largest distance from a true value, in standard errors; None without an error.
    `holds` says whether the 95 % interval has all true values; None without an interval.
    """

    value: float
    stderr: float | None
    status: str
    z: float | None
    holds: bool | None
    error: float

    @property
    def is_wrong(self) -> bool:
        """Whether it is called identified and is not."""
        return self.status == "identified" and self.z is not None and abs(self.z) > WRONG


@dataclass(frozen=True)
class Advised:
    """Advice that was followed: its settings, and the parameters whose error grew."""

    settings: tuple[str, ...]
    worse: tuple[str, ...]
    refused: str = ""


@dataclass(frozen=True)
class Answer:
    """What was said of one record; `trust` is empty if it was refused, `crash` names a fault.

    `is_reason_true` says whether the verdict names the true reason, `is_first_true` whether that is
    what it names first.
    """

    kind: str
    seed: int
    plant: str
    trust: str
    verdict: str
    estimates: Mapping[str, Judged]
    findings: tuple[Mapping[str, Any], ...]
    is_reason_true: bool
    is_first_true: bool
    detectable: bool
    advised: Advised | None
    refused: str
    crash: str
    seconds: float

    @property
    def is_plain(self) -> bool:
        """Whether it is plainly trustworthy."""
        return self.trust == "trustworthy"

    @property
    def wrong(self) -> list[str]:
        """Parameters that are called identified and are not."""
        return [name for name, one in self.estimates.items() if one.is_wrong]


def identify_as_command(
    model: str | dict[str, Any], recording: Recording, changes: Sequence[str] = ()
) -> Identification:
    """Identify as `lagid identify` does; `changes` are those of its option `--set`.

    Raises
    ------
    SysidError
        If something is refused.
    """
    body: dict[str, Any] = {"model": "own", "datasets": ["record"]}
    for change in changes:
        apply_setting(body, change)
    job = JobIn.model_validate(body)
    algorithm, fit, options = read_run_settings(job.to_normal_form(), in_sweep=False)
    loaded = resolve_model(model)
    read = read_records(loaded, recording, job.channels, job.hold)
    return identify_records(loaded, read.records, algorithm, fit, options)


def compare_truth(found: Identification, case: Case) -> dict[str, Judged]:
    """Compare the estimates with the truth; a name that the model lacks is left out."""
    judged, resolution = {}, case.kind.resolution
    for name, values in case.truth.items():
        one = found.get(name)
        if one is None:
            continue
        far = max(values, key=lambda value, one=one: abs(one.value - value))
        least = resolution * abs(far)
        z = (one.value - far) / max(one.stderr, least) if one.stderr else None
        ends = one.interval95
        holds = None if ends is None else all(ends[0] <= value <= ends[1] for value in values)
        judged[name] = Judged(one.value, one.stderr, one.status, z, holds, abs(one.value - far))
    return judged


def judge_case(task: tuple[str, int]) -> Answer:
    """Identify the record of a kind and a seed; a fault of the program is an answer too."""
    name, seed = task
    case = draw_case(name, seed)
    begun = time.perf_counter()
    blank: dict[str, Any] = {
        "kind": name,
        "seed": seed,
        "plant": case.plant,
        "trust": "",
        "verdict": "",
        "estimates": {},
        "findings": (),
        "is_reason_true": False,
        "is_first_true": False,
        "detectable": False,
        "advised": None,
        "refused": "",
        "crash": "",
    }
    try:
        told = _tell_answer(case)
    except SysidError as error:
        told = {"refused": str(error)}
    except Exception as error:  # noqa: BLE001  # the border of a process: the others go on
        told = {"crash": f"{type(error).__name__}: {error}"}
    return Answer(**blank | told | {"seconds": time.perf_counter() - begun})


def _tell_answer(case: Case) -> dict[str, Any]:
    found = identify_as_command(case.model, case.recording)
    findings = found.findings
    named = [one for one in findings if one.brief in found.verdict.text]
    true = [one for one in named if case.kind.reasons & {one.family, one.explanation}]
    estimates = compare_truth(found, case)
    settings = read_advice(found)
    return {
        "trust": found.verdict.trust,
        "verdict": found.verdict.text,
        "estimates": estimates,
        "findings": tuple(map(_describe_finding, findings)),
        "is_reason_true": bool(true),
        "is_first_true": bool(true) and true[0] is findings[0],
        "detectable": is_detectable(case, found),
        "advised": follow_advice(case, estimates, settings) if settings else None,
    }


def is_detectable(case: Case, found: Identification) -> bool:
    """Whether the record can show the defect to one who knows what it might be.

    The noise is known here. What the fitted model misses of the output without noise is the
    non-centrality λ of the likelihood ratio. It has to beat Schwarz's penalty of two parameters
    by 10, "very strong" evidence by Kass and Raftery (1995).
    """
    kind = case.kind
    if kind.group in ("white", "coloured") or kind.detectable == "never":
        return False
    if kind.group == "dirty" or kind.detectable == "always":
        return True
    records = read_records(resolve_model(case.model), case.recording, None).records
    parts = []
    for record, (fitted,) in zip(records, found.simulated, strict=True):
        clean = case.clean[np.isin(case.logged["t"], record.outputs[0].times)]
        parts.append((clean[-fitted.size :] - fitted) / case.noise_sd)
    missed = np.concatenate(parts)
    missed = missed[np.isfinite(missed)]
    free = sum(one.is_free for one in found.parameters)
    return bool(np.sum(missed**2) - free > 10.0 + 2.0 * np.log(missed.size))


def _describe_finding(finding: Finding) -> dict[str, Any]:
    moves = {move.parameter: [float(move.value), float(move.stderrs)] for move in finding.moves}
    return {
        "explanation": finding.explanation,
        "family": finding.family,
        "gain": finding.gain,
        "moves": moves,
        "severity": finding.severity,
        "brief": finding.brief,
        "text": finding.text,
        "advice": finding.advice,
    }


def read_advice(found: Identification) -> tuple[str, ...]:
    """Read the verdict's first advice as settings; `model=NAME` is another model."""
    severe = [one for one in found.findings if one.severity != "note"]
    if not severe:
        return ()
    advice = severe[0].advice
    models = re.findall(r"the model (\w+)", advice)
    typed = rewrite_settings(advice, _write_options)
    return (*(f"model={name}" for name in models), *read_settings(typed))


def _write_options(place: Sequence[str], entries: Mapping[str, str]) -> str:
    return " ".join(f"--set {'.'.join([*place, name])}={value}" for name, value in entries.items())


def read_settings(text: str) -> tuple[str, ...]:
    """Read the options of `lagid identify` in a text."""
    names = {"model": "model", "noise-model": "loss.noise_model"}
    settings = []
    pattern = r"--(set|model|noise-model)[ =]('[^']*'|\"[^\"]*\"|[^\s`,;]+)"
    for option, value in re.findall(pattern, text):
        plain = " ".join(shlex.split(value)).rstrip(".")
        settings.append(plain if option == "set" else f"{names[option]}={plain}")
    return tuple(settings)


def follow_advice(
    case: Case, estimates: Mapping[str, Judged], settings: tuple[str, ...]
) -> Advised | None:
    """Identify with the settings that were advised; the options that leave a choice are skipped."""
    if any("…" in setting for setting in settings):
        return None
    models = [one.removeprefix("model=") for one in settings if one.startswith("model=")]
    changes = [one for one in settings if not one.startswith("model=")]
    try:
        found = identify_as_command(models[0] if models else case.model, case.recording, changes)
    except (SysidError, click.exceptions.Exit, ValueError) as error:
        return Advised(settings, (), str(error) or "refused")
    after = compare_truth(found, case)
    worse = [
        name
        for name, one in after.items()
        if name in estimates and one.error > estimates[name].error + (estimates[name].stderr or 0.0)
    ]
    return Advised(settings, tuple(worse))


def tell_each(answer: Answer) -> str:
    """Tell one record in a line."""
    if answer.crash or answer.refused:
        return f"{answer.kind} {answer.seed} {answer.plant}: {answer.crash or answer.refused}"
    marks = {"identified": ""}
    estimates = ", ".join(
        f"{name} {'–' if one.z is None else f'{one.z:+.1f}'}"
        f"{'!' if one.is_wrong else ''}{marks.get(one.status, f' ({one.status})')}"
        for name, one in answer.estimates.items()
    )
    findings = "; ".join(
        f"{one['family']}/{one['explanation']} gain {one['gain'] or 0.0:.0f}, moves "
        + ", ".join(f"{name} {move[1]:+.1f}" for name, move in one["moves"].items())
        for one in answer.findings
    )
    advised = answer.advised
    advice = ""
    if advised is not None:
        ends = advised.refused or f"worse: {', '.join(advised.worse) or 'nothing'}"
        advice = f" | advice {' '.join(advised.settings)}: {ends}"
    reason = "" if answer.is_plain else f" [{'TRUE' if answer.is_reason_true else 'other'} reason]"
    if KINDS[answer.kind].group == "defect" and not answer.detectable:
        reason += " [not detectable]"
    return (
        f"{answer.kind} {answer.seed} {answer.plant}: {answer.verdict}{reason} | z {estimates}"
        f" | {findings or 'no finding'}{advice} | {answer.seconds:.1f} s"
    )


def write_kind_line(name: str, answers: Sequence[Answer]) -> str:
    """Write one line of the table of kinds."""

    def count(trust: str) -> str:
        those = [one for one in answers if one.trust == trust]
        return f"{len(those)} ({sum(bool(one.wrong) for one in those)})"

    said = [one for one in answers if one.trust not in ("", "trustworthy")]
    far = [
        (abs(judged.z), key)
        for one in answers
        for key, judged in one.estimates.items()
        if judged.is_wrong and judged.z is not None
    ]
    worst = f"{max(far)[1]} {max(far)[0]:.0f}" if far else "–"
    advised = [one.advised for one in answers if one.advised is not None]
    reasons = Counter(one.findings[0]["explanation"] for one in said if one.findings)
    cells = [
        name,
        KINDS[name].group,
        str(len(answers)),
        str(sum(one.detectable for one in answers)),
        count("trustworthy"),
        count("limited"),
        count("not trustworthy"),
        str(sum(bool(one.refused or one.crash) for one in answers)),
        f"{sum(one.is_reason_true for one in said)} of {len(said)}",
        f"{sum(bool(one.worse or one.refused) for one in advised)} of {len(advised)}",
        worst,
        ", ".join(f"{reason} {number}" for reason, number in reasons.most_common(3)),
    ]
    return f"| {' | '.join(cells)} |"


def print_kinds(answers: Sequence[Answer]) -> None:
    """Print a line for each kind; numbers in brackets are wrong."""
    print(
        "\n| kind | group | n | detectable | trustworthy (wrong) | but (wrong) | not (wrong) "
        "| refused | true reason | advice made worse | worst | reasons given |"
        "\n|---|---|--:|--:|--:|--:|--:|--:|--:|--:|---|---|"
    )
    for name in KINDS:
        own = [one for one in answers if one.kind == name]
        if own:
            print(write_kind_line(name, own))
    print()


def share_row(
    title: str,
    those: Sequence[object],
    of: Sequence[object],
    bar: float | None,
    relation: Literal["<=", ">="],
) -> Row | Skipped:
    """A share in per cent, or that there was nothing to count."""
    if not of:
        return Skipped(title, "no such record")
    name = f"{title} ({len(those)} of {len(of)})"
    return Row(name, 100.0 * len(those) / len(of), "%", bar, relation)


def count_answers(answers: Sequence[Answer]) -> list[Row | Skipped]:
    """Count what the issue asks for."""
    spoken = [one for one in answers if one.trust]
    broken = [one for one in spoken if one.detectable]
    hopeful = [one for one in broken if one.trust != "not trustworthy"]
    hedged = [
        one
        for one in spoken
        if KINDS[one.kind].group in ("defect", "dirty")
        and KINDS[one.kind].detectable != "never"
        and not one.is_plain
    ]
    advised = [one.advised for one in spoken if one.advised is not None]
    rows = [
        share_row(
            "plainly trustworthy and wrong, of detectable defects",
            [one for one in broken if one.is_plain and one.wrong],
            broken,
            0.5,
            "<=",
        ),
        share_row(
            f"trustworthy, plainly or but, with an identified value over {WRONG:g} errors off",
            [one for one in hopeful if one.wrong],
            broken,
            3.0,
            "<=",
        ),
        share_row(
            "not trustworthy, with such a value",
            [one for one in broken if one.wrong and one not in hopeful],
            broken,
            None,
            "<=",
        ),
        share_row(
            "true reason in the verdict, wherever anything is said",
            [one for one in hedged if one.is_reason_true],
            hedged,
            75.0,
            ">=",
        ),
        share_row(
            "of these, as the first cause",
            [one for one in hedged if one.is_first_true],
            hedged,
            None,
            ">=",
        ),
        share_row(
            "advice that makes an estimate worse",
            [one for one in advised if one.worse],
            advised,
            5.0,
            "<=",
        ),
        share_row(
            "advice that is refused", [one for one in advised if one.refused], advised, 0.0, "<="
        ),
    ]
    for group, title, bar in (("white", "white", 98.0), ("coloured", "AR", 90.0)):
        sound = [one for one in spoken if KINDS[one.kind].group == group]
        plain = [one for one in sound if one.is_plain]
        rows.append(
            share_row(f"sound, {title} noise: plainly trustworthy", plain, sound, bar, ">=")
        )
        rows += _count_coverage(title, sound)
    crashed, refused = (
        [one for one in answers if getattr(one, what)] for what in ("crash", "refused")
    )
    return [
        *rows,
        Row("faults of the program", len(crashed), "", 0),
        Row("refused records", len(refused), ""),
    ]


def _count_coverage(title: str, sound: Sequence[Answer]) -> list[Row | Skipped]:
    """Coverage of 95 % intervals; without noise rounding decides, so such records are left out."""
    known = [
        judged
        for one in sound
        if "noise_free" not in one.kind
        for judged in one.estimates.values()
        if judged.holds is not None
    ]
    held = [one for one in known if one.holds]
    name = f"sound, {title} noise: 95 % intervals that hold"
    return [
        share_row(name, held, known, 93.0, ">="),
        share_row(f"{name}, from above", held, known, 97.0, "<="),
    ]


def write_cases(tasks: Sequence[tuple[str, int]], folder: Path) -> None:
    """Write records as CSV, with model, truth and command."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, seed in tasks:
        case = draw_case(name, seed)
        stem = folder / f"{name}-{seed}"
        keys = list(case.logged)
        rows = zip(*(case.logged[key].tolist() for key in keys), strict=True)
        lines = [",".join(keys), *(",".join(map(_write_number, row)) for row in rows)]
        stem.with_suffix(".csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
        model = case.model
        if isinstance(model, dict):
            stem.with_suffix(".yaml").write_text(yaml.safe_dump(model, sort_keys=False))
            model = f"{stem.name}.yaml"
        told = {
            "command": f"lagid identify {stem.name}.csv --model {model}",
            "truth": case.truth,
            "reasons": sorted(case.kind.reasons),
            "group": case.kind.group,
            "detectable": case.kind.detectable,
            "plant": case.plant,
        }
        stem.with_suffix(".json").write_text(json.dumps(told, indent=1))
        print(told["command"])


def _write_number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.15g}"


HALVES: Mapping[str, tuple[str, str]] = {
    "dryer2, fopdt": ("dryer2/dryer2.csv", "fopdt"),
    "dryer2, sopdt": ("dryer2/dryer2.csv", "sopdt"),
    "gas furnace": ("gas_furnace/data.csv", ""),
    "ball and beam": ("ball_and_beam/data.csv", ""),
    "hydraulic actuator": ("hydraulic_actuator/data.csv", ""),
    "armadillo": ("armadillo/data.csv", ""),
    "tube of 40 m": ("tube_reference/tube_040m_pattern1.csv", "tube"),
    "EMPS": ("emps/emps_train.csv", "emps"),
}
"""Measured records: file, and model of the catalogue; else the one beside the file."""
TUBE_CHANNELS = ("channels.u=P1_meas_Pa", "channels.y=P2_meas_Pa")


def cut_half(recording: Recording, number: int) -> Recording:
    """The first (0) or second (1) half of a recording, without what was before."""
    start, stop = recording.channels[0].times[[0, -1]]
    middle = 0.5 * (start + stop)
    ends = (start, np.nextafter(middle, -np.inf)) if number == 0 else (middle, stop)
    return Recording(tuple(channel.slice_time(*ends) for channel in recording.channels))


def compare_halves(folder: Path) -> list[Row | Skipped]:
    """Identify both halves of measured records and compare what is called identified."""
    rows: list[Row | Skipped] = []
    print("\n| record | parameter | first half | second half | apart, errors | verdicts |")
    print("|---|---|--:|--:|--:|---|")
    for title, (file, model) in HALVES.items():
        path = folder / file
        recording = read_recording(path)
        source = model or yaml.safe_load(path.with_name("model.yaml").read_text())
        changes = TUBE_CHANNELS if model == "tube" else ()
        halves = [
            identify_as_command(source, cut_half(recording, number), changes) for number in (0, 1)
        ]
        apart = list(_compare_pair(title, *halves))
        rows.append(Row(f"{title}: identified twice, {APART:g} errors apart", sum(apart), "", 0))
    return rows


def _compare_pair(title: str, first: Identification, second: Identification) -> Iterator[bool]:
    """Print both estimates of each parameter; whether they disagree."""
    verdicts = f"{first.verdict.text} / {second.verdict.text}"
    for one in first.parameters:
        other = second.get(one.name)
        if other is None or one.name.endswith(")") or not (one.stderr and other.stderr):
            continue
        errors = abs(one.value - other.value) / float(np.hypot(one.stderr, other.stderr))
        print(
            f"| {title} | {one.name} | {one.value:.4g} ± {one.stderr:.2g} {one.status} "
            f"| {other.value:.4g} ± {other.stderr:.2g} {other.status} "
            f"| {errors:.1f} | {verdicts} |",
            flush=True,
        )
        verdicts = ""
        yield one.status == other.status == "identified" and errors > APART


def run_tasks(tasks: Sequence[tuple[str, int]], workers: int) -> Iterator[Answer]:
    """Judge the records on so many processes, in their order."""
    if workers == 1:
        yield from map(judge_case, tasks)
        return
    with get_context("spawn").Pool(workers) as pool:
        yield from pool.imap(judge_case, tasks)


def main(options: argparse.Namespace) -> None:
    """Run the chosen kinds, or the halves of measured records."""
    if options.halves:
        folder = data_folder()
        rows = [Skipped("halves", "LAGID_DATA is absent")] if folder is None else []
        finish("Halves of measured records", rows or compare_halves(folder), options)
        return
    seeds = options.seeds or (QUICK if options.quick else SEEDS)
    names = [name for name in KINDS if re.fullmatch(options.kinds, name)]
    tasks = [(name, options.first + number) for name in names for number in range(seeds)]
    if options.write is not None:
        write_cases(tasks, options.write)
        return
    answers = []
    for answer in run_tasks(tasks, options.workers):
        answers.append(answer)
        if options.each:
            print(tell_each(answer), flush=True)
        if options.out is not None:
            with options.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(answer), ensure_ascii=False) + "\n")
    print_kinds(answers)
    title = f"Judgement, {len(names)} kinds × {seeds} seeds from {options.first}"
    finish(title, count_answers(answers), options)


def finish(title: str, rows: Sequence[Row | Skipped], options: argparse.Namespace) -> None:
    """Print and write the table."""
    known = [row for row in rows if isinstance(row, Row)]
    report(title, known, [row for row in rows if isinstance(row, Skipped)], options)


if __name__ == "__main__":
    arguments = parser(__doc__ or "")
    arguments.add_argument("--kinds", default=".*", metavar="REGEX", help="whole names of kinds")
    arguments.add_argument("--seeds", type=int, help=f"records of each kind (default {SEEDS})")
    arguments.add_argument("--first", type=int, default=FIRST_SEED, metavar="SEED")
    arguments.add_argument("--workers", type=int, default=1, help="processes")
    arguments.add_argument("--each", action="store_true", help="a line for each record")
    arguments.add_argument("--out", type=Path, metavar="FILE", help="append answers as JSON lines")
    arguments.add_argument("--write", type=Path, metavar="FOLDER", help="write records, and end")
    arguments.add_argument(
        "--halves", action="store_true", help="compare the halves of measured records instead"
    )
    main(arguments.parse_args())
