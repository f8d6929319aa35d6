"""Parts of the installation that a user chooses: `pip install 'lagid[server]'`."""

import re
from collections.abc import Collection
from importlib.metadata import PackageNotFoundError, distribution, requires

from service.core.errors import Misconfigured

_OF_AN_EXTRA = re.compile(r"(?P<name>[\w.-]+)[^;]*;.*\bextra == ['\"](?P<extra>[\w-]+)['\"]")


def check_extra(extra: str, purpose: str, libraries: Collection[str] | None = None) -> None:
    """Check that the libraries of an extra are installed, before a command needs one of them.

    Parameters
    ----------
    purpose : str
        What needs it, as the subject of the message.
    libraries : collection of str, optional
        Those of the extra that are needed; by default all.

    Raises
    ------
    Misconfigured
        If one is missing; the message has the command that installs it.
    """
    missing = [name for name in list_missing(extra) if libraries is None or name in libraries]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise Misconfigured(
            f"{purpose} needs {missing[0]}{more}, not installed here: pip install 'lagid[{extra}]'"
        )


def list_missing(extra: str) -> list[str]:
    """List the libraries of an extra that are not installed."""
    return [name for name in _list_libraries(extra) if not _is_installed(name)]


def _list_libraries(extra: str) -> list[str]:
    """List the libraries of an extra; none for a checkout that is not installed."""
    try:
        lines = requires("lagid") or []
    except PackageNotFoundError:
        return []
    found = [match for line in lines if (match := _OF_AN_EXTRA.match(line))]
    return [match["name"] for match in found if match["extra"] == extra]


def _is_installed(name: str) -> bool:
    try:
        distribution(name)
    except PackageNotFoundError:
        return False
    return True
