"""What to do about a file that cannot be used, by an option of the reader."""

from sysid.core.errors import Advice, UnreadableFile

LEAVE_CLOCK = Advice("leave out ", "clock")
_MAX_NAMED = 12  # columns in a proposal of names

GIVE_PERIOD = Advice("give the sampling period with ", "sample_time", ".")


def name_columns(count: int, *, has_times: bool) -> Advice:
    """Advise to name columns: ``t,c1,c2`` if the first one may be the time, else ``c1,c2``."""
    names = [f"c{number}" for number in range(1 - has_times, count + 1 - has_times)]
    names[: int(has_times)] = ["t"] * has_times
    listed = ",".join(names[:_MAX_NAMED] + ["…"] * (count > _MAX_NAMED))
    after = "" if has_times else ". Call the one of times t, or give the sampling period too"
    return Advice("name its columns with ", "columns", f"={listed}{after}")


def build_period_error(period: object) -> UnreadableFile:
    """Return the error of a sampling period that is none."""
    text = f" is {period!r}; need a positive number of seconds"
    return UnreadableFile("", Advice("", "sample_time", text))
