"""Checkpoints: every bit comes back, what is damaged is refused, and nothing in them is run."""

import os
import pickle
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.dispatch import checkpoints
from service.dispatch.checkpoints import UnreadableCheckpoint, pack_state, unpack_state
from sysid.identification.run import advance_run, begin_run, is_finished
from sysid.islands.run_state import RunState
from tests.support.cluster.small_runs import RECORDS, spec
from tests.support.library.search_problems import bits
from workers.protocol import AdvanceRun, RunFailure
from workers.tasks import build_pack_problems, process_pack

HEADER = checkpoints._HEADER
SPEC = spec(generations=40)


@pytest.fixture(scope="module")
def state() -> RunState:
    problem = build_pack_problems(SPEC.problem, RECORDS)[0]
    state = begin_run(problem, SPEC.algorithm, 2**63 - 1)
    return advance_run(problem, SPEC.algorithm, state)


def test_everything_of_a_state_comes_back_bit_for_bit(state: RunState) -> None:
    back = unpack_state(pack_state(state))
    assert bits(back) == bits(state)
    assert (back.seed, back.seconds, back.is_warm) == (state.seed, state.seconds, state.is_warm)
    assert state.migrations
    assert all(island.history for island in state.islands)
    assert any(np.isfinite(island.archive).all(axis=1).any() for island in state.islands)
    for old, new in zip(state.islands, back.islands, strict=True):
        assert (new.seed, new.index) == (old.seed, old.index)
        for name, _ in checkpoints._ARRAYS[:-1]:
            before, after = getattr(old, name), getattr(new, name)
            assert (after.dtype, after.shape) == (before.dtype, before.shape)
        assert new.chromosomes.flags.writeable


def test_a_state_before_its_first_generation_comes_back(state: RunState) -> None:
    problem = build_pack_problems(SPEC.problem, RECORDS)[0]
    fresh = begin_run(problem, SPEC.algorithm, 1)
    assert bits(unpack_state(pack_state(fresh))) == bits(fresh)
    assert not is_finished(SPEC.algorithm, unpack_state(pack_state(fresh)))


class Planted:
    """Runs code where it is unpickled."""

    def __init__(self, file: Path) -> None:
        self._file = file

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self._file),)


def test_a_planted_pickle_is_refused_and_not_run(tmp_path: Path) -> None:
    planted = pickle.dumps(Planted(tmp_path / "ran"))
    older = HEADER.replace(b"state 1", b"state 0")
    for data in (planted, HEADER + planted, *(h + zlib.compress(planted) for h in (HEADER, older))):
        with pytest.raises(UnreadableCheckpoint):
            unpack_state(data)
    assert not (tmp_path / "ran").exists()
    pickle.loads(planted)
    assert (tmp_path / "ran").exists()  # so it would have


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content[:-8],
        lambda content: content + bytes(8),
        lambda content: content.replace(b'"index": 1', b'"index": 7'),
        lambda content: content.replace(b"[16, 7]", b"[14, 8]"),
        lambda content: content.replace(b"[8, 5]", b"[10, 4]"),
        lambda content: content.replace(b"[8, 5]", b"[-8, -5]"),
        lambda content: content.replace(b'"probe_count"', b'"step_total"'),
        lambda content: b"[" * 100_000 + content,
    ],
)
def test_what_does_not_fit_is_refused(state: RunState, change) -> None:
    content = zlib.decompress(pack_state(state)[len(HEADER) :])
    assert change(content) != content
    with pytest.raises(UnreadableCheckpoint, match="damaged"):
        unpack_state(HEADER + zlib.compress(change(content)))


def test_a_checkpoint_that_unpacks_to_more_than_the_limit_is_refused(
    state: RunState, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoints, "_MAX_BYTES", 1000)
    with pytest.raises(UnreadableCheckpoint, match="too long"):
        unpack_state(pack_state(state))


@given(data=st.data())
def test_changed_bytes_are_refused_or_give_a_state_of_the_same_shapes(data, state) -> None:
    content = bytearray(zlib.decompress(pack_state(state)[len(HEADER) :]))
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        back = unpack_state(HEADER + zlib.compress(bytes(content)))
    except UnreadableCheckpoint:
        return
    for island, other in zip(back.islands, state.islands, strict=True):
        assert [a.shape for a in island.arrays[:-1]] == [a.shape for a in other.arrays[:-1]]


def test_a_state_of_another_model_or_population_fails_its_run(state: RunState) -> None:
    larger = spec(generations=40, population=18)
    single = spec(generations=40, islands=1)
    coarse = spec(generations=40, bits=4)
    for other in (larger, single, coarse):
        (done,) = process_pack([AdvanceRun("r", other, state, 1.0)], ["short"], RECORDS["short"])
        assert isinstance(done.outcome, RunFailure)
        assert "its checkpoint is of another model" in done.outcome.reason
    (done,) = process_pack([AdvanceRun("r", SPEC, state, 9.0)], ["short"], RECORDS["short"])
    assert not isinstance(done.outcome, RunFailure)
