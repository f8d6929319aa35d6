"""Log lines carry the ids of the work, as text and as JSON."""

import json
import logging
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from typing import Any

import pytest

from service.core.process.logs import (
    JsonFormatter,
    TextFormatter,
    bind_ids,
    bind_request,
    configure_logging,
    get_ids,
)


def make_record(message: str = "%d runs", *values: object, **extra: object) -> logging.LogRecord:
    """A record as a logger makes it."""
    logger = logging.getLogger("lagid.dispatcher")
    error = sys.exc_info() if sys.exc_info()[0] else None
    return logger.makeRecord(
        logger.name, logging.INFO, "file", 1, message, values or (3,), error, extra=extra
    )


def format_json(record: logging.LogRecord) -> dict[str, Any]:
    text = JsonFormatter().format(record)
    assert "\n" not in text
    line: dict[str, Any] = json.loads(text)
    return line


def test_a_json_line_has_time_level_message_and_the_ids_of_the_work() -> None:
    with bind_ids(job_id="job_1", attempt=2):
        line = format_json(make_record(run_id="run_7"))
    assert line["message"] == "3 runs"
    assert line["level"] == "INFO"
    assert line["time"].endswith("+00:00")
    ids = {name: line[name] for name in ("job_id", "run_id", "attempt")}
    assert ids == {"job_id": "job_1", "run_id": "run_7", "attempt": 2}
    assert "request_id" not in line


def test_a_line_without_ids_has_none() -> None:
    assert not {"job_id", "run_id", "attempt", "request_id"} & set(format_json(make_record()))
    assert "[" not in TextFormatter().format(make_record())


def test_a_traceback_is_part_of_the_one_json_line() -> None:
    try:
        raise ValueError("no\nway")
    except ValueError:
        line = format_json(make_record())
    assert "ValueError: no" in line["error"]


def test_a_text_line_names_the_ids_after_the_message() -> None:
    with bind_ids(job_id="job_1", attempt=2):
        text = TextFormatter().format(make_record())
    assert text.endswith("INFO lagid.dispatcher: 3 runs [job_id=job_1 attempt=2]")


def test_ids_of_a_block_end_with_it_and_add_to_those_outside() -> None:
    with bind_ids(request_id="r1"):
        with bind_ids(job_id="job_1"):
            assert get_ids() == {"request_id": "r1", "job_id": "job_1"}
        assert get_ids() == {"request_id": "r1"}
    assert get_ids() == {}


def test_the_id_of_a_request_stays_in_its_task() -> None:
    copy_context().run(bind_request, "r1")
    with ThreadPoolExecutor(1) as pool:
        pool.submit(bind_request, "r2").result()
    assert get_ids() == {}


@contextmanager
def bare_root() -> Iterator[None]:
    """The root logger without the handlers of pytest."""
    logger = logging.getLogger()
    handlers, level = logger.handlers[:], logger.level
    logger.handlers[:] = []
    yield
    logger.handlers[:] = handlers
    logger.setLevel(level)
    for name in ("lagid", "lagid.access", "service", "workers", "sysid"):
        logging.getLogger(name).setLevel(logging.NOTSET)


@pytest.mark.parametrize("with_access", [False, True])
def test_the_access_log_is_written_only_where_it_is_wanted(
    capsys: pytest.CaptureFixture[str], with_access: bool
) -> None:
    with bare_root():
        configure_logging("json", logging.WARNING, with_access=with_access)
        logging.getLogger("lagid.access").info("GET / 200", extra={"status": 200})
        logging.getLogger("service.jobs").info("not of interest")
        logging.getLogger("alembic").info("of a library")
        logging.getLogger("service.jobs").warning("of interest")
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    access = [line["status"] for line in lines if line["logger"] == "lagid.access"]
    assert access == ([200] if with_access else [])
    assert [line["message"] for line in lines if "status" not in line] == ["of interest"]
