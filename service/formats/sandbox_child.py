"""The child process of `service.formats.sandbox`: one task on stdin, one answer on stdout."""

import json
import resource
import sys
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from service.formats.csv_recordings import read_csv
from service.formats.errors import InvalidUpload
from service.formats.limits import MIB, Limits
from service.formats.mcap import read_mcap, write_recording
from sysid.data.records import Recording


def main() -> int:
    """Read the task's file and write it anew; answer with notes or with the error."""
    task = json.load(sys.stdin)
    limits = Limits(**task["limits"])
    _limit_this_process(limits)
    try:
        answer: dict[str, Any] = {"notes": _read(task, limits)}
    except InvalidUpload as error:
        answer = {"error": _place_of(error)}
    except MemoryError:
        answer = {"error": {"what": _too_much_memory(limits)}}
    sys.stdout.write(json.dumps(answer))
    return 0


def _limit_this_process(limits: Limits) -> None:
    seconds = ceil(limits.seconds)
    for what, most in (
        (resource.RLIMIT_AS, limits.memory_bytes),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_FSIZE, limits.total_bytes),
        (resource.RLIMIT_CORE, 0),
    ):
        _, hard = resource.getrlimit(what)
        allowed = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (allowed, allowed if what != resource.RLIMIT_CPU else hard))


def _read(task: dict[str, Any], limits: Limits) -> list[str]:
    if task["kind"] == "csv":
        recording, notes = read_csv(
            Path(task["source"]), sample_time=task["sample_time"], segments=task["segments"]
        )
        made = list(notes)
    else:
        recording, notes = read_mcap(task["source"], limits)
        made = [*notes, *_check_values(recording)]
    try:
        write_recording(recording, task["target"])
    except ValueError as error:
        raise InvalidUpload(str(error)) from None
    return made


def _check_values(recording: Recording) -> list[str]:
    """Refuse infinite values; return a note for each channel with missing ones."""
    notes = []
    for channel in recording.channels:
        infinite = np.flatnonzero(np.isinf(channel.values))
        if infinite.size:
            raise InvalidUpload(
                f"channel {channel.name!r} is infinite at t = {channel.times[infinite[0]]:g} s; "
                "values must be finite (NaN is a missing value)"
            )
        missing = np.flatnonzero(np.isnan(channel.values))
        if missing.size:
            notes.append(
                f"channel {channel.name!r}: {missing.size} of {channel.values.size} values are "
                f"missing (NaN), the first at t = {channel.times[missing[0]]:g} s; as an output "
                "they are not scored, as an input the channel cannot be used"
            )
    return notes


def _place_of(error: InvalidUpload) -> dict[str, Any]:
    return {"what": error.what, "row": error.row, "column": error.column, "byte": error.byte}


def _too_much_memory(limits: Limits) -> str:
    return f"reading the file needs more than {limits.memory_bytes // MIB} MiB of memory"


if __name__ == "__main__":
    sys.exit(main())
