"""Whether a main loop turns or stands."""

import threading

from service.core.process.loop_watch import LoopWatch, allow_long_step, report_turn


class Watch:
    """A watch whose time is set."""

    def __init__(self) -> None:
        self.now = 100.0
        self.loop = LoopWatch(lambda: self.now)


def test_a_loop_stands_from_its_last_turn_until_the_next() -> None:
    watch = Watch()
    watch.now += 50
    assert watch.loop.standing_seconds == 0.0  # it has not begun
    watch.loop.turn()
    watch.now += 7
    assert watch.loop.standing_seconds == 7.0
    watch.loop.turn()
    assert watch.loop.standing_seconds == 0.0
    watch.now += 7
    watch.loop.end()
    assert watch.loop.standing_seconds == 0.0


def test_a_loop_that_waits_for_what_may_come_turns_and_other_threads_do_not_turn_it() -> None:
    watch = Watch()
    watch.loop.turn()
    watch.now += 5
    other = threading.Thread(target=report_turn)
    other.start()
    other.join()
    assert watch.loop.standing_seconds == 5.0
    report_turn()
    assert watch.loop.standing_seconds == 0.0


def test_a_long_step_stands_only_after_its_time() -> None:
    watch = Watch()
    watch.loop.turn()
    with allow_long_step(60.0):
        watch.now += 59
        assert watch.loop.standing_seconds == 0.0
        watch.now += 3
        assert watch.loop.standing_seconds == 2.0
    assert watch.loop.standing_seconds == 0.0
