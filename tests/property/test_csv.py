"""CSV: what is printed is read back bit for bit, and no bytes whatever end in another error."""

from contextlib import suppress

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from service.formats.read_options import ReadOptions
from service.formats.tabular.csv_recordings import read_csv
from sysid.core.errors import UnreadableFile
from tests.support.profiles import scale_examples

VALUES = st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=30)


@given(VALUES, st.sampled_from([",", ";", "\t"]), st.sampled_from(["\n", "\r\n"]))
def test_printed_numbers_come_back_bit_for_bit(
    values: list[float], separator: str, end: str
) -> None:
    rows = [f"t{separator}u", *(f"{k}{separator}{value!r}" for k, value in enumerate(values))]
    recording, _ = read_csv((end.join(rows) + end).encode(), ReadOptions(missing=("none",)))
    assert recording.channel("u").values.tobytes() == np.array(values).tobytes()


@given(VALUES)
def test_decimal_commas_and_points_give_the_same(values: list[float]) -> None:
    rows = [f"{k};{value!r}" for k, value in enumerate(values)]
    points, _ = read_csv("\n".join(["t;u", *rows]).encode())
    commas, _ = read_csv("\n".join(["t;u", *rows]).replace(".", ",").encode())
    np.testing.assert_array_equal(points.channel("u").values, commas.channel("u").values)


@given(
    st.one_of(
        st.binary(max_size=200),
        st.text('tu,;\t"\n\r0123456789.-+eEnaif_[] ', max_size=120).map(str.encode),
        st.text("0123456789,.\n-", max_size=60).map(lambda body: b"t,u,n\n" + body.encode()),
    ),
    st.sampled_from([None, 0.1]),
    st.sampled_from([(), ("n",)]),
)
@example(b't,u\n0,"' + b"x" * 200_000, None, ())
@example(b'"' + b"x" * 200_000, None, ())
@example(b'"t","u"x\n0,1\n', None, ())
@settings(max_examples=scale_examples(400))
def test_any_bytes_are_read_or_refused(
    content: bytes, sample_time: float | None, segments: tuple[str, ...]
) -> None:
    with suppress(UnreadableFile):
        recording, _ = read_csv(content, ReadOptions(sample_time=sample_time, segments=segments))
        assert recording.samples > 0
