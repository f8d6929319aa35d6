"""Work on a database that is away for a while is done when it is back."""

import pytest
from sqlalchemy.exc import IntegrityError, OperationalError

from service.storage import patience


def away() -> OperationalError:
    return OperationalError("SELECT 1", {}, Exception("connection refused"))


def test_work_is_tried_until_the_database_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patience, "PAUSE_SECONDS", 0.0)
    troubles = [away(), away()]

    def work() -> str:
        if troubles:
            raise troubles.pop()
        return "done"

    assert patience.patiently(work) == "done"


def test_a_database_that_does_not_come_back_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patience, "PAUSE_SECONDS", 0.0)
    monkeypatch.setattr(patience, "LONGEST_SECONDS", 0.0)

    def work() -> None:
        raise away()

    with pytest.raises(OperationalError):
        patience.patiently(work)


def test_a_fault_of_the_statement_is_not_tried_again() -> None:
    tries = []

    def work() -> None:
        tries.append(1)
        raise IntegrityError("INSERT", {}, Exception("duplicate"))

    with pytest.raises(IntegrityError):
        patience.patiently(work)
    assert len(tries) == 1
