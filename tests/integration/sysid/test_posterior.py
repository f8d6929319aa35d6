"""The posterior of a measured record where the linear model of the standard errors fails."""

import numpy as np
import pytest

from service.datasets.signal_channels import map_channels
from service.formats.read_options import ReadOptions
from service.formats.tabular.csv_recordings import read_csv
from sysid.core.settings import Loss
from sysid.data.derivations import derive_recording
from sysid.data.records import Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from tests.support.requirements import DATA

pytestmark = [pytest.mark.data, pytest.mark.slow]
LABELS = ("length_m", "p_nom_bar", "phase", "file", "repeat")


def read_tube(length: float, pressure: float) -> Record:
    """The pooled filling of a pneumatic tube."""
    recording, _ = read_csv(
        DATA / "pneuact_tube" / "pneuact_tube.csv", ReadOptions(segments=LABELS)
    )
    chosen = {"length_m": length, "p_nom_bar": pressure, "phase": "fill"}
    pooling = {"input": "p_in_bar", "outputs": ["p_out_bar"], "bin": 0.003, "start": 0, "stop": 1}
    pooled = derive_recording(recording, [{"select": chosen}, {"pool": pooling}])
    channels = map_channels(load_model("tube"), {"u": "p_in_bar", "y": "p_out_bar"}, {})
    (record,) = channels.cut_records(pooled, "tube")
    return record


def test_the_lag_of_a_tube_of_3_m_is_known_better_than_its_standard_error_says() -> None:
    """L and T can hardly be separated, and neither can be negative."""
    found = identify(
        load_model("tube"),
        read_tube(3.0, 4.0),
        loss=Loss(noise_model="white"),
        parameters={"L": {"upper": 0.15}},
        posterior=True,
    )
    assert found.posterior is not None
    assert found.posterior.converged
    by_name = {parameter.name: parameter for parameter in found.posterior.parameters}
    (lag,) = [estimate for estimate in found.parameters if estimate.name == "L"]
    assert lag.interval95 is not None
    assert lag.stderr is not None
    assert lag.value < 2.0 * lag.stderr  # so the linear interval would be cut at 0
    low, high = by_name["L"].interval95
    assert 0.0 <= low < lag.value < high < 0.03
    # The profile says the same as the posterior, and both know more than the linear model.
    assert lag.interval95 == pytest.approx((low, high), abs=0.2 * (high - low))
    assert 4.0 * lag.stderr > 5.0 * np.ptp(lag.interval95)
    (told,) = [text for text in found.warnings if "by the posterior" in text]
    assert told.startswith("T is from ")  # at its bound there is no profile
    assert "L is from" not in told
    samples = found.posterior.samples
    assert np.all(samples[:, 1:] >= [0.001, 0.0])  # T and L inside their bounds
    assert found.posterior.correlation.matrix[1, 2] < -0.5
