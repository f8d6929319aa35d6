"""Measure the CPU time to store and load MCAP: a million samples of two channels."""

import sys
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

# Run as a script, this file would hide the package of its own name.
sys.path[:] = [entry for entry in sys.path if Path(entry).resolve() != Path(__file__).parent]

import numpy as np

from benchmarks.table import Row, parser, report
from service.formats.mcap.mcap_files import read_mcap, write_recording
from sysid.data.records import Channel, Recording

SAMPLES = 1_000_000
WRITE_BAR_S, READ_BAR_S = 0.60, 0.15


def make_recording(samples: int) -> Recording:
    """Two channels of noise, the hardest to compress, at 1 kHz."""
    rng = np.random.default_rng(1)
    times = np.arange(samples, dtype=np.float64) * 1e-3
    return Recording(
        tuple(Channel(name, times, rng.standard_normal(samples), "V") for name in ("u", "y"))
    )


def least_seconds(work: Callable[[], object], repeats: int) -> float:
    """Least processor time of some repeats: the one that was disturbed least."""
    measured = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        measured.append(time.process_time() - start)
    return min(measured)


def main() -> None:
    """Measure and print."""
    options = parser(__doc__ or "").parse_args()
    repeats = 3 if options.quick else 9
    recording = make_recording(SAMPLES)
    file = BytesIO()
    write_recording(recording, file)
    content = file.getvalue()
    back = read_mcap(content)
    if not all(
        np.array_equal(a.values, b.values) and np.array_equal(a.times, b.times)
        for a, b in zip(recording.channels, back.channels, strict=True)
    ):
        sys.exit("the recording did not come back bit for bit")
    write = least_seconds(lambda: write_recording(recording, BytesIO()), repeats)
    read = least_seconds(lambda: read_mcap(content), repeats)
    rows = [
        Row("write 1 M samples × 2 channels", write, "s of CPU", WRITE_BAR_S),
        Row("read them, all checksums compared", read, "s of CPU", READ_BAR_S),
        Row("size of the file", len(content) / 1024**2, "MiB"),
    ]
    report("MCAP", rows, [], options)


if __name__ == "__main__":
    main()
