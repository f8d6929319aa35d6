"""What follows a search hears the run's time: clocks here go on by themselves, by no measured time.

A clock that stands tells that all is done; one that is late from the first, that only what a result
needs is; one that ends in between, that what was left out is told.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, Stop
from sysid.identification.conclude import conclude_run
from sysid.identification.deadline import Deadline
from sysid.identification.run import advance_run, begin_run
from sysid.search import least_squares
from sysid.search.least_squares import N_TRIED
from sysid.search.refine import refine_candidates
from tests.support.library.search_problems import example

NEAR = np.array([0.22, 0.52, 5.1, 1.1])
APART = np.array([0.25, 0.6, 5.6, 1.3])
LIMITED = GeneticAlgorithm(population=32, generations=3, islands=2, stop=Stop(seconds=100.0))
SAID = "the time limit ended least squares before"


def make_question(late_after: int) -> Callable[[], bool]:
    """A question that is answered with no so many times."""
    times: list[None] = []

    def is_late() -> bool:
        times.append(None)
        return len(times) > late_after

    return is_late


def test_a_deadline_is_over_at_its_limit_and_a_tenth_of_it_later_past_grace() -> None:
    now = [0.0]
    one = Deadline(20.0, 15.0, lambda: now[0])
    assert (one.seconds_left, one.is_over(), one.is_past_grace()) == (5.0, False, False)
    now[0] = 5.0
    assert (one.seconds_left, one.is_over(), one.is_past_grace()) == (0.0, True, False)
    now[0] = 7.0
    assert one.is_past_grace()
    assert not Deadline(None, 1e9, lambda: now[0]).is_over()


def test_grace_is_neither_nothing_nor_without_end() -> None:
    assert not Deadline(1e-3, 1e-3 + 0.1, lambda: 0.0).is_past_grace()
    assert Deadline(1e6, 1e6 + 11.0, lambda: 0.0).is_past_grace()


def test_least_squares_that_is_late_ends_between_its_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = example()
    whole = refine_candidates(problem, [NEAR])[0]
    monkeypatch.setattr(
        least_squares, "_STEPS_PER_CALL", problem.n_steps * (4 + N_TRIED)
    )  # a step a call
    [first] = refine_candidates(problem, [NEAR], None, make_question(0))
    [second] = refine_candidates(problem, [NEAR], None, make_question(1))
    never = refine_candidates(problem, [NEAR], None, make_question(10**6))[0]
    assert whole is not None
    assert first is not None
    assert second is not None
    assert never is not None
    assert [one.is_cut_short for one in (first, second, never, whole)] == [True, True, False, False]
    assert first.evaluations < second.evaluations < whole.evaluations
    assert problem.evaluate_fitness(NEAR[None])[0] > first.rms > second.rms > whole.rms
    assert never.theta.tobytes() == whole.theta.tobytes()
    assert first.rms == problem.evaluate_fitness(first.theta[None])[0]


def test_late_no_other_start_is_begun_with_and_the_best_one_tells() -> None:
    problem = example()
    best, other = refine_candidates(problem, [NEAR, APART], None, make_question(0))
    assert best is not None
    assert best.is_cut_short
    assert other is None
    ends = refine_candidates(problem, [NEAR, APART])
    assert [end is not None and not end.is_cut_short for end in ends] == [True, True]


def test_a_run_that_is_late_has_a_whole_result_that_tells_what_was_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = example()
    monkeypatch.setattr(
        least_squares, "_STEPS_PER_CALL", problem.n_steps * (4 + N_TRIED)
    )  # a step a call
    state = advance_run(problem, LIMITED, begin_run(problem, LIMITED, 1))
    in_time = conclude_run(problem, LIMITED, replace(state, seconds=0.0), clock=lambda: 0.0)
    late = conclude_run(problem, LIMITED, replace(state, seconds=1e9), clock=lambda: 0.0)
    assert [any(SAID in text for text in one.warnings) for one in (in_time, late)] == [False, True]
    assert late.rms <= state.rms
    assert all(one.stderr is not None for one in late.parameters)
    assert late.covariance is not None
    assert late.residual_tests.tests


def test_without_a_limit_no_clock_is_heard() -> None:
    problem = example()
    free = replace(LIMITED, stop=Stop())
    state = advance_run(problem, free, begin_run(problem, free, 1))
    found = conclude_run(problem, free, replace(state, seconds=1e9), clock=lambda: 1e12)
    assert found.parameters == conclude_run(problem, free, state).parameters
    assert not any(SAID in text for text in found.warnings)
