"""The layout of a text is guessed: whatever surrounds the numbers, they come back bit for bit."""

from dataclasses import dataclass

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from service.formats.read_options import ReadOptions
from service.formats.tabular.cells import classify_cell
from service.formats.tabular.csv_recordings import read_csv
from service.formats.tabular.table_layout import PEEK_ROWS, SEPARATORS
from tests.support.profiles import scale_examples

NAMES = ("u", "y", "P1", "Druck", "flow rate", "x2", "T", "Ventil_1")
UNITS = ("V", "degC", "bar", "%", "m/s", "l/min")
PREAMBLES = (
    [],
    ["Device: Scope 1", "Date: 2026-01-01", ""],
    ["# logger XY", "# t and others"],
    ["", "  "],
    ["[Header]", "Operator=X", "***End***"],
    ["Model,DS1054Z", "Rate,1000", "Depth;7", "Mode\tauto"],
    [f"Setting {i}: value {i}" for i in range(40)],
    [f"Setting {i} is value {i}" for i in range(PEEK_ROWS + 50)],
)
NUMBERS = st.floats(-1e6, 1e6, allow_nan=False, width=32)


@dataclass(frozen=True)
class Text:
    """A table with its surroundings."""

    values: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]
    separator: str
    commas: bool
    heading: str
    preamble: int
    quiet: int
    comment: bool
    end: str

    def write(self) -> str:
        separator = self.separator
        names = [
            name.replace(" ", "_") if separator == " " else name for name in ("t", *self.names)
        ]
        units = ("s", *self.units)
        if self.heading == "row":
            heads = [names, list(units)]
        else:
            form = {"none": "{0}", "brackets": "{0} [{1}]", "parentheses": "{0} ({1})"}[
                self.heading
            ]
            heads = [[form.format(*pair) for pair in zip(names, units, strict=True)]]
        rows = [[str(k), *("0" for _ in self.names)] for k in range(self.quiet)]
        rows += [
            [repr(self.quiet + k / 8), *(repr(float(value)) for value in row)]
            for k, row in enumerate(self.values)
        ]
        if self.commas:
            rows = [[text.replace(".", ",") for text in row] for row in rows]
        lines = [separator.join(row) for row in (*heads, *rows)]
        if self.comment:
            lines.insert(len(heads) + 1, "# here the pump was switched on")
        return self.end.join([*PREAMBLES[self.preamble], *lines, ""])


@st.composite
def list_texts(draw: st.DrawFn) -> Text:
    width = draw(st.integers(1, 4))
    names = draw(st.permutations(NAMES))[:width]
    units = draw(st.lists(st.sampled_from(UNITS), min_size=width, max_size=width))
    rows = draw(
        st.lists(st.lists(NUMBERS, min_size=width, max_size=width), min_size=6, max_size=40)
    )
    separator = draw(st.sampled_from(SEPARATORS))
    return Text(
        np.array(rows, dtype=np.float64),
        tuple(names),
        tuple(units),
        separator,
        separator != "," and draw(st.booleans()),
        draw(st.sampled_from(["none", "brackets", "parentheses", "row"])),
        draw(st.integers(0, len(PREAMBLES) - 1)),
        draw(st.sampled_from([0, 0, 3, PEEK_ROWS + 10])),
        draw(st.booleans()),
        draw(st.sampled_from(["\n", "\r\n"])),
    )


@given(list_texts())
@settings(max_examples=scale_examples(150))
def test_numbers_names_and_units_come_back_from_any_layout(text: Text) -> None:
    content = text.write()
    recording, _ = read_csv(content.encode(), ReadOptions(missing=("none",)))
    wanted = [name.replace(" ", "_") if text.separator == " " else name for name in text.names]
    assert list(recording.names) == wanted, content
    units = ["1"] * len(text.names) if text.heading == "none" else list(text.units)
    assert [channel.unit for channel in recording.channels] == units, content
    zeros, later = np.zeros(text.quiet), text.quiet + np.arange(len(text.values)) / 8
    for channel, values in zip(recording.channels, text.values.T, strict=True):
        np.testing.assert_array_equal(channel.values, np.concatenate([zeros, values]))
        np.testing.assert_array_equal(channel.times, np.concatenate([np.arange(zeros.size), later]))


@given(st.floats(), st.sampled_from(".,"), st.sampled_from(["{}", " {} ", "+{}", "{:e}", "{:E}"]))
def test_a_written_number_is_called_one(value: float, sign: str, form: str) -> None:
    text = form.format(abs(value)).replace(".", sign)
    assert classify_cell(text) == (
        "empty" if "nan" in text.lower() and "+" not in text else "number"
    )


@given(st.text(alphabet="0123456789.,eE+-_ ٣xnaif", max_size=12))
@example("1_000")
@example("٣")
@example("1e5")
def test_what_is_called_a_number_is_one(text: str) -> None:
    """Python reads each cell that is called a number, with either decimal sign."""
    try:
        float(text.replace(",", "."))
    except ValueError:
        assert classify_cell(text) != "number"
