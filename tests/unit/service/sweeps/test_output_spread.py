"""The unit of a relative σ: the scatter of an output about each dataset's own mean."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.core.errors import InvalidRequest
from service.sweeps import output_spread
from service.sweeps.output_spread import compute_spread
from sysid.data.records import Channel, Recording


def make_recordings(**values: list[float]) -> dict[str, Recording]:
    return {
        name: Recording((Channel("y", np.arange(len(y)) * 0.1, np.array(y)),))
        for name, y in values.items()
    }


@pytest.fixture
def spread_of(monkeypatch: pytest.MonkeyPatch) -> Any:
    def compute(**values: list[float]) -> float:
        stored = make_recordings(**values)
        monkeypatch.setattr(output_spread, "load_recording", lambda _, sha256: stored[sha256])
        rows = [SimpleNamespace(sha256=name) for name in stored]
        return compute_spread(None, rows, "y")

    return compute


def test_datasets_at_different_levels_scatter_about_their_own_means(spread_of: Any) -> None:
    low, high = [1.0, 3.0, 1.0, 3.0, 1.0, 3.0], [101.0, 105.0]
    assert spread_of(low=low, high=high) == pytest.approx(((6 * 1.0 + 2 * 4.0) / 8) ** 0.5)
    assert spread_of(high=high, low=low) == pytest.approx(((6 * 1.0 + 2 * 4.0) / 8) ** 0.5)


def test_samples_that_are_missing_count_for_nothing(spread_of: Any) -> None:
    assert spread_of(one=[1.0, float("nan"), 3.0]) == pytest.approx(1.0)


def test_a_constant_output_has_no_unit_whatever_its_level(spread_of: Any) -> None:
    with pytest.raises(InvalidRequest, match="does not vary"):
        spread_of(low=[1.0, 1.0], high=[5.0, 5.0])
