"""The child process of `service.formats.sandbox`: one task on stdin, one answer on stdout."""

import json
import os
import sys
from pathlib import Path
from typing import Any, Final

from service.core.process.temporary_files import FULL_DISK_ERRORS
from service.formats.advice import LEAVE_CLOCK
from service.formats.file_kinds import FileKind
from service.formats.limits import MIB, UploadLimits
from service.formats.mcap.mcap_files import read_mcap_with_notes, write_recording
from service.formats.read_options import ReadOptions
from service.formats.tabular.csv_recordings import read_csv
from service.formats.tabular.table_columns import Table
from service.formats.tabular.table_recordings import build_recording
from sysid.core.child_processes import limit_resources
from sysid.core.errors import UnreadableFile
from sysid.data.records import Recording
from sysid.data.value_checks import find_infinite_value
from sysid.inspection.inspect import inspect_recording

_OF_TABLES: Final = ("sample_time", "segments", "columns", "missing", "exclude")


def main() -> int:
    """Read the file of the task and write it again; answer with notes or with the error.

    A full disk is no fault of the file and has an answer of its own.
    """
    task = json.load(sys.stdin)
    options = ReadOptions.from_document(task["options"])
    limits = options.limits
    os.environ["POLARS_MAX_THREADS"] = "1"  # the stacks of its threads would count as memory
    limit_resources(
        seconds=limits.seconds,
        memory_bytes=limits.memory_bytes,
        file_bytes=limits.total_bytes,
    )
    try:
        answer: dict[str, Any] = {"notes": _convert_file(task, options)}
    except UnreadableFile as error:
        answer = {"error": _describe_error(error)}
    except OSError as error:
        if error.errno not in FULL_DISK_ERRORS:
            raise
        answer = {"is_disk_full": True}
    except MemoryError:
        answer = {"error": {"what": _describe_memory_limit(limits)}}
    sys.stdout.write(json.dumps(answer))
    return 0


def _convert_file(task: dict[str, Any], options: ReadOptions) -> list[str]:
    recording, messages = read_file(Path(task["source"]), task["kind"], options)
    try:
        write_recording(recording, task["target"])
    except ValueError as error:
        raise UnreadableFile(str(error)) from None
    return [*messages, *(one.sentences for one in inspect_recording(recording))]


def read_file(path: Path, kind: FileKind, options: ReadOptions) -> tuple[Recording, list[str]]:
    """Read a file of a kind, and return the notes with its recording."""
    if kind != "mcap" and options.clock != "log":
        raise UnreadableFile("the file is no MCAP file, so it has one clock; ", LEAVE_CLOCK)
    if kind == "csv":
        recording, notes = read_csv(path, options)
        return recording, list(notes)
    if kind == "mcap":
        recording, notes = read_mcap_with_notes(path, options.limits, options.clock)
        unused = [name for name in _OF_TABLES if name in options.list_given()]
        if unused:
            notes = (*notes, f"an MCAP file has times and names; not used: {', '.join(unused)}")
        if fault := find_infinite_value(recording.channels):
            raise UnreadableFile(fault)
        return recording, list(notes)
    table, messages = _read_table(path, kind, options)
    return build_recording(table, options, messages), messages


def _read_table(path: Path, kind: FileKind, options: ReadOptions) -> tuple[Table, list[str]]:
    """Read a table by the library of its kind, which is loaded for it alone."""
    messages: list[str] = []
    if kind == "excel":
        from service.formats.tabular.sheet_files import read_sheets

        return read_sheets(path, options, messages), messages
    if kind == "json":
        from service.formats.tabular.json_files import read_json

        return read_json(path, options, messages), messages
    if kind == "matlab":
        from service.formats.tabular.matlab_files import read_matlab

        return read_matlab(path, options, messages), messages
    from service.formats.tabular.column_files import read_numpy, read_parquet

    read = {"numpy": read_numpy, "parquet": read_parquet}[kind]
    return read(path, options, messages), messages


def _describe_error(error: UnreadableFile) -> dict[str, Any]:
    place = {"row": error.row, "column": error.column, "byte": error.byte}
    return {"what": error.what, "advice": error.advice, **place}


def _describe_memory_limit(limits: UploadLimits) -> str:
    return f"reading the file needs more than {limits.memory_bytes // MIB} MiB of memory"


if __name__ == "__main__":
    sys.exit(main())
