"""Make a recording of the columns of a table: times, segments, channels, and notes."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import floor, log10
from shlex import quote

import numpy as np

from service.formats.advice import GIVE_PERIOD
from service.formats.read_options import ReadOptions
from service.formats.tabular.bad_values import apply_status_columns, mask_markers
from service.formats.tabular.cells import begins_like_number, classify_cell
from service.formats.tabular.exclusions import KeptRows, exclude_ranges
from service.formats.tabular.long_tables import (
    TableSignal,
    find_long_table,
    has_sparse_rows,
    list_signals,
    list_wide_signals,
    sort_rows,
)
from service.formats.tabular.table_columns import (
    ColumnValues,
    Table,
    holds_numbers,
    parse_texts,
    shorten_text,
)
from service.formats.tabular.table_layout import TableColumn, build_nameless_error
from service.formats.tabular.time_columns import (
    join_dates,
    parse_stamps,
    read_clock_times,
    read_stamp_times,
)
from sysid.core.errors import Advice, UnreadableFile
from sysid.core.types import BoolArray, FloatArray, IntArray
from sysid.data.records import Channel, Recording, Segment
from sysid.data.table_rules import (
    NO_NAMES,
    TimeAxis,
    counts_rows,
    is_index_name,
    read_number_times,
)
from sysid.inspection.row_order import repair_order

SegmentLabels = Mapping[str, float | str]


def concatenate_segments(
    times: FloatArray, starts: IntArray, labels: Sequence[SegmentLabels]
) -> tuple[FloatArray, tuple[Segment, ...]]:
    """Place segments, whose own times may all begin at 0, on one time axis.

    Segment i begins at i steps. The step is the smallest of 1, 2, 5, 10, … · 10ᵏ s that is longer
    than every segment. So the position of a segment is easily read and its times stay exact.

    Parameters
    ----------
    times : FloatArray, shape (N,)
        Times of each segment in s, increasing within the segment.
    starts : IntArray, shape (n_segments,)
        Index of the first sample of each segment.
    labels : sequence of mappings, n_segments long
    """
    lasts = np.append(starts[1:], times.size) - 1
    step = _round_up_step(float(np.max(times[lasts] - times[starts])))
    axis = np.empty_like(times)
    segments = []
    for i, (first, last) in enumerate(zip(starts, lasts, strict=True)):
        origin, start = float(times[first]), i * step
        # Rounded to the ns of a file's clock, so that a stored time is read back unchanged.
        axis[first : last + 1] = np.round(start + (times[first : last + 1] - origin), 9)
        segments.append(Segment(start, float(axis[last]), origin, dict(labels[i])))
    return axis, tuple(segments)


def _round_up_step(longest: float) -> float:
    if longest <= 0:
        return 1.0
    decade = 10.0 ** floor(log10(longest))
    return next(step for m in (1, 2, 5, 10, 20) if (step := m * decade) > longest)


def build_recording(table: Table, options: ReadOptions, notes: list[str]) -> Recording:
    """Build the recording of a table; each guess and each finding becomes a note.

    Raises
    ------
    UnreadableFile
        If the columns cannot be used, with the row and the column.
    """
    table = apply_status_columns(_name_signals(table, notes), notes)
    labels = [column.name for column in table.columns if column.role == "label"]
    starts = _find_segment_starts(table, labels)
    clock = _build_times(table, starts, notes)
    long = find_long_table(table, clock.seconds, starts)
    if long is not None:
        long, clock = sort_rows(long, clock, starts)
        table = long.table
    has_own_rows = long is not None or has_sparse_rows(table, clock.seconds, starts)
    if not has_own_rows and not labels and table.sample_time is None:
        table, clock, starts = _repair_order(table, clock, notes)
    _check_left_out(table, notes)
    if not has_own_rows or (long is None and np.any(_find_falls(clock.seconds, starts))):
        _check_order(clock.seconds, starts, table, notes)
    if options.exclude:
        kept = exclude_ranges(KeptRows(table, clock.seconds, starts), options.exclude, notes)
        table, starts, clock = kept.table, kept.starts, clock._replace(seconds=kept.times)
        long = None if long is None else replace(long, table=table)
    signals = [] if long is None else list_signals(long, notes)
    signals += list_wide_signals(table, clock.seconds, starts, notes, is_sparse=has_own_rows)
    times, spans = _build_segments(table, labels, clock.seconds, starts, notes)
    channels = _build_channels(signals, table, times, clock.unit, options, notes)
    return Recording(channels, spans, clock.started_at)


def _build_channels(
    signals: Sequence[TableSignal],
    table: Table,
    times: FloatArray,
    time_unit: str,
    options: ReadOptions,
    notes: list[str],
) -> tuple[Channel, ...]:
    """Build the channels of signals, without markers of bad data; tell what is missing."""
    channels, empty = [], []
    for signal in signals:
        numbers = mask_markers(signal.name, signal.values, options.missing, notes)
        if np.isnan(numbers).all():
            empty.append(signal.name)
            continue
        if signal.kind == "flag":
            notes.append(f"channel {signal.name!r}: true and false were read as 1 and 0")
        _report_bad_words(signal.name, table, notes)
        own = times[signal.rows]
        channels.append(Channel(signal.name, own, numbers, signal.unit or "1", time_unit=time_unit))
    if not channels:
        raise UnreadableFile("every value is missing; leave the column out", column=empty[0])
    if empty:
        notes.append(f"columns without any value were left out: {', '.join(empty)}")
    return tuple(channels)


def _name_signals(table: Table, notes: list[str]) -> Table:
    """Return the table with an index that does not count rows as a signal, and tell it."""
    columns, values = list(table.columns), list(table.values)
    for place, column in enumerate(columns):
        if not is_index_name(column.name) or column.name.lower() in NO_NAMES:
            continue
        texts = [str(value).removesuffix(".0") for value in values[place].tolist()]
        if column.role == "nameless" and any(texts) and not counts_rows(texts):
            columns[place] = replace(column, role="value", kind="number")
            if values[place].dtype.kind == "U":
                values[place] = parse_texts(columns[place], texts, table.rows, Counter())
        if columns[place].role == "value":
            notes.append(f"column {column.name!r} does not count the rows, so it is a signal")
    return replace(table, columns=tuple(columns), values=tuple(values))


def _check_left_out(table: Table, notes: list[str]) -> None:
    """Check and tell the columns that are no signal: without a name, or of texts."""
    signals = any(column.role == "value" for column in table.columns)
    for number, (column, values) in enumerate(zip(table.columns, table.values, strict=True), 1):
        if column.role == "nameless":
            _check_nameless(column, values, number, notes)
        elif column.role == "text":
            _check_text(column, values, table, notes, is_needed=not signals)


def _check_nameless(
    column: TableColumn, values: ColumnValues, number: int, notes: list[str]
) -> None:
    texts = [str(value) for value in values.tolist()]
    if not any(texts):
        return
    if not counts_rows([text.removesuffix(".0") for text in texts]):
        raise build_nameless_error(number)
    notes.append(f"column {number} ({column.name or 'no name'}) counts rows and was left out")


def _check_text(
    column: TableColumn, values: ColumnValues, table: Table, notes: list[str], *, is_needed: bool
) -> None:
    texts = [str(text) for text in values]
    place = next((i for i, text in enumerate(texts) if text), 0)
    if column.kind == "text":
        wrong = next((i for i, text in enumerate(texts) if begins_like_number(text)), None)
        place = place if wrong is None else wrong
        if wrong is not None or is_needed:
            raise UnreadableFile(
                f"found {shorten_text(texts[place])}{_explain_text(texts[place])}",
                row=int(table.rows[place]),
                column=column.name,
            )
    what = "text" if column.kind == "text" else "time stamps"
    notes.append(
        f"column {column.name!r} holds {what} ({shorten_text(texts[place])}) and was left out"
    )


def _explain_text(text: str) -> str:
    """Say what to do with a text among numbers."""
    if classify_cell(text) == "number":
        return " in a column that begins with text; a signal has numbers in all rows"
    if "," in text and "." in text:
        return (
            ", which is not a number; decimal points and commas are mixed: write numbers without "
            "thousands separators"
        )
    return ", which is not a number; write numbers alone, and their unit in the header: u [V]"


def _build_times(table: Table, starts: IntArray, notes: list[str]) -> TimeAxis:
    """Build the times in s before segments are placed on one axis."""
    sample_time = table.sample_time
    time = next((column for column in table.columns if column.role == "time"), None)
    clock = None if time is None else _read_times(table, time, sample_time is None, notes)
    if sample_time is not None:
        stops = [*starts[1:], table.rows.size]
        counts = [np.arange(b - a) for a, b in zip(starts, stops, strict=True)]
        if time is not None:
            notes.append(
                f"samples are {sample_time:g} s apart; column {time.name!r} gives the start"
            )
        start = None if clock is None else clock.started_at
        return TimeAxis(np.concatenate(counts) * sample_time, start)
    assert time is not None  # checked with the layout
    assert clock is not None
    return clock


def _read_times(table: Table, time: TableColumn, tell: bool, notes: list[str]) -> TimeAxis:
    """Read the column of times; without `tell` only its first one counts."""
    values, told = table.find_values(time.name), notes if tell else []
    rows = table.rows
    if not tell:
        values, rows = values[:1], rows[:1]
    if np.issubdtype(values.dtype, np.datetime64):
        return read_stamp_times(values, time.name, table.is_utc, told)  # type: ignore[arg-type]
    if not np.issubdtype(values.dtype, np.str_):
        return read_number_times(values, time.name, time.unit, told)  # type: ignore[arg-type]
    date = next((column for column in table.columns if column.role == "date"), None)
    if date is not None:
        values = join_dates(table.find_values(date.name)[: values.size], values)
    elif time.kind == "clock":
        return read_clock_times(values, rows, time.name, told)  # type: ignore[arg-type]
    stamps, is_utc = parse_stamps(values, rows, time.name, told)  # type: ignore[arg-type]
    return read_stamp_times(stamps, time.name, is_utc, told)


def _build_segments(
    table: Table, labels: Sequence[str], times: FloatArray, starts: IntArray, notes: list[str]
) -> tuple[FloatArray, tuple[Segment, ...]]:
    if not labels:
        return (
            concatenate_segments(times, starts, [{}] * starts.size)
            if starts.size > 1
            else (times, ())
        )
    sizes = np.diff(np.append(starts, times.size))
    singles = int(np.count_nonzero(sizes == 1))
    if starts.size > 1 and 2 * singles > starts.size:
        raise UnreadableFile(
            f"the labels {', '.join(labels)} divide {times.size} rows into {starts.size} segments, "
            f"of which {singles} have one sample. A label stays the same during a measurement; ",
            Advice("leave columns of times and signals out of ", "segments", "."),
        )
    values = {label: _parse_labels(table.find_values(label)) for label in labels}
    segment_labels: list[SegmentLabels] = [
        {label: column[first] for label, column in values.items()} for first in starts
    ]
    axis, spans = concatenate_segments(times, starts, segment_labels)
    notes.append(
        f"{', '.join(labels)} {'divides' if len(labels) == 1 else 'divide'} the file into "
        f"{len(spans)} segments, one measurement each. "
        "They follow each other on one time axis"
    )
    return axis, spans


def _find_segment_starts(table: Table, labels: Sequence[str]) -> IntArray:
    changes = np.zeros(table.rows.size, dtype=bool)
    changes[0] = True
    for label in labels:
        column = table.find_values(label)
        changes[1:] |= column[1:] != column[:-1]
    return np.flatnonzero(changes).astype(np.int64)


def _parse_labels(column: ColumnValues) -> list[float | str]:
    texts = [str(text) for text in column]
    try:
        numbers = [float(text) for text in texts]
    except ValueError:
        return list(texts)
    return list(numbers) if np.isfinite(numbers).all() else list(texts)


def _repair_order(
    table: Table, clock: TimeAxis, notes: list[str]
) -> tuple[Table, TimeAxis, IntArray]:
    """Repair the order of rows, and tell how; return where each measurement begins, too."""

    def are_equal(rows: IntArray) -> BoolArray:
        same = [_are_same(values[rows], values[rows - 1]) for values in table.values]
        return np.asarray(np.all(same, axis=0))

    order = repair_order(clock.seconds, are_equal)
    if order is None:
        return table, clock, np.zeros(1, dtype=np.int64)
    notes += (one.sentences for one in order.findings)
    rows = order.rows
    values = tuple(column[rows] for column in table.values)
    return (
        replace(table, values=values, rows=table.rows[rows]),
        clock._replace(seconds=clock.seconds[rows]),
        order.starts,
    )


def _are_same(values: ColumnValues, others: ColumnValues) -> BoolArray:
    return np.asarray((values == others) | ((values != values) & (others != others)))


def _check_order(times: FloatArray, starts: IntArray, table: Table, notes: list[str]) -> None:
    """Refuse times of a file that do not increase inside a segment, and tell those that repeat."""
    time = next((column for column in table.columns if column.role == "time"), None)
    if time is not None and table.sample_time is None:
        _check_increasing(times, starts, table, time)
        _report_repeated_times(times, starts, notes)


def _check_increasing(times: FloatArray, starts: IntArray, table: Table, time: TableColumn) -> None:
    """Refuse times that do not increase inside a segment."""
    is_stamp = not holds_numbers(time)
    steps = np.diff(times)
    # Repeats may be pooled, and pooled samples may share a time.
    stays = steps < 0 if starts.size > 1 else steps <= 0
    stays[starts[1:] - 1] = False
    wrong = np.flatnonzero(stays)
    if wrong.size == 0:
        return
    before, after = float(times[wrong[0]]), float(times[wrong[0] + 1])
    what = "repeats" if before == after else "decreases"
    several = "If the file has several measurements, "
    hint = f"Remove the row if it is a fault of the logger. {several}"
    advice = Advice("name the columns that number them with ", "segments", ".")
    label = _find_label(table, times)
    if label:
        hint, advice = several, Advice("divide it by ", "segments", f"={quote(label)}.")
    elif is_stamp:
        hint, advice = "If the stamps are too coarse, ", GIVE_PERIOD
    elif before == after:
        hint = f"{several}give the columns that number them as segments. "
        hint += "If it is no real time, remove it and "
        advice = GIVE_PERIOD
    raise UnreadableFile(
        f"the time {what}: {before!r} s is followed by {after!r} s. Times must increase from "
        f"row to row. {hint}",
        advice,
        row=int(table.rows[wrong[0] + 1]),
        column=time.name,
    )


def _find_label(table: Table, times: FloatArray) -> str:
    """Find the column that changes where the times go back, and nowhere else; empty if none."""
    resets = np.diff(times) < 0
    if not resets.any():
        return ""
    for column, values in zip(table.columns, table.values, strict=True):
        if column.role in ("value", "text") and np.array_equal(values[1:] != values[:-1], resets):
            return column.name
    return ""


def _find_falls(times: FloatArray, starts: IntArray) -> BoolArray:
    """Find where times go back inside a segment."""
    falls = np.diff(times) < 0
    falls[starts[1:] - 1] = False
    return falls


def _report_repeated_times(times: FloatArray, starts: IntArray, notes: list[str]) -> None:
    shared = np.diff(times) == 0
    shared[starts[1:] - 1] = False
    if count := int(np.count_nonzero(shared)):
        notes.append(f"{count} samples have the same time as the previous sample of their segment")


def _report_bad_words(name: str, table: Table, notes: list[str]) -> None:
    found = {word: count for (column, word), count in table.bad_words.items() if column == name}
    if found:
        listed = ", ".join(f"{word!r} ({count})" for word, count in found.items())
        notes.append(f"channel {name!r}: words that mark bad values were read as missing: {listed}")
