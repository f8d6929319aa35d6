"""Files of whole columns: arrays of NumPy, and Parquet."""

import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.lib.format import read_array
from numpy.typing import NDArray

from service.formats.advice import name_columns
from service.formats.read_options import ReadOptions
from service.formats.tabular.table_columns import (
    ColumnValues,
    Table,
    build_missing_time_error,
    holds_numbers,
    parse_texts,
)
from service.formats.tabular.table_layout import (
    PEEK_ROWS,
    TableColumn,
    assign_roles,
    check_count,
    classify_cells,
    read_headings,
)
from sysid.core.errors import UnreadableFile
from sysid.core.types import IntArray
from sysid.data.table_rules import CellKind, Heading, is_temperature_name, is_time_name

if TYPE_CHECKING:
    import polars as pl

PERIOD_NAMES: Final = ("ts", "dt", "sample_time", "sampletime", "sampling_time", "sample_period")
RATE_NAMES: Final = ("fs", "sample_rate", "samplerate", "sampling_rate", "sampling_frequency")
DAMAGES: Final = (
    *(ValueError, TypeError, KeyError, IndexError, OSError, EOFError, AttributeError),
    *(NotImplementedError, zlib.error, struct.error, zipfile.BadZipFile),
)
"""What readers of binary files raise on damaged ones."""


def read_numpy(path: Path, options: ReadOptions, notes: list[str]) -> Table:
    """Read the arrays of an ``.npz`` file, or the fields or columns of an ``.npy`` file."""
    try:
        arrays = _read_arrays(path)
    except DAMAGES as error:
        raise build_damage_error("NumPy", error) from None
    if "" in arrays:
        arrays = _split_matrix(arrays[""], options)
    return build_array_table(arrays, options, notes)


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read arrays by name; `read_array` runs nothing that a file holds: objects are refused."""
    with path.open("rb") as stream:
        if not zipfile.is_zipfile(stream):
            stream.seek(0)
            array = read_array(stream)
            return {name: array[name] for name in array.dtype.names or ()} or {"": array}
        with zipfile.ZipFile(stream) as archive:
            arrays = {}
            for name in archive.namelist():
                with archive.open(name) as member:
                    arrays[name.removesuffix(".npy")] = read_array(member)
            return arrays


def _split_matrix(matrix: NDArray[Any], options: ReadOptions) -> dict[str, NDArray[Any]]:
    """Split an array without names into its columns, which the user named."""
    if matrix.ndim not in (1, 2):
        raise UnreadableFile(f"the array has {matrix.ndim} dimensions; need rows and columns")
    matrix = matrix.reshape(matrix.shape[0], -1)
    if not options.columns:
        raise UnreadableFile(
            "the .npy file holds one array without names; write np.savez(file, t=t, u=u, y=y), or ",
            name_columns(matrix.shape[1], has_times=False),
        )
    return {f"c{number}": column for number, column in enumerate(matrix.T, 1)}


def build_array_table(arrays: Mapping[str, Any], options: ReadOptions, notes: list[str]) -> Table:
    """Build the table of arrays by name; a scalar may be the sampling period.

    Raises
    ------
    UnreadableFile
        If there is no signal or no time.
    """
    columns, left_out = _collect_columns(arrays)
    sample_time = options.sample_time
    names = [name for name, _ in read_headings(options.columns or list(columns))]
    times = [name for name in names if is_time_name(name) and not is_temperature_name(name)]
    if sample_time is None and not times:
        sample_time = _find_period(arrays, notes)
    if left_out:
        notes.append(f"{', '.join(left_out)} hold no samples of a signal and were left out")
    return build_column_table(columns, replace(options, sample_time=sample_time))


def _collect_columns(arrays: Mapping[str, Any]) -> tuple[dict[str, ColumnValues], list[str]]:
    """Collect arrays of one length; a matrix gives a column for each of its signals."""
    values = {name: np.asarray(value) for name, value in arrays.items()}
    signals = {name: array for name, array in values.items() if is_signal(array)}
    length = _find_length(signals)
    columns: dict[str, ColumnValues] = {}
    for name, array in signals.items():
        matrix = array.reshape(array.shape[0], -1) if array.ndim > 1 else array[:, np.newaxis]
        if matrix.shape[0] != length and matrix.shape[1] == length:
            matrix = matrix.T
        if matrix.shape[0] != length:
            continue
        width = matrix.shape[1]
        for i in range(width):
            columns[name if width == 1 else f"{name}{i + 1}"] = matrix[:, i]
    used = {name for name in signals if name in columns or f"{name}1" in columns}
    left_out = [n for n in values if n not in used and n.lower() not in PERIOD_NAMES + RATE_NAMES]
    return columns, left_out


def is_signal(array: NDArray[Any]) -> bool:
    """Whether an array may hold the samples of a signal."""
    return array.size > 1 and array.ndim in (1, 2) and array.dtype.kind in "fiubMU"


def _find_length(signals: Mapping[str, NDArray[Any]]) -> int:
    """Find the number of samples: that of the times, or the most common one."""
    if not signals:
        raise UnreadableFile("the file holds no arrays of samples; need t, u and y, for example")
    for name, array in signals.items():
        if is_time_name(name):
            return int(max(array.shape))
    counts = Counter(int(max(array.shape)) for array in signals.values())
    return max(counts, key=lambda length: (counts[length], length))


def _find_period(arrays: Mapping[str, Any], notes: list[str]) -> float | None:
    """Find a sampling period or rate among the arrays: ``Ts`` in s, or ``fs`` in Hz."""
    for name, value in arrays.items():
        scalar = np.asarray(value)
        if scalar.size != 1 or scalar.dtype.kind not in "fiu" or scalar.item() <= 0:
            continue
        if name.lower() in (*PERIOD_NAMES, *RATE_NAMES):
            number = float(scalar.item())
            period = number if name.lower() in PERIOD_NAMES else 1.0 / number
            notes.append(f"the sampling period of {period:.6g} s was taken from {name!r}")
            return period
    return None


def read_parquet(path: Path, options: ReadOptions, notes: list[str]) -> Table:
    """Read the columns of a Parquet file, by the library of the extra `parquet`."""
    try:
        import polars as pl
    except ModuleNotFoundError:
        raise UnreadableFile(
            "a Parquet file needs polars, not installed here: pip install 'lagid[parquet]'"
        ) from None
    try:
        scan = pl.scan_parquet(path, glob=False)
        names = scan.collect_schema().names()
        rows = int(scan.select(pl.len()).collect().item())
        limits = options.limits
        if len(names) > limits.channels + len(options.segments) + 1 or rows > limits.messages:
            raise UnreadableFile(
                f"the file has {len(names)} columns and {rows} rows; at most {limits.channels} "
                f"signals and {limits.messages} rows are read"
            )
        frame = scan.collect()
    except pl.exceptions.PolarsError as error:
        raise build_damage_error("Parquet", error) from None
    columns: dict[str, ColumnValues] = {}
    in_utc, spans = set(), set()
    for series in frame:
        values = _convert_series(series)
        if values is None:
            notes.append(f"column {series.name!r} holds {series.dtype} and was left out")
            continue
        columns[series.name] = values
        if isinstance(series.dtype, pl.Datetime) and series.dtype.time_zone is not None:
            in_utc.add(series.name)
        if series.dtype == pl.Duration:
            spans.add(series.name)
    return build_column_table(columns, options, in_utc=in_utc, spans=spans)


def _convert_series(series: "pl.Series") -> ColumnValues | None:
    """Convert a column of a table; None if it holds lists or other composite values."""
    import polars as pl

    kind = series.dtype
    if isinstance(kind, pl.Datetime):
        if kind.time_zone is not None:
            series = series.dt.convert_time_zone("UTC").dt.replace_time_zone(None)
        return np.asarray(series.to_numpy(), dtype="datetime64[ns]")
    if kind == pl.Date:
        return np.asarray(series.to_numpy(), dtype="datetime64[ns]")
    if kind == pl.Duration:
        return np.asarray(series.dt.total_nanoseconds().cast(pl.Float64).to_numpy()) / 1e9
    if kind.is_numeric() or kind == pl.Boolean:
        return np.asarray(series.cast(pl.Float64).to_numpy())
    if kind in (pl.String, pl.Categorical, pl.Time) or isinstance(kind, pl.Enum):
        return np.array(series.cast(pl.String).fill_null("").to_list(), dtype=np.str_)
    return None


def build_column_table(
    columns: Mapping[str, ColumnValues],
    options: ReadOptions,
    *,
    in_utc: Collection[str] = (),
    spans: Collection[str] = (),
) -> Table:
    """Build the table of columns of equal length by their names.

    Parameters
    ----------
    in_utc : collection of str
        Columns of time stamps in UTC; others are local.
    spans : collection of str
        Columns of time spans, which are in s whatever their heading says.

    Raises
    ------
    UnreadableFile
        If there is no signal or no time, or a text is no number.
    """
    if not columns or not len(next(iter(columns.values()))):
        raise UnreadableFile("the file holds no samples")
    if options.columns:
        check_count(options.columns, len(columns), has_times=False)
    names = list(options.columns or columns)
    headings = [
        Heading(name, "s" if label in spans else unit, _classify_values(values, name))
        for (name, unit), (label, values) in zip(read_headings(names), columns.items(), strict=True)
    ]
    roles = assign_roles(headings, options, None)
    rows = np.arange(1, len(next(iter(columns.values()))) + 1)
    bad_words = Counter[tuple[str, str]]()
    values = tuple(
        _convert_values(role, column, rows, bad_words)
        for role, column in zip(roles, columns.values(), strict=True)
    )
    is_utc = any(
        role.role == "time" and label in in_utc for role, label in zip(roles, columns, strict=True)
    )
    return Table(roles, values, rows, options.sample_time, is_utc, bad_words)


def _classify_values(values: ColumnValues, name: str) -> CellKind:
    if values.dtype.kind == "M":
        return "stamp"
    if values.dtype.kind == "U":
        return classify_cells([str(text) for text in values[:PEEK_ROWS]], name)
    peek = [f"{value:.17g}" for value in values[:PEEK_ROWS].tolist()]
    return classify_cells(peek, name)


def _convert_values(
    column: TableColumn,
    values: ColumnValues,
    rows: IntArray,
    bad_words: Counter[tuple[str, str]],
) -> ColumnValues:
    """Convert the values of a column to numbers, texts or time stamps, and check them."""
    if values.dtype.kind == "U":
        texts = [str(text).strip() for text in values]
        if holds_numbers(column):
            return parse_texts(column, texts, rows, bad_words)
        return np.array(texts, dtype=np.str_)
    if values.dtype.kind == "M":
        if column.role == "time" and (missing := np.flatnonzero(np.isnat(values))).size:
            raise build_missing_time_error("NaT", int(rows[missing[0]]), column.name)
        return np.asarray(values, dtype="datetime64[ns]")
    numbers = np.asarray(values, dtype=np.float64)
    wrong = np.flatnonzero(~np.isfinite(numbers))
    if column.role == "time" and wrong.size:
        text = repr(float(numbers[wrong[0]]))
        raise build_missing_time_error(text, int(rows[wrong[0]]), column.name)
    infinite = np.flatnonzero(np.isinf(numbers))
    if column.role == "value" and infinite.size:
        raise UnreadableFile(
            "the value is infinite; values must be finite (NaN is a missing value)",
            row=int(rows[infinite[0]]),
            column=column.name,
        )
    return numbers


def build_damage_error(kind: str, error: Exception) -> UnreadableFile:
    """Return the error of a file that its library cannot read."""
    reason = " ".join(str(error).split())
    if reason.startswith("Object arrays"):
        reason = "an array holds Python objects; write arrays of numbers"
    return UnreadableFile(f"the {kind} file cannot be read: {reason[:120]}")
