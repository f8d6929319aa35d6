"""Signals that a sweep does not store are computed again: the file is the same, byte for byte."""

from io import BytesIO
from pathlib import Path
from typing import Any

import pytest

from service.core.errors import Conflict
from service.core.states import JobState
from service.datasets import stored_recordings
from service.datasets.datasets import add_recording
from service.formats.mcap.mcap_files import write_fitted_outputs
from service.jobs.stored_run import load_run
from service.repositories.dataset_rows import DatasetRepository
from service.runs.fitted import load_fitted_signals
from service.storage.sessions import Database
from service.storage.storage_errors import ObjectStoreFailed
from service.storage.tables import Run
from sysid.data.records import Recording
from tests.support.cluster.dispatch_place import Place, carry_out
from tests.support.cluster.inline_executor import InlineExecutor
from tests.support.cluster.small_runs import step_record
from tests.support.library import polynomials

SMALL = {"population": 16, "generations": 15, "islands": 1}
SEEDS = {"axes": [{"path": "/seed", "range": [0, 2]}]}
NOISE = {"sigma": 0.02, "seed": 3}
POLYNOMIAL = {
    "name": "two",
    "form": "difference",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {"a": {"lower": 0, "upper": 1}, "g": {"lower": 0, "upper": 5}},
    "equations": {"x": "a*x(k-1) + g*u(k-7)"},
    "outputs": {"y": "x"},
}
CASES: dict[str, dict[str, Any]] = {
    "noise": {"noise": NOISE},
    "last part": {"noise": NOISE, "validation": {"fraction": 0.3}},
    "other data": {"noise": NOISE, "validation": {"datasets": ["other"]}, "skip": 2},
    "one step": {"model": POLYNOMIAL, "parameters": {}, "prediction": "one-step"},
    "start is free": {"model": {**POLYNOMIAL, "initial": {"x": 0}}, "parameters": {}},
    "coloured": {"loss": {"noise_model": "ar1"}, "noise": NOISE},
    "held": {"hold": {"u": "first"}, "validation": {"fraction": 0.3}},
    "tied": {"parameters": {"K": {"tied": "2*T"}, "T": {"upper": 10.0}, "L": {"fixed": 0.7}}},
    "selected terms": {
        "model": polynomials.document(polynomials.frols(3), coefficients={"lower": -5, "upper": 5}),
        "parameters": {},
        "noise": NOISE,
    },
    "integrator": {"model": "ipdt", "parameters": {}, "validation": {"fraction": 0.2}},
}


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return make_place(tmp_path / "data")


def make_place(folder: Path, database: Database | None = None) -> Place:
    made = Place(folder, database)
    other = step_record(150, seed=8)
    add_recording(
        made.database,
        made.store,
        Recording((*other.inputs, *other.outputs)),
        name="other",
        kind="upload",
        key="other",
        details={"warnings": []},
    )
    return made


def carry_out_sweep(place: Place, **body: Any) -> list[Run]:
    job = place.submit(**{"algorithm": SMALL, "sweep": SEEDS, **body})
    carry_out(place, job, InlineExecutor())
    return list(place.runs(job))


def read_stored(place: Place, run: Run) -> bytes:
    assert run.signals_sha256 is not None
    whole = place.store.get_bytes(run.signals_sha256)
    if run.signals_start is None or run.signals_size is None:
        return whole
    return whole[run.signals_start : run.signals_start + run.signals_size]


def compute_again(place: Place, run: str) -> bytes:
    with place.database.read_session() as session:
        fits = load_fitted_signals(session, place.store, load_run(session, run))
    assert fits is not None
    target = BytesIO()
    write_fitted_outputs(fits, target)
    return target.getvalue()


@pytest.mark.parametrize("body", CASES.values(), ids=CASES.keys())
def test_signals_are_the_bytes_that_would_have_been_stored(
    place: Place, body: dict[str, Any]
) -> None:
    check_signals(place, body)


def test_signals_are_computed_again_on_each_database(tmp_path: Path, database: Database) -> None:
    check_signals(make_place(tmp_path / "data", database), CASES["last part"])


def check_signals(place: Place, body: dict[str, Any]) -> None:
    """Check that the signals of a sweep that stored them are computed again byte for byte."""
    runs = carry_out_sweep(place, **body, keep_signals=True)
    stored = [read_stored(place, run) for run in runs]
    with place.database.write_session() as session:
        for run in runs:
            session.get_one(Run, run.id).signals_sha256 = None
    assert [compute_again(place, run.id) for run in runs] == stored


@pytest.mark.parametrize(
    ("body", "is_kept"),
    [
        ({"sweep": SEEDS}, False),
        ({"sweep": SEEDS, "keep_signals": True}, True),
        ({"sweep": {}}, True),
        ({"sweep": {}, "keep_signals": False}, False),
    ],
)
def test_a_sweep_stores_no_signals_and_a_single_run_does_unless_the_job_says_otherwise(
    place: Place, body: dict[str, Any], is_kept: bool
) -> None:
    runs = carry_out_sweep(place, **body)
    assert {run.state for run in runs} == {JobState.SUCCEEDED}
    assert {run.signals_sha256 is not None for run in runs} == {is_kept}


def test_a_store_that_is_down_is_not_told_as_a_deleted_dataset(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    (run, _) = carry_out_sweep(place)

    def fail(*_: object) -> bytes:
        raise ObjectStoreFailed("the store is down")

    monkeypatch.setattr(type(place.store), "get_bytes", fail)
    monkeypatch.setattr(stored_recordings, "_recording_cache", stored_recordings._RecordingCache())
    with pytest.raises(ObjectStoreFailed, match="the store is down"):
        compute_again(place, run.id)


def test_signals_that_cannot_be_computed_again_say_why(place: Place) -> None:
    (run, _) = carry_out_sweep(place)
    with place.database.write_session() as session:
        DatasetRepository(session).delete(place.dataset)
    with pytest.raises(Conflict, match="are not stored, and cannot be computed again: there is no"):
        compute_again(place, run.id)
