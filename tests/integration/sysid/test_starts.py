"""The setting `initial` in Python: where the states start, and what follows from it."""

import numpy as np
import pytest

from sysid.core.errors import InvalidSettings
from sysid.data.records import Channel, Record
from sysid.export.export import export_model
from sysid.identification.identify import identify
from sysid.judgement.afterwards import explain_afterwards
from sysid.judgement.residual_context import Simulations
from sysid.models.catalogue.load import load_model
from sysid.results.identification import Identification
from sysid.simulation.problem import Problem
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


def make_short_step(seed: int, x0: float = 0.0) -> dict[str, np.ndarray]:
    """A step after two samples, first-order noise, and steps of 0.1 of a converter."""
    random, times = np.random.default_rng(seed), np.arange(300.0)
    after = np.maximum(times - 2.0 - 9.3, 0.0)
    y = 24.7 + 5.8 * (1.0 - np.exp(-after / 57.0)) + x0 * np.exp(-times / 57.0)
    noise = np.empty(times.size)
    level = random.normal(0.0, 0.11)
    for k in range(times.size):
        noise[k] = level
        level = 0.93 * level + random.normal(0.0, 0.11 * np.sqrt(1.0 - 0.93**2))
    return {"t": times, "u": np.where(times >= 2.0, 20.0, 0.0), "y": np.round(y + noise, 1)}


@pytest.mark.parametrize("seed", [2, 3, 5])
def test_two_samples_of_rest_are_enough_for_the_gain(seed: int) -> None:
    found = identify("fopdt", make_short_step(seed), hold={"u": "zero"})
    assert found.initial == "rest"
    gain = found["K"]
    assert gain.stderr is not None
    assert gain.interval95 is not None
    assert gain.stderr < 0.012
    assert gain.interval95[0] < 0.29 < gain.interval95[1]


def test_a_record_amid_a_motion_keeps_its_free_start() -> None:
    data = make_short_step(1, x0=3.0)
    found = identify("fopdt", data, hold={"u": "zero"})
    free = identify("fopdt", data, hold={"u": "zero"}, initial="free")
    assert found.initial == "free"
    assert found.parameter_values == pytest.approx(free.parameter_values, rel=1e-3)


def test_a_given_start_is_not_compared(data: dict[str, np.ndarray]) -> None:
    given = identify("fopdt", data, parameters={"x(0)": (-0.5, 0.5)})
    assert given.initial is None
    assert "x(0)" in given
    assert identify("fopdt", data).initial == "rest"


def test_a_measured_start_is_not_preferred_to_a_free_one() -> None:
    times = 0.5 * np.arange(300)
    values = {"beta": 0.4, "gamma": 0.2, "n": 8.0, "L": 6.0, "x(0)": 0.8}
    clean = simulate("mackey-glass", [], values, times=times).channel("y").values
    noisy = clean + 0.02 * np.random.default_rng(10).standard_normal(times.size)
    own = {**load_model("mackey-glass").document, "initial": {"x": "measured"}}
    table = {"t": times, "y": noisy}
    assert identify(own, table).initial is None
    moved = identify(own, table, initial="auto")
    assert moved.initial == "free"
    assert identify("mackey-glass", table)["L"].value == pytest.approx(moved["L"].value, rel=1e-3)


def test_the_history_of_a_search_has_the_parameters_of_its_result(result: Identification) -> None:
    found = identify("fopdt", make_short_step(2))
    assert found.initial == result.initial == "rest"
    columns = {len(one.parameters) for island in found.history for one in island}
    assert columns == {4}
    assert {len(island.parameters) for island in found.islands} == {4}


def test_a_sweeps_run_compares_starts_if_it_is_asked_to(data: dict[str, np.ndarray]) -> None:
    """Else it estimates them, and the rest is told when the run is opened."""
    swept = identify("fopdt", data, compare_orders=False)
    asked = identify("fopdt", data, compare_orders=False, initial="auto")
    assert (swept.initial, asked.initial) == (None, "rest")
    assert "x(0)" in swept
    assert not any(one.family == "start" for one in swept.findings)
    (u, y) = (Channel(name, TIMES, data[name]) for name in ("u", "y"))
    problem = Problem.build(load_model("fopdt"), [Record((u,), (y,))])
    opened = explain_afterwards(problem, swept, Simulations())
    [start] = [one for one in opened.findings if one.family == "start"]
    assert "(initial: rest)" in start.text
    assert start.severity == "note"  # an estimated start contains the rest, and is less exact
    gain = next(one for one in start.moves if one.parameter == "K")
    assert gain.value == pytest.approx(asked["K"].value, rel=1e-3)
    assert gain.stderr == pytest.approx(asked["K"].stderr, rel=0.1)
    assert opened.parameter_values == swept.parameter_values
