"""Read arrays and tables of other libraries as channels: pandas, xarray, polars, lists.

No such library is imported. An object is recognised by what it offers: a table has `columns`, a
series has an `index`, an array of xarray has `dims`. Names, units and times are read as in files,
by the rules of `sysid.data.table_rules`. Of xarray and pandas the attribute ``units`` is the unit.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from os import PathLike
from typing import Any, NamedTuple, TypeAlias
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sysid.core.errors import InvalidRecord, suggest_name
from sysid.core.lazy_names import load_library
from sysid.core.types import FloatArray
from sysid.data.table_rules import (
    NO_NAMES,
    CellKind,
    Heading,
    TimeAxis,
    count_from_first,
    find_time_column,
    find_time_unit,
    find_unit_seconds,
    is_index_name,
    is_time_name,
    read_number_times,
    read_spans,
    split_headings,
    tell_notes,
)

Labelled: TypeAlias = Any
"""A table, series or array of another library, with names and times."""

_MIXED_ZONES = "some dates have a time zone and others have none; give all of them one"
_MAX_VALUE = 60  # characters of a value that a message shows
_NEED_TIMES = "need seconds, dates or time spans"


class Column(NamedTuple):
    """A named series of values with its times; the values are not read yet.

    The label is the name before its unit was split off.
    """

    label: str
    name: str
    unit: str
    axis: TimeAxis
    values: Any


def read_numbers(source: ArrayLike, owner: str) -> FloatArray:
    """Read numbers of shape (N,) or (N, 1) as an array (N,) of float64 that compiled code takes.

    Raises
    ------
    InvalidRecord
        If there is text, a date or a complex number, or another shape; `owner` begins the message.
    """
    if type(source) is np.ndarray and source.dtype == np.float64:
        array = source
    else:
        array = _convert_numbers(source, owner)
    if array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    return np.require(array, np.float64, ["C", "A", "W"])


def _convert_numbers(source: ArrayLike, owner: str) -> FloatArray:
    kind = _find_kind(source)
    if kind in "mMUSTcV":
        what = {"m": "time spans", "M": "dates", "c": "complex numbers", "V": "records"}
        found = what.get(kind) or _describe_first_text(source)
        raise InvalidRecord(f"{owner} has {found}; need numbers")
    if isinstance(source, np.ma.MaskedArray):
        return np.asarray(np.ma.filled(source.astype(np.float64), np.nan))
    try:
        return np.asarray(source, dtype=np.float64)
    except (TypeError, ValueError) as error:
        numbers = _read_missing_as_nan(source)
        if numbers is None:
            if text := _describe_first_text(source):
                raise InvalidRecord(f"{owner} has {text}; need numbers") from None
            raise InvalidRecord(f"{owner} cannot be read as numbers: {error}") from None
        return numbers


def _describe_first_text(source: Any) -> str:
    """Describe the first text among values, and where it is; empty if there is none."""
    items = enumerate(np.asarray(source, dtype=object).flat, 1)
    texts = (
        f"text: {str(item)[:40]!r} at sample {number}"
        for number, item in items
        if isinstance(item, str | bytes)
    )
    return next(texts, "")


def _read_missing_as_nan(source: Any) -> FloatArray | None:
    """Read a series of pandas in which a missing value is no number."""
    try:
        return np.asarray(source.to_numpy(dtype=np.float64, na_value=np.nan))
    except (AttributeError, TypeError, ValueError):
        return None


def _find_kind(source: Any) -> str:
    """Find the kind of an array's elements as NumPy letters do; ``T`` is any text."""
    name = str(getattr(source, "dtype", ""))
    if name.startswith("datetime64"):
        return "M"
    try:
        array = np.asarray(source)
    except (TypeError, ValueError):  # rows of different length
        return "O"
    if array.dtype.kind != "O":
        return array.dtype.kind
    first = next((item for item in array.flat if item is not None and item == item), None)
    if isinstance(first, str | bytes):
        return "T"
    return "M" if isinstance(first, datetime) else "m" if isinstance(first, timedelta) else "O"


def read_times(source: Any, owner: str) -> TimeAxis:
    """Read seconds, dates or time spans of shape (N,) or (N, 1).

    Raises
    ------
    InvalidRecord
        If they are none of these, or one is missing; `owner` begins the message.
    """
    if type(source) is np.ndarray and source.dtype == np.float64:
        return TimeAxis(read_numbers(source, owner))
    kind = _find_kind(source)
    if kind == "M":
        return _read_dates(source, owner)
    if kind == "m":
        spans = np.asarray(source, dtype="timedelta64[ns]").ravel()
        _refuse_missing(spans, owner)
        return TimeAxis(read_spans(spans))
    if kind in "UST":
        first = str(next(iter(np.asarray(source).flat)))
        raise InvalidRecord(
            f"{owner} are text such as {first!r}; {_NEED_TIMES}. pandas.to_datetime reads dates."
        )
    return TimeAxis(read_numbers(source, owner))


def _read_dates(source: Any, owner: str) -> TimeAxis:
    if str(getattr(source, "dtype", "object")) == "object":
        return _read_date_objects(source, owner)
    dates = np.asarray(source, dtype="datetime64[ns]").ravel()
    _refuse_missing(dates, owner)
    if not dates.size:
        return TimeAxis(np.zeros(0))
    seconds, first = count_from_first(dates)
    kind = getattr(source, "dtype", None)
    named = getattr(kind, "time_zone", None)  # of polars; pandas has the zone itself
    zone = ZoneInfo(named) if isinstance(named, str) else getattr(kind, "tz", None)
    return TimeAxis(seconds, first if zone is None else first.replace(tzinfo=UTC).astimezone(zone))


def _read_date_objects(source: Any, owner: str) -> TimeAxis:
    dates = list(np.asarray(source, dtype=object).flat)
    for date in dates:
        if not isinstance(date, datetime) or date != date:
            raise InvalidRecord(f"{owner} have {date!r} among dates; need a date at every sample")
    try:
        seconds = [(date - dates[0]).total_seconds() for date in dates]
    except TypeError:
        raise InvalidRecord(f"{owner}: {_MIXED_ZONES}") from None
    first = dates[0].to_pydatetime() if hasattr(dates[0], "to_pydatetime") else dates[0]
    return TimeAxis(np.array(seconds, dtype=np.float64), first)


def _refuse_missing(times: NDArray[Any], owner: str) -> None:
    missing = np.flatnonzero(np.isnat(times))
    if missing.size:
        raise InvalidRecord(
            f"{owner} have {missing.size} missing dates, the first at sample {missing[0] + 1}; "
            "need a date at every sample"
        )


def is_labelled(source: Any) -> bool:
    """Test whether an object is a table, series or array with names, and no plain array."""
    return _find_reader(source) is not None


def split_series(source: Any, owner: str) -> tuple[TimeAxis, Any, str]:
    """Split a single series with its own times into times, values and unit.

    Raises
    ------
    InvalidRecord
        If it is none, or has no times.
    """
    columns = read_columns(source, owner) if is_labelled(source) else []
    if len(columns) != 1:
        raise InvalidRecord(
            f"{owner} has no values. Give times and values, or one series whose index is the time."
        )
    return columns[0].axis, columns[0].values, columns[0].unit


def read_columns(source: Labelled, owner: str, names: Sequence[str] | None = None) -> list[Column]:
    """Read the columns of a table, series, array of xarray or mapping of arrays.

    The values stay unread. With `names` only these columns are listed, in this order.

    Raises
    ------
    InvalidRecord
        If the object is not labelled or has no times, a name is missing or occurs twice.
    """
    reader = _find_reader(source)
    if reader is None:
        raise InvalidRecord(f"{owner}: {describe_object(source)} has no names of channels")
    columns = reader(source, owner)
    if columns and not columns[0].axis.seconds.size:
        raise InvalidRecord(f"{owner} has no rows; need one or more")
    by_name = {column.name: column for column in columns}
    if len(by_name) < len(columns):
        twice = next(c.name for c in columns if sum(d.name == c.name for d in columns) > 1)
        raise InvalidRecord(f"{owner} has more than one column {twice!r}; rename one")
    if names is None:
        return columns
    for name in names:
        if name not in by_name:
            raise InvalidRecord(f"{owner} has no column {name!r}{suggest_name(name, by_name)}")
    return [by_name[name] for name in names]


def to_frame(columns: Sequence[Column]) -> Any:
    """Return columns as a table of pandas, as `read_columns` reads it: ``P1 [bar]`` over ``t``.

    The index has dates if the moment of time 0 s is known, else seconds. A column without a sample
    at some time of another has a gap there.

    Raises
    ------
    MissingLibrary
        If pandas is not installed.
    InvalidRecord
        If times repeat, and not all columns have the same.
    """
    pandas = load_library("pandas", "to_pandas()")
    series = []
    for column in columns:
        seconds, start, _ = column.axis
        index = pandas.Index(seconds, name="t")
        if start is not None:
            spans = pandas.to_timedelta(np.round(seconds * 1e9).astype(np.int64))
            index = pandas.DatetimeIndex(pandas.Timestamp(start) + spans, name="time")
        series.append(pandas.Series(column.values, index, name=column.label))
    is_shared = all(one.index.equals(series[0].index) for one in series)
    if not is_shared and not all(one.index.is_unique for one in series):
        raise InvalidRecord("times repeat, and differ between channels; make a table of each alone")
    if not series:
        return pandas.DataFrame()
    return pandas.concat(series, axis=1, sort=not is_shared)


def describe_object(source: Any) -> str:
    """Describe a wrong object in a few words, such as ``the text 'a.csv'``."""
    if isinstance(source, str | PathLike):
        text, kind = str(source), "text" if isinstance(source, str) else "path"
        return f"the {kind} {text if len(text) < 60 else text[:57] + '…'!r}"
    shape = getattr(source, "shape", None)
    size = f" of shape {tuple(shape)}" if isinstance(shape, tuple) else ""
    return f"an object of type {type(source).__name__}{size}"


def describe_value(value: object) -> str:
    """Describe a wrong value: as it is written if that is short, else by its kind."""
    text = repr(value) if getattr(value, "shape", None) is None else ""
    return text if 0 < len(text) <= _MAX_VALUE and "\n" not in text else describe_object(value)


def _find_reader(source: Any) -> Callable[[Any, str], list[Column]] | None:
    if isinstance(source, type):
        return None
    if hasattr(source, "data_vars"):
        return _read_dataset
    if hasattr(source, "dims") and hasattr(source, "coords"):
        return _read_data_array
    if hasattr(source, "columns") and hasattr(source, "__getitem__"):
        return _read_frame
    if hasattr(source, "index") and hasattr(source, "name") and hasattr(source, "to_numpy"):
        return _read_series
    if isinstance(source, Mapping):
        return lambda table, owner: _read_mapping(table, owner)
    return _read_structured if getattr(getattr(source, "dtype", None), "names", None) else None


def _read_series(series: Any, owner: str) -> list[Column]:
    axis = _read_index(series.index, owner)
    if axis is None:
        raise InvalidRecord(
            f"{owner}: the index of the series counts its rows. Set the time as its index, in "
            "seconds or as dates."
        )
    return [_name_column(series.name, series, "", axis)]


def _read_frame(frame: Any, owner: str) -> list[Column]:
    names = list(frame.columns)
    if any(isinstance(name, tuple) for name in names):
        raise InvalidRecord(f"{owner}: the table has names of several levels; flatten them")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InvalidRecord(f"{owner} has more than one column {twice!r}; rename one")
    index = getattr(frame, "index", None)
    axis = None if index is None else _read_index(index, owner)
    return _read_mapping({name: frame[name] for name in names}, owner, axis)


def _read_structured(array: Any, owner: str) -> list[Column]:
    return _read_mapping({name: array[name] for name in array.dtype.names}, owner)


def _read_mapping(
    table: Mapping[Any, Any], owner: str, axis: TimeAxis | None = None
) -> list[Column]:
    """Read columns over an axis, else over the column that has the times."""
    labels = list(table)
    split = split_headings([str(label) for label in labels])
    headings = [
        Heading(name, unit, _classify_column(name, table[label]))
        for label, (name, unit) in zip(labels, split, strict=True)
    ]
    time = None
    if axis is None:
        time = find_time_column(headings)
        if time is None:
            raise InvalidRecord(
                f"{owner} has no times. Name the column of seconds or dates 't' or 'time', or make "
                f"it the index. Columns: {', '.join(map(str, labels)) or 'none'}"
            )
        axis = _read_labelled_times(headings[time], table[labels[time]], f"the times of {owner}")
    columns = []
    for position, (label, heading) in enumerate(zip(labels, headings, strict=True)):
        if position == time:
            continue
        if heading.kind == "count":
            tell_notes(
                [f"column {str(label) or 'no name'} of {owner} counts rows and was left out"]
            )
            continue
        if is_index_name(heading.name) and heading.name.lower() not in NO_NAMES:
            tell_notes([f"column {heading.name!r} does not count the rows, so it is a signal"])
        unit = heading.unit or _find_unit_attribute(table[label])
        columns.append(Column(str(label), heading.name, unit, axis, table[label]))
    return columns


def _classify_column(name: str, values: Any) -> CellKind:
    """Return what a column holds, as for a file; texts and other objects are not looked into."""
    kind = _find_kind(values)
    if kind == "M":
        return "stamp"
    if is_index_name(name) and kind in "iuf" and _counts_rows(np.asarray(values).ravel()):
        return "count"
    return "number"


def _counts_rows(values: NDArray[Any]) -> bool:
    """Whether numbers count from 0 or 1."""
    is_count = values.size > 1 and values[0] in (0, 1)
    return is_count and np.array_equal(values, values[0] + np.arange(values.size))


def _read_index(index: Any, owner: str) -> TimeAxis | None:
    """Read the times of an index; None if it only counts rows."""
    label = getattr(index, "name", None)
    ((name, unit),) = split_headings(["" if label is None else str(label)])
    numbers_rows = _find_kind(index) in "iu" and not is_time_name(name)
    if numbers_rows or getattr(index, "nlevels", 1) > 1:
        return None
    heading = Heading(name or "t", unit, "number")  # an index without a name is one of times
    return _read_labelled_times(heading, index, f"the index of {owner}: its times")


def _read_labelled_times(heading: Heading, source: Any, owner: str) -> TimeAxis:
    """Read times whose heading may have their unit, such as ``t [ms]``."""
    axis = read_times(source, owner)
    finite = axis.seconds.size > 0 and bool(np.all(np.isfinite(axis.seconds)))
    if axis.started_at is not None or not finite or _find_kind(source) == "m":
        return axis
    unit = find_time_unit(heading.name, heading.unit)
    if find_unit_seconds(unit) is None:
        raise InvalidRecord(f"{owner} are in {unit!r}, which is no unit of time such as s or min")
    notes: list[str] = []
    axis = read_number_times(axis.seconds, heading.name, unit, notes)
    tell_notes(notes)
    return axis


def _read_dataset(dataset: Any, owner: str) -> list[Column]:
    return [
        column for name in dataset.data_vars for column in _read_data_array(dataset[name], owner)
    ]


def _read_data_array(array: Any, owner: str) -> list[Column]:
    """Read an array of xarray over its dimension of time; another one lists channels."""
    label = f"array {array.name!r} of {owner}" if array.name is not None else owner
    times = [name for name in array.dims if _is_time(array, name)]
    others = [name for name in array.dims if name not in times[:1]]
    if not times or len(others) > 1:
        raise InvalidRecord(
            f"{label} has dimensions {', '.join(map(str, array.dims)) or 'none'}; need one of time "
            "with its coordinate, and at most one of channels"
        )
    ((name, unit),) = split_headings([str(times[0])])
    heading = Heading(name, unit, "number")
    axis = _read_labelled_times(heading, array.coords[times[0]], f"the times of {label}")
    if not others:
        return [_name_column(array.name, array, "", axis)]
    parts = [array.isel({others[0]: number}) for number in range(array.sizes[others[0]])]
    names = (
        [str(part.coords[others[0]].item()) for part in parts]
        if others[0] in array.coords
        else [f"{array.name or others[0]}{number + 1}" for number in range(len(parts))]
    )
    return [_name_column(name, part, name, axis) for name, part in zip(names, parts, strict=True)]


def _is_time(array: Any, name: Any) -> bool:
    if name not in array.coords:
        return False
    is_named = is_time_name(split_headings([str(name)])[0][0])
    return is_named or _find_kind(array.coords[name]) in "mMf"


def _name_column(label: Any, values: Any, otherwise: str, axis: TimeAxis) -> Column:
    """Build a column with name and unit of its label, and the unit of its attributes."""
    text = otherwise if label is None else str(label)
    ((name, unit),) = split_headings([text])
    return Column(text, name, unit or _find_unit_attribute(values), axis, values)


def _find_unit_attribute(values: Any) -> str:
    attributes = getattr(values, "attrs", None) or {}
    return str(attributes.get("units") or attributes.get("unit") or "1")


def find_first_start(starts: Iterable[datetime | None]) -> datetime | None:
    """Find the first of some moments; None if there is none.

    Raises
    ------
    InvalidRecord
        If only some of them have a time zone.
    """
    try:
        return min((start for start in starts if start is not None), default=None)
    except TypeError:
        raise InvalidRecord(_MIXED_ZONES) from None


def measure_distance(later: datetime, earlier: datetime) -> float:
    """Measure the seconds from one moment to another; raises as `find_first_start`."""
    try:
        return (later - earlier).total_seconds()
    except TypeError:
        raise InvalidRecord(_MIXED_ZONES) from None
