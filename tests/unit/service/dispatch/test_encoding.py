"""What a worker encodes of complete runs: rows in the order of the tables, and files end to end."""

import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import fields
from hashlib import sha256

import pytest
from sqlalchemy.dialects import postgresql

from service.dispatch.encoding import ResultEncoder, write_signals
from service.formats.mcap.mcap_files import read_fitted_outputs
from service.queue.packed_results import LAYOUTS, RESULT_ROWS, PackedResults, RowLayout, pack_rows
from service.queue.run_writes import RunOutcome
from service.storage.tables import Base
from sysid.results.identification import Identification
from tests.support.cluster.small_runs import RECORDS, spec
from workers.protocol import AdvanceRun, CompleteRun, RunConclusion
from workers.tasks import process_pack


@pytest.fixture(scope="module")
def complete() -> list[CompleteRun]:
    items = [AdvanceRun(f"run_{seed}", spec(seed, generations=5), None, 60.0) for seed in (1, 2, 3)]
    runs = []
    for item in items:  # alone: a slow machine would leave the later ones of a pack
        (result,) = process_pack([item], ["short"], RECORDS["short"])
        assert isinstance(result.outcome, RunConclusion)
        runs.append(CompleteRun(item.run, item.spec, result.outcome, 0.25))
    return runs


def encode(complete: list[CompleteRun], **changes: bool) -> PackedResults:
    return ResultEncoder("sqlite", **changes)(complete, RECORDS)


def list_cells(packed: PackedResults) -> Iterator[Mapping[str, object]]:
    for row in packed.rows[0]:
        assert isinstance(row, tuple)
        yield dict(zip(RESULT_ROWS.columns, row, strict=True))


def test_layouts_name_columns_of_their_tables_in_the_types_of_postgresql() -> None:
    names = {"varchar": "text", "float": "double precision"}
    for layout in LAYOUTS:
        table = Base.metadata.tables[layout.table].c
        for name, kind in layout.columns.items():
            stored = table[name].type.compile(dialect=postgresql.dialect()).lower()
            assert kind == names.get(stored, stored), f"{layout.table}.{name}"


def test_a_row_has_the_values_of_its_run(complete: list[CompleteRun]) -> None:
    packed = encode(complete)
    found: list[Identification] = [run.concluded.identification for run in complete]
    for cells, run, one in zip(list_cells(packed), complete, found, strict=True):
        assert (cells["id"], cells["spec_hash"]) == (run.run, run.spec.reuse_key)
        assert (cells["best_rms"], cells["evaluations"]) == (one.rms, one.evaluations)
        assert (cells["generations"], cells["seconds"]) == (one.generations, 0.25)
        assert cells["fit_estimation"] == one.fit_percent.estimation
    assert packed.runs == ("run_1", "run_2", "run_3")
    assert packed.evaluations == sum(one.evaluations for one in found)
    assert packed.best_rms == min(one.rms for one in found)
    assert packed.estimates == {}
    told = encode(complete, reports_estimates=True).estimates
    assert told == {
        run.run: {one.name: one.value for one in run.concluded.identification.parameters}
        for run in complete
    }


def test_signals_of_a_pack_are_one_object_in_which_each_run_finds_its_file(
    complete: list[CompleteRun],
) -> None:
    packed = encode(complete)
    assert packed.signals_sha256 == sha256(packed.signals).hexdigest()
    for cells, run in zip(list_cells(packed), complete, strict=True):
        start, size = cells["signals_start"], cells["signals_size"]
        assert isinstance(start, int)
        assert isinstance(size, int)
        file = packed.signals[start : start + size]
        assert file == write_signals(run, RECORDS)
        (fit,) = read_fitted_outputs(file)
        assert fit.simulated.tobytes() == run.concluded.identification.simulated[0][0].tobytes()
        assert cells["signals_sha256"] == packed.signals_sha256


def test_the_signals_of_a_run_alone_are_the_whole_object(complete: list[CompleteRun]) -> None:
    packed = encode(complete[:1])
    (cells,) = list_cells(packed)
    assert (cells["signals_start"], cells["signals_size"]) == (None, None)
    assert packed.signals == write_signals(complete[0], RECORDS)


def test_signals_are_left_out_if_they_are_not_kept(complete: list[CompleteRun]) -> None:
    packed = encode(complete, keeps_signals=False)
    assert (packed.signals, packed.signals_sha256) == (b"", None)
    assert {cells["signals_sha256"] for cells in list_cells(packed)} == {None}


def test_an_outcome_that_is_written_one_by_one_has_the_columns_of_a_packed_one() -> None:
    names = {field.name for field in fields(RunOutcome)} - {"run_id", "state", "error"}
    assert names == {*RESULT_ROWS.columns} - {"id", "estimates"}


def test_rows_for_postgresql_are_tuples_of_its_binary_copy() -> None:
    row = ("é", None, True, -1.5, 7)
    layout = RowLayout(
        "t",
        {"a": "text", "b": "jsonb", "c": "boolean", "d": "double precision", "e": "bigint"},
    )
    assert pack_rows([row], layout, "sqlite") == [row]
    expected = struct.pack("!hi2sii?idiq", 5, 2, "é".encode(), -1, 1, True, 8, -1.5, 8, 7)
    assert pack_rows([row], layout, "postgresql") == expected


def test_a_worker_that_encodes_loads_no_sql() -> None:
    code = (
        "import sys, service.dispatch.encoding; "
        "print([name for name in ('sqlalchemy', 'obstore', 'fastapi') if name in sys.modules])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"
