"""Encoding of complete runs in the worker: all that is stored of them, as the database takes it.

Ray ships the encoder with a pack. Workers import this module, so it knows no SQL.
"""

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from service.core.bodies.json_text import write_json
from service.core.bodies.user_documents import to_finite
from service.dispatch.history_points import to_history_points, to_migrant_points
from service.formats.mcap.mcap_files import list_fitted_outputs, write_fitted_outputs
from service.jobs.stored_results import write_result_document
from service.queue.packed_results import (
    HISTORY_ROWS,
    MIGRANT_ROWS,
    RESULT_ROWS,
    SIGNALS_COLUMNS,
    Dialect,
    PackedResults,
    Row,
    extract_estimates,
    pack_rows,
)
from service.repositories.history_rows import pack_history, pack_migrants
from sysid.identification.fingerprint import compute_fingerprint
from workers import protocol
from workers.protocol import CompleteRun, Records
from workers.tasks import prepare_run_records


class _SignalsPlace(NamedTuple):
    """Place of a run's file in the object of its pack; `start` is None if it is the whole."""

    sha256: str | None = None
    start: int | None = None
    size: int | None = None


@dataclass(frozen=True, slots=True)
class ResultEncoder:
    """Encodes the complete runs of a pack; a `workers.protocol.Encoder`.

    Attributes
    ----------
    dialect : {"sqlite", "postgresql"}
        Database that the rows are for.
    keeps_signals : bool
        Whether fitted signals are stored.
    reports_estimates : bool
        Whether the dispatcher needs the estimates, because later runs start from them.
    """

    dialect: Dialect
    keeps_signals: bool = True
    reports_estimates: bool = False

    def __call__(
        self, complete: Sequence[CompleteRun], records: Mapping[str, Records]
    ) -> PackedResults:
        """Encode the runs."""
        files = [write_signals(run, records) for run in complete] if self.keeps_signals else []
        places = _locate_files(files) or [_SignalsPlace()] * len(complete)
        rows = [_build_row(run, place) for run, place in zip(complete, places, strict=True)]
        history = [row for run in complete for row in pack_history(_list_points(run))]
        migrants = [row for run in complete for row in pack_migrants(_list_migrants(run))]
        found = [run.concluded.identification for run in complete]
        rms = [one.rms for one in found if math.isfinite(one.rms)]
        return PackedResults(
            tuple(run.run for run in complete),
            sum(int(one.evaluations) for one in found),
            max(int(one.generations) for one in found),
            float(min(rms)) if rms else None,
            {
                run.run: {
                    one.name: float(one.value) for one in run.concluded.identification.parameters
                }
                for run in complete
                if self.reports_estimates
            },
            (
                pack_rows(rows, RESULT_ROWS, self.dialect),
                pack_rows([*map(tuple, map(dict.values, history))], HISTORY_ROWS, self.dialect),
                pack_rows([*map(tuple, map(dict.values, migrants))], MIGRANT_ROWS, self.dialect),
            ),
            b"".join(files),
            places[0].sha256,
        )


def write_signals(run: CompleteRun, records: Mapping[str, Records]) -> bytes:
    """Write the file of a run's fitted signals: measured and simulated outputs, as MCAP."""
    data = prepare_run_records(run.spec.problem, records)
    identification = run.concluded.identification
    fits = list_fitted_outputs("estimation", data.estimation, identification.simulated)
    if data.validation is not None:
        validated = identification.simulated_validation
        fits += list_fitted_outputs("validation", data.validation, validated)
    target = io.BytesIO()
    write_fitted_outputs(fits, target)
    return target.getvalue()


@cache
def describe_program() -> dict[str, str]:
    """Describe the program of this process, which computes: its version and its fingerprint."""
    folder = Path(protocol.__file__).parent  # workers split records and add noise
    return {"version": version("lagid"), "fingerprint": compute_fingerprint(folder)}


def _locate_files(files: Sequence[bytes]) -> list[_SignalsPlace]:
    """Locate files in the object that they form end to end."""
    name = sha256(b"".join(files)).hexdigest()
    if len(files) == 1:
        return [_SignalsPlace(name)]
    places, start = [], 0
    for file in files:
        places.append(_SignalsPlace(name, start, len(file)))
        start += len(file)
    return places


def _build_row(run: CompleteRun, place: _SignalsPlace) -> Row:
    """Build the row of a run that succeeded."""
    found, noise_free = run.concluded.identification, to_finite(run.concluded.rms_noise_free)
    result = {
        **write_result_document(found, run.seconds),
        "rms_noise_free": noise_free,
        **describe_program(),
    }
    return RESULT_ROWS.build_row(
        {
            "id": run.run,
            "spec_hash": run.spec.reuse_key,
            "valid": bool(found.valid),
            "best_rms": to_finite(found.rms),
            "rms_noise_free": noise_free,
            "fit_estimation": to_finite(found.fit_percent.estimation),
            "fit_validation": to_finite(found.fit_percent.validation),
            "evaluations": int(found.evaluations),
            "generations": int(found.generations),
            "seconds": float(run.seconds),
            "estimates": write_json(extract_estimates(result)),
            "result": write_json(result),
            **dict(zip(SIGNALS_COLUMNS, place, strict=True)),
        }
    )


def _list_points(run: CompleteRun) -> Iterator[Any]:
    written = {} if run.reported is None else dict(enumerate(map(len, run.reported.history)))
    return to_history_points(run.run, run.concluded.identification.history, written)


def _list_migrants(run: CompleteRun) -> Iterator[Any]:
    written = 0 if run.reported is None else len(run.reported.migrations)
    return to_migrant_points(run.run, run.concluded.identification.migrations, written)
