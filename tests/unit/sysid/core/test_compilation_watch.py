"""Compiling is announced once where it takes long, and is no time of a search."""

from functools import cache

import pytest

from sysid.core import jit
from sysid.core.jit import COMPILATION_NOTE, CompilationWatch, announce_compilation
from tests.support.clocks import SecondsClock


@pytest.fixture
def clock() -> SecondsClock:
    return SecondsClock(100.0)


@pytest.fixture
def watch(clock: SecondsClock, monkeypatch: pytest.MonkeyPatch) -> CompilationWatch:
    """A watch of a process that has compiled nothing."""
    monkeypatch.setattr(jit, "_announce_once", cache(jit._announce_once.__wrapped__))
    return CompilationWatch(clock)


def test_the_clock_stands_still_while_functions_are_compiled(
    watch: CompilationWatch, clock: SecondsClock
) -> None:
    start = watch.read_clock()
    clock.now += 2
    with watch.watch_function():
        watch.begin("sysid.data.interpolation")
        clock.now += 30
        with watch.watch_function():  # a function that the first one calls
            watch.begin("sysid.data.interpolation")
            clock.now += 5
            assert watch.read_clock() - start == 2
        clock.now += 10
    clock.now += 1
    assert watch.read_clock() - start == 3


def test_a_function_that_is_loaded_takes_its_time(
    watch: CompilationWatch, clock: SecondsClock
) -> None:
    start = watch.read_clock()
    with watch.watch_function():
        clock.now += 4
    assert watch.read_clock() - start == 4


def test_the_clock_goes_on_after_a_compilation_that_is_interrupted(
    watch: CompilationWatch, clock: SecondsClock
) -> None:
    def compile_interrupted(depth: int) -> None:
        with watch.watch_function():
            watch.begin("sysid.data.interpolation")
            clock.now += 7
            if depth == 0:
                raise KeyboardInterrupt
            compile_interrupted(depth - 1)

    start = watch.read_clock()
    with pytest.raises(KeyboardInterrupt):
        compile_interrupted(1)
    clock.now += 1
    assert watch.read_clock() - start == 1


def test_only_the_search_is_announced_and_only_once(
    watch: CompilationWatch, capsys: pytest.CaptureFixture[str]
) -> None:
    watch.begin("sysid.search.evolution")
    assert capsys.readouterr() == ("", "")
    watch.begin("sysid.islands.evolve")
    watch.begin("sysid.islands.evolve")
    assert capsys.readouterr() == ("", f"{COMPILATION_NOTE}\n")


def test_what_is_compiled_unwatched_does_not_stop_the_clock(
    watch: CompilationWatch, clock: SecondsClock
) -> None:
    start = watch.read_clock()
    watch.begin("sysid.data.interpolation")
    clock.now += 3
    assert watch.read_clock() - start == 3


def test_the_function_that_is_announced_is_there() -> None:
    from sysid.islands import evolve

    assert evolve.__name__ == jit._LONG_TO_COMPILE
    assert hasattr(evolve._run_epochs, "signatures")


def test_a_program_may_tell_it_by_other_means(
    watch: CompilationWatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lines: list[str] = []
    with announce_compilation(lines.append):
        watch.begin("sysid.islands.evolve")
    assert lines == [COMPILATION_NOTE]
    assert capsys.readouterr() == ("", "")


def test_a_compiled_function_is_watched_and_a_stored_one_is_not(
    tmp_path: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))

    def double(x: float) -> float:
        return 2 * x

    before = jit._watch.seconds
    assert jit.jit_compile(double)(2.0) == 4.0
    compiled = jit._watch.seconds
    assert compiled > before
    assert jit.jit_compile(double)(3.0) == 6.0  # another function object, from the cache
    assert jit._watch.seconds == compiled
