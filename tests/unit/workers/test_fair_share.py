"""Who goes next: laws of fair sharing, with workers whose time is simulated."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.cluster.simulated_executor import Theatre
from workers.fair_share import (
    HEADSTART_SECONDS,
    MAX_ABSENT_PROJECTS,
    MAX_SAVED_SECONDS,
    WAIT_TURN_INTERVAL,
    FairShare,
)
from workers.packing import PACK_SECONDS, PACKS_PER_CPU

pytestmark = pytest.mark.slow

DELAY_SECONDS = 2.0
"""A single identification is delayed by no more than this."""

SWEEP = 5000
"""Runs of 0.1 s: more than any play lasts."""


@pytest.mark.parametrize("slots", [1, 4])
@pytest.mark.parametrize("sweeps", [1, 20])
@pytest.mark.parametrize("seconds", [0.1, 12.0])
def test_sweeps_delay_a_single_identification_by_two_seconds_at_most(
    slots: int, sweeps: int, seconds: float
) -> None:
    theatre = Theatre(slots)
    for number in range(sweeps):
        theatre.add(f"sweep{number}", SWEEP, 0.1)
    theatre.play((HEADSTART_SECONDS + 5.0) * sweeps / slots)
    theatre.add("single", 1, seconds)
    # One core alone gives every sixteenth pack to the patient; more cores lose nothing by it.
    patient = seconds / (WAIT_TURN_INTERVAL - 1) if slots == 1 else 0.0
    assert theatre.until("single") <= seconds + patient + DELAY_SECONDS


def test_a_single_identification_does_not_wait_for_a_sweep_that_has_just_begun() -> None:
    theatre = Theatre(2)
    theatre.add("sweep", SWEEP, 0.1)
    theatre.play(3.0)
    theatre.add("single", 1, 3.0)
    assert theatre.until("single") <= 3.0 + DELAY_SECONDS


def test_sweeps_of_one_project_get_equal_parts_also_when_there_are_more_of_them_than_places() -> (
    None
):
    theatre = Theatre(2)
    names = [f"sweep{number}" for number in range(9)]
    for name in names:
        theatre.add(name, SWEEP, 0.1)
    theatre.play(250.0)
    parts = [theatre.had(name) for name in names]
    assert sum(parts) == pytest.approx(500.0, abs=2.0)  # no core was idle
    assert max(parts) - min(parts) <= 5 * PACK_SECONDS


def test_a_sweep_that_comes_later_is_not_made_to_wait_until_it_has_caught_up() -> None:
    theatre = Theatre(2)
    theatre.add("early", SWEEP, 0.1)
    theatre.play(100.0)
    theatre.add("late", SWEEP, 0.1)
    before = theatre.had("early")
    theatre.play(100.0)
    gained = theatre.had("early") - before
    assert theatre.had("late") + gained == pytest.approx(200.0, abs=2.0)
    assert theatre.had("late") - gained <= HEADSTART_SECONDS + 5 * PACK_SECONDS


def test_projects_share_equally_however_many_jobs_each_has() -> None:
    theatre = Theatre(2)
    for number in range(9):
        theatre.add(f"many{number}", SWEEP, 0.1, project="many")
    theatre.add("one", SWEEP, 0.1, project="one")
    theatre.play(400.0)
    many = sum(theatre.had(f"many{number}") for number in range(9))
    assert many - theatre.had("one") <= HEADSTART_SECONDS + 5 * PACK_SECONDS
    assert theatre.had("one") - many <= 5 * PACK_SECONDS


def test_a_project_cannot_get_more_by_cutting_its_sweep_into_short_jobs() -> None:
    theatre = Theatre(2)
    theatre.add("whole", SWEEP, 0.1, project="whole")
    number = 0
    while theatre.executor.now < 300.0:
        while len(theatre.feeder._jobs) < 6:
            number += 1
            theatre.add(f"cut{number}", 20, 0.1, project="cut")
        theatre.step()
    cut = sum(theatre.had(f"cut{n}") for n in range(1, number + 1))
    assert cut - theatre.had("whole") <= HEADSTART_SECONDS + 5 * PACK_SECONDS


@pytest.mark.parametrize("slots", [1, 2])
@pytest.mark.parametrize("seconds", [3.0, 45.0])
def test_a_project_cannot_get_more_by_sending_short_jobs_one_after_another(
    slots: int, seconds: float
) -> None:
    theatre = Theatre(slots)
    theatre.add("sweep", 5 * SWEEP, 0.1, project="sweep")
    number = 0
    while theatre.executor.now < 600.0 / slots:
        if len(theatre.feeder._jobs) < 2:  # the last one has ended, and its project has no job
            number += 1
            theatre.add(f"short{number}", int(10 * seconds), 0.1, project="short")
        theatre.step()
    short = sum(theatre.had(f"short{n}") for n in range(1, number + 1))
    assert short - theatre.had("sweep") <= HEADSTART_SECONDS + 5 * PACK_SECONDS
    assert theatre.had("sweep") - short <= 5 * PACK_SECONDS


def test_what_a_project_had_is_forgotten_when_the_others_have_caught_up() -> None:
    shares: FairShare[str] = FairShare()
    shares.open_account("sweep", project="sweep")
    shares.open_account("short", project="short")
    shares.charge_seconds("short", 29.0)
    shares.close_account("short")
    assert len(shares._projects) == 2
    shares.charge_seconds("sweep", 30.0)
    shares.open_account("other", project="other")
    shares.close_account("other")
    assert len(shares._projects) == 1
    shares.close_account("sweep")
    assert len(shares._projects) == 0


def test_accounts_of_projects_without_jobs_are_bounded_in_number() -> None:
    shares: FairShare[int] = FairShare()
    shares.open_account(-1, project="sweep")
    for number in range(3 * MAX_ABSENT_PROJECTS):
        shares.open_account(number, project=f"p{number}")
        shares.charge_seconds(number, 1.0 + number % 7)
        shares.close_account(number)
    assert len(shares._projects) == MAX_ABSENT_PROJECTS + 1


def test_packs_in_flight_count_for_their_project_as_if_they_had_been_charged() -> None:
    shares: FairShare[str] = FairShare()
    for job, project in (("a1", "a"), ("a2", "a"), ("b1", "b")):
        shares.open_account(job, project=project)
    assert shares.order_jobs({"a1": 4, "a2": 0, "b1": 1}) == ["b1", "a2", "a1"]
    assert shares.order_jobs({"a1": 1, "a2": 0, "b1": 4}) == ["a2", "a1", "b1"]


def test_unused_time_is_saved_for_later_up_to_a_limit() -> None:
    shares: FairShare[str] = FairShare()
    for project in ("greedy", "modest"):
        shares.open_account(project, project=project)
    shares.charge_seconds("greedy", 10 * MAX_SAVED_SECONDS)
    shares.charge_seconds("modest", MAX_SAVED_SECONDS - 1.0)
    in_flight = {"greedy": 0, "modest": 0}
    assert shares.order_jobs(in_flight) == ["modest", "greedy"]
    shares.charge_seconds("modest", 2.0)
    assert shares.order_jobs(in_flight) == ["greedy", "modest"]


def test_of_two_jobs_of_a_project_one_saves_no_more_than_the_limit() -> None:
    shares: FairShare[str] = FairShare()
    for job in ("early", "late"):
        shares.open_account(job, project="one")
        shares.charge_seconds(job, HEADSTART_SECONDS)
    shares.charge_seconds("early", 10 * MAX_SAVED_SECONDS)
    shares.charge_seconds("late", MAX_SAVED_SECONDS - 1.0)
    in_flight = {"early": 0, "late": 0}
    assert shares.order_jobs(in_flight) == ["late", "early"]
    shares.charge_seconds("late", 2.0)
    assert shares.order_jobs(in_flight) == ["early", "late"]


def test_a_project_that_asked_for_little_cannot_save_the_rest_for_later() -> None:
    theatre = Theatre(2)
    theatre.add("greedy", 5 * SWEEP, 0.1, project="greedy")
    theatre.add("modest", 1, 1e6, project="modest")  # one core is all it can use
    theatre.add("modest2", 1, 1.0, project="modest")
    theatre.play(400.0)
    theatre.add("burst", SWEEP, 0.1, project="modest")
    before = theatre.had("greedy")
    theatre.play(200.0)
    gained = theatre.had("greedy") - before
    assert gained >= (400.0 - MAX_SAVED_SECONDS - HEADSTART_SECONDS) / 2 - 5 * PACK_SECONDS


def test_a_higher_priority_goes_first_and_the_lower_one_still_gets_its_sixteenth() -> None:
    theatre = Theatre(2)
    theatre.add("low", SWEEP, 0.1, priority=0)
    theatre.play(50.0)
    theatre.add("high", SWEEP, 0.1, priority=5)
    before = theatre.had("low")
    theatre.play(160.0)
    part = (theatre.had("low") - before) / 320.0
    assert part == pytest.approx(1 / WAIT_TURN_INTERVAL, rel=0.25)


def test_the_sixteenth_pack_goes_to_each_of_those_that_wait_in_turn() -> None:
    theatre = Theatre(2)
    for name in ("low", "lower"):
        theatre.add(name, SWEEP, 0.1, priority=0)
    theatre.play(3 * HEADSTART_SECONDS)
    theatre.add("high", SWEEP, 0.1, priority=5)
    before = {name: theatre.had(name) for name in ("low", "lower")}
    theatre.play(160.0)
    for name, seconds in before.items():
        part = (theatre.had(name) - seconds) / 320.0
        assert part == pytest.approx(0.5 / WAIT_TURN_INTERVAL, rel=0.25)


def test_a_priority_beats_even_a_new_identification_of_a_lower_one() -> None:
    theatre = Theatre(1)
    theatre.add("high", 100, 0.1, priority=1)
    theatre.step()
    theatre.add("low", 1, 3.0, priority=0)
    theatre.until("low")
    assert theatre.ended["high"] < theatre.ended["low"]


def test_nobody_starves_under_a_stream_of_new_jobs() -> None:
    theatre = Theatre(1)
    theatre.add("sweep", SWEEP, 0.1)
    theatre.play(HEADSTART_SECONDS + 1.0)
    before, number = theatre.had("sweep"), 0
    begun = theatre.executor.now
    while theatre.executor.now < begun + 160.0:
        while len(theatre.feeder._jobs) < 3:
            number += 1
            theatre.add(f"new{number}", 1, 1.0)
        theatre.step()
    assert theatre.had("sweep") - before >= 0.8 * 160.0 / WAIT_TURN_INTERVAL


def test_a_project_takes_no_more_cores_than_it_may() -> None:
    theatre = Theatre(4, project_cores=3)
    theatre.add("a", SWEEP, 0.1, project="a")
    theatre.add("b", SWEEP, 0.1, project="a")
    theatre.play(20.0)
    assert theatre.had("a") + theatre.had("b") == pytest.approx(60.0, abs=2.0)


def test_cores_that_one_project_may_not_take_are_for_the_others() -> None:
    theatre = Theatre(4, project_cores=3)
    theatre.add("a", SWEEP, 0.1, project="a")
    theatre.add("b", SWEEP, 0.1, project="b")
    theatre.play(20.0)
    assert theatre.had("a") + theatre.had("b") == pytest.approx(80.0, abs=2.0)


def test_a_lonely_sweep_has_a_pack_waiting_at_every_core() -> None:
    theatre = Theatre(4)
    theatre.add("sweep", SWEEP, 0.1)
    theatre.play(20.0)
    assert theatre.executor.most_waiting == (PACKS_PER_CPU - 1) * 4


def test_new_workers_are_given_work_at_once() -> None:
    theatre = Theatre(1)
    theatre.add("sweep", SWEEP, 0.1)
    theatre.play(10.0)
    theatre.executor.slots = 3
    before = theatre.had("sweep")
    theatre.play(20.0)
    assert theatre.had("sweep") - before == pytest.approx(60.0, abs=3.0)


jobs = st.lists(
    st.tuples(st.integers(0, 2), st.sampled_from("ab"), st.integers(1, 30), st.floats(0.01, 2.0)),
    min_size=1,
    max_size=8,
)


@given(jobs, st.integers(1, 5))
def test_no_core_is_idle_while_work_waits_and_every_job_ends(
    sizes: list[tuple[int, str, int, float]], slots: int
) -> None:
    theatre = Theatre(slots)
    for number, (priority, project, runs, seconds) in enumerate(sizes):
        theatre.add(f"j{number}", runs, seconds, priority=priority, project=project)
    total = sum(runs * seconds for _, _, runs, seconds in sizes)
    while theatre.feeder._jobs:
        theatre.step()
    assert len(theatre.ended) == len(sizes)
    longest = max(seconds for *_, seconds in sizes)
    assert theatre.executor.now <= total / slots + longest + 3 * PACK_SECONDS


@given(st.lists(st.floats(0.0, 100.0), max_size=20), st.sampled_from("abc"))
def test_the_order_holds_every_job_once(charges: list[float], project: str) -> None:
    shares: FairShare[str] = FairShare()
    for number, name in enumerate("abc"):
        shares.open_account(name, priority=number % 2, project=name)
    for seconds in charges:
        shares.record_pack(project)
        shares.charge_seconds(project, seconds)
        assert sorted(shares.order_jobs(dict.fromkeys("abc", 1))) == ["a", "b", "c"]
