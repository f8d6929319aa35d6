"""The tube plant against stored records that another program made of the same specification."""

import numpy as np
import pytest

from service.plants.tube import Tube, build_excitation, simulate_tube_record
from tests.support.requirements import DATA

pytestmark = pytest.mark.data


@pytest.mark.parametrize("length", [5, 40])
@pytest.mark.parametrize("pattern", [1, 2])
def test_both_ends_follow_the_record_within_0_2_percent_of_its_span(
    length: int, pattern: int
) -> None:
    path = DATA / "tube_reference" / f"tube_{length:03d}m_pattern{pattern}.csv"
    times, command, first, second = np.loadtxt(
        path, delimiter=",", skiprows=1, usecols=(0, 1, 2, 3), unpack=True
    )
    ours = build_excitation(pattern, float(length), times)
    assert np.count_nonzero(np.abs(ours - command) > 1.0) <= 3  # at jumps, by one sample
    found = simulate_tube_record(Tube(length_m=float(length)), pattern, times.size, 0.01)
    span = float(np.ptp(second))
    for name, expected in (("P1", first), ("P2", second)):
        error = found.channel(name).values - expected
        assert float(np.sqrt(np.mean(error**2))) < 0.002 * span
