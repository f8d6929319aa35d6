"""Time in which a process could not run does not count."""

from sysid.core.awake_clock import AwakeClock, read_awake_seconds


class System:
    """A clock of the system that is set."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_time_counts_while_naps_end_and_only_a_nap_of_a_standstill() -> None:
    system = System()
    clock = AwakeClock(1.0, system)
    for _ in range(10):
        system.now += 0.5
        clock.end_nap()
    assert clock.read() == 5.0
    system.now += 0.5
    assert clock.read() == 5.5  # within a nap it is as fine as the system's
    system.now += 7200.0
    assert clock.read() == 6.0
    clock.end_nap()
    assert clock.read() == 6.0
    system.now += 0.5
    assert clock.read() == 6.5


def test_the_clock_of_a_process_goes_on() -> None:
    first = read_awake_seconds()
    assert 0.0 <= first <= read_awake_seconds()
