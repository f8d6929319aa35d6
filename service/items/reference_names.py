"""Names of references, which jobs and paths distinguish from runs."""

from service.core.errors import InvalidRequest

RUN_PREFIX = "run_"
REFERENCE_PREFIX = "reference:"
MAX_NAME_CHARACTERS = 100


def check_reference_name(name: str, pointer: str) -> None:
    """Refuse names that look like a run's id or like parts of a path.

    Raises
    ------
    InvalidRequest
        At the pointer.
    """
    requirement = find_name_fault(name)
    if requirement is not None:
        place = "the name in the path is " if pointer.startswith("{") else "found "
        raise InvalidRequest.from_fault(pointer, f"{place}{name!r:.120}; need {requirement}")


def find_name_fault(name: str) -> str | None:
    """Return what a name of a reference must be, if this one is not; else None."""
    if not 1 <= len(name) <= MAX_NAME_CHARACTERS or not name.isprintable() or name != name.strip():
        return f"1 to {MAX_NAME_CHARACTERS} printable characters without outer blanks"
    if name.startswith((RUN_PREFIX, REFERENCE_PREFIX)):
        return (
            f"one that does not begin with {RUN_PREFIX!r} (as run ids do) or {REFERENCE_PREFIX!r}"
        )
    if "/" in name or not name.strip("."):
        return "one without '/', and not of dots only"
    return None
