"""What to do about a file that cannot be used, by an option of the reader."""

from sysid.core.errors import Advice, UnreadableFile

GIVE_PERIOD = Advice("give the sampling period with ", "sample_time", ".")


def build_period_error(period: object) -> UnreadableFile:
    """Return the error of a sampling period that is none."""
    text = f" is {period!r}; need a positive number of seconds"
    return UnreadableFile("", Advice("", "sample_time", text))
