"""Column types that behave the same on SQLite and on PostgreSQL."""

from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, TypeAlias

from sqlalchemy import JSON, BigInteger, DateTime, Dialect, Enum, Integer, String, TypeDecorator
from sqlalchemy.dialects.postgresql import JSONB

from service.core.bodies.json_text import write_json
from service.core.bodies.text_checks import find_text_fault
from service.storage.storage_errors import UnstorableValue

Document: TypeAlias = dict[str, Any]
"""A JSON object."""

DocumentType = JSON(none_as_null=True).with_variant(JSONB(none_as_null=True), "postgresql")
"""JSON text on SQLite, JSONB on PostgreSQL; None is NULL."""
OrderedJsonType = JSON(none_as_null=True)
"""JSON with its order of keys: JSONB sorts them, but a search draws parameters in that order."""

LargeInteger = BigInteger().with_variant(Integer(), "sqlite")
"""64 bits on both: SQLite calls that INTEGER, and numbers rows with this type only."""


def utc_now() -> datetime:
    """Return the present time, with its time zone."""
    return datetime.now(UTC)


class UtcDateTime(TypeDecorator[datetime]):
    """A moment that is stored with a time zone and read in UTC, on SQLite as well."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return the moment in UTC.

        SQLite stores no zone, so that all its texts compare as times.
        """
        if value is None:
            return None
        if value.tzinfo is None:
            raise UnstorableValue(f"the time {value.isoformat()} has no time zone")
        moment = value.astimezone(UTC)
        return moment.replace(tzinfo=None) if dialect.name == "sqlite" else moment

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return the stored moment, aware and in UTC."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class TextT(TypeDecorator[str]):
    """A text that both databases can store: no NUL, no half of a surrogate pair."""

    impl = String
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | None:
        """Return the text, if it can be stored."""
        fault = None if value is None else find_text_fault(value)
        if fault is not None:
            raise UnstorableValue(fault)
        return value


def to_json(value: object) -> str:
    """Return the JSON text of a document; refuse what PostgreSQL would refuse or alter."""
    try:
        return write_json(value)
    except ValueError as error:
        raise UnstorableValue(str(error)) from error


def make_state_type(states: type[StrEnum]) -> Enum:
    """Make the column type of a state: a text, so that no migration must alter a type."""
    return Enum(
        states,
        native_enum=False,
        length=16,
        values_callable=lambda kind: [state.value for state in kind],
    )
