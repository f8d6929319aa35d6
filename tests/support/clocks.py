"""A clock of seconds that only tests turn."""


class SecondsClock:
    """Stands at `now`, in seconds, until a test sets another time."""

    def __init__(self, now: float = 0.0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now
