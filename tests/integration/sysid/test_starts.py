"""The setting `initial` in Python: where the states start, and what follows from it."""

import numpy as np
import pytest

from sysid.core.errors import InvalidSettings
from sysid.export.export import export_model
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.results.identification import Identification
from sysid.simulation.simulate import simulate

TIMES = 0.5 * np.arange(160)
STEP = np.where(TIMES >= 1.0, 20.0, 0.0)


@pytest.fixture(scope="module")
def data() -> dict[str, np.ndarray]:
    rise = np.where(TIMES > 6.0, 5.8 * (1.0 - np.exp(-(TIMES - 6.0) / 15.0)), 0.0)
    noise = 0.1 * np.random.default_rng(11).standard_normal(TIMES.size)
    return {"t": TIMES, "u": STEP, "y": 24.7 + rise + noise}


@pytest.fixture(scope="module")
def result(data: dict[str, np.ndarray]) -> Identification:
    return identify("fopdt", data, initial="rest")


def test_a_rest_needs_no_start(result: Identification, data: dict[str, np.ndarray]) -> None:
    free = identify("fopdt", data, initial="free")
    assert (result.initial, free.initial) == ("rest", "free")
    assert "x(0)" not in result
    assert "x(0)" in free
    assert result["K"].stderr is not None
    assert free["K"].stderr is not None
    assert result["K"].stderr < 0.4 * free["K"].stderr
    assert result["K"].interval95 is not None
    assert result["K"].interval95[0] < 0.29 < result["K"].interval95[1]


def test_what_follows_from_a_result_rests_too(result: Identification) -> None:
    other = {"t": TIMES, "u": STEP + 5.0}
    answer = simulate("fopdt", other, result).channel("y").values
    resting = result["y0"].value + 5.0 * result["K"].value
    assert answer[0] == pytest.approx(resting)
    [bands] = result.compute_bands()
    assert bands.confidence[0][0] < result["y0"].value < bands.confidence[0][1]
    assert "x(0)" not in export_model(load_model("fopdt"), result, "python")


def test_another_word_is_refused(data: dict[str, np.ndarray]) -> None:
    with pytest.raises(InvalidSettings, match="need rest, free, measured or auto"):
        identify("fopdt", data, initial="resting")  # type: ignore[arg-type]
