"""Log lines of all processes: text for people, or JSON for machines, with the ids of the work.

What is bound by `bind_ids` is in every line that the same thread or task writes later. A request
takes its ids into the threads that work for it.
"""

import json
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any, Literal

from service.core.bodies.text_checks import escape_controls

LogFormat = Literal["text", "json"]

ID_NAMES = ("request_id", "job_id", "run_id", "attempt")
"""Ids of a line, in this order."""
ACCESS_NAMES = ("method", "path", "route", "status", "seconds")
"""What a line of the access log has besides its ids."""
ACCESS_LOGGER = "lagid.access"
_OWN_LOGGERS = ("lagid", "service", "workers", "sysid")
_TEXT_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"

_ids: ContextVar[Mapping[str, object]] = ContextVar("ids", default={})  # noqa: B039 - never changed


@contextmanager
def bind_ids(**ids: object) -> Iterator[None]:
    """Add ids to the lines of this thread or task during the block.

    Examples
    --------
    >>> with bind_ids(job_id="job_1", attempt=2):
    ...     get_ids()
    {'job_id': 'job_1', 'attempt': 2}
    """
    token = _ids.set({**_ids.get(), **ids})
    try:
        yield
    finally:
        _ids.reset(token)


def bind_request(request_id: str) -> None:
    """Bind the id of a request for the rest of its task, also for the server's own lines."""
    _ids.set({**_ids.get(), "request_id": request_id})


def get_ids() -> Mapping[str, object]:
    """Return the ids that are bound here."""
    return _ids.get()


class TextFormatter(logging.Formatter):
    """Lines for people; the ids follow the message in brackets."""

    def __init__(self) -> None:
        super().__init__(_TEXT_FORMAT)

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - name of logging
        """Format the line without its traceback; nothing in it begins a line of its own."""
        line, ids = super().formatMessage(record), _collect_ids(record)
        listed = " ".join(f"{name}={value}" for name, value in ids.items())
        return escape_controls(f"{line} [{listed}]" if listed else line)

    def formatException(self, ei: Any) -> str:  # noqa: N802 - name of logging
        """Format a traceback, whose lines are its own."""
        return escape_controls(super().formatException(ei), but="\n")


class JsonFormatter(logging.Formatter):
    """One JSON object a line; `time` is UTC, and `error` holds a traceback."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a record with its traceback as one line."""
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "process": record.process,
            "message": record.getMessage(),
            **_collect_ids(record),
        }
        line |= {name: vars(record)[name] for name in ACCESS_NAMES if name in vars(record)}
        if record.exc_info:
            line["error"] = self.formatException(record.exc_info)
        return escape_controls(json.dumps(line, ensure_ascii=False, default=str))


def _collect_ids(record: logging.LogRecord) -> dict[str, object]:
    """Collect the ids of a line: what is bound, and what the call gave as `extra`."""
    known = {**_ids.get(), **vars(record)}
    return {name: known[name] for name in ID_NAMES if known.get(name) is not None}


def configure_logging(
    log_format: LogFormat = "text", level: int = logging.INFO, *, with_access: bool = False
) -> None:
    """Let this process write its log lines to standard error.

    Parameters
    ----------
    log_format : {"text", "json"}
        Form of the lines.
    level : int
        Lowest level of lagid's own lines that is written.
    with_access : bool
        Whether each request has a line of its own.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(JsonFormatter() if log_format == "json" else TextFormatter())
    logging.basicConfig(level=logging.WARNING, handlers=[handler])  # of libraries: warnings only
    for name in _OWN_LOGGERS:
        logging.getLogger(name).setLevel(level)
    logging.getLogger(ACCESS_LOGGER).setLevel(logging.INFO if with_access else logging.WARNING)
