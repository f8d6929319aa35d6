"""The measured records, as far as they are there: reading, trimming, pooling."""

import csv
from functools import cache

import numpy as np
import pytest

from service.formats.read_options import ReadOptions
from service.formats.tabular.csv_recordings import read_csv
from sysid.data.derivations import derive_recording
from sysid.data.records import Recording
from tests.support.requirements import DATA

LABELS = ("length_m", "p_nom_bar", "phase", "file", "repeat")

pytestmark = pytest.mark.data


@cache
def read_tubes() -> Recording:
    return read_csv(DATA / "pneuact_tube" / "pneuact_tube.csv", ReadOptions(segments=LABELS))[0]


def tube(remainder: int) -> Recording:
    chosen = {
        "length_m": 8,
        "p_nom_bar": 5,
        "phase": "fill",
        "repeat": {"modulus": 2, "remainder": remainder},
    }
    pooled = {"input": "p_in_bar", "outputs": ["p_out_bar"], "bin": 0.003, "start": 0, "stop": 1}
    return derive_recording(read_tubes(), [{"select": chosen}, {"pool": pooled}])


@pytest.mark.parametrize("remainder", [0, 1])
def test_pooled_repeats_are_what_a_plain_loop_finds(remainder: int) -> None:
    with (DATA / "pneuact_tube" / "pneuact_tube.csv").open(newline="") as file:
        rows = [
            (float(row["t"]), float(row["p_in_bar"]), float(row["p_out_bar"]))
            for row in csv.DictReader(file)
            if (row["length_m"], row["p_nom_bar"], row["phase"]) == ("8", "5", "fill")
            and int(row["repeat"]) % 2 == remainder
            and 0 <= float(row["t"]) < 1
        ]
    pooled = tube(remainder)
    inlet, outlet = pooled.channel("p_in_bar"), pooled.channel("p_out_bar")
    by_time = sorted(rows, key=lambda row: row[0])
    np.testing.assert_array_equal(outlet.times, [row[0] for row in by_time])
    np.testing.assert_array_equal(outlet.values, [row[2] for row in by_time])
    bins: dict[int, list[float]] = {}
    for time, pressure, _ in by_time:
        bins.setdefault(round(time * 1000) // 3, []).append(pressure)  # times are whole ms
    np.testing.assert_array_equal(inlet.values, [np.median(one) for one in bins.values()])


def test_the_silverbox_is_regular_and_trimmed_by_rows() -> None:
    recording, _ = read_csv(DATA / "silverbox" / "silverbox_snls80mv.csv")
    part = derive_recording(
        recording, [{"trim": {"rows": [100, 40575]}}, {"hold": {"u": "band-limited"}}]
    )
    assert part.samples == 40475
    assert part.sampling.is_regular
    assert 1 / part.sampling.period == pytest.approx(610.35, rel=1e-5)
    np.testing.assert_array_equal(
        part.channel("y").values, recording.channel("y").values[100:40575]
    )


@pytest.mark.parametrize(
    ("file", "channels", "samples"),
    [
        ("dryer2/dryer2.csv", ("u", "y"), 1000),
        ("emps/emps_train.csv", ("u", "y", "y_ref"), 24841),
        (
            "tube_reference/tube_040m_pattern1.csv",
            ("cmd_Pa", "P1_true_Pa", "P2_true_Pa", "P1_meas_Pa", "P2_meas_Pa"),
            3001,
        ),
    ],
)
def test_every_other_file_is_read_as_it_is(
    file: str, channels: tuple[str, ...], samples: int
) -> None:
    recording, notes = read_csv(DATA / file)
    assert recording.names == channels
    assert recording.samples == samples
    assert recording.sampling.is_regular
    assert notes == ()
