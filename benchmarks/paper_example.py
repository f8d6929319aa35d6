"""The paper's Example 1 for the speed benchmarks: record, problem, job body."""

from pathlib import Path
from typing import Any

import numpy as np

from sysid import load_model
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate

TRUTH = {"c": 0.2, "L": 0.5, "b": 5.0, "a": 1.0}
SAMPLES, SAMPLE_TIME, SIGMA = 300, 0.02, 0.01


def record(seed: int) -> Record:
    """A record of 300 samples with measurement noise of sd 0.01 m."""
    times: FloatArray = SAMPLE_TIME * np.arange(SAMPLES)
    force = Channel("q", times, 10 * np.cos(5 * times), "N")
    exact = simulate(load_model("duffing-eq16"), [force], TRUTH, times=times)
    clean = next(channel.values for channel in exact.channels if channel.name == "y")
    noise = np.random.default_rng(seed).normal(0.0, SIGMA, SAMPLES)
    return Record((force,), (Channel("y", times, clean + noise, "m"),))


def problem(seed: int) -> Problem:
    """Example 1 on such a record."""
    return Problem.build(load_model("duffing-eq16"), [record(seed)])


def write_csv(path: Path, seed: int) -> Path:
    """The record as a file."""
    recording = record(seed)
    (force,), (measured,) = recording.inputs, recording.outputs
    rows = zip(force.times, force.values, measured.values, strict=True)
    lines = [f"{t:.6f},{q:.12g},{y:.12g}" for t, q, y in rows]
    path.write_text("\n".join(["t,q [N],y [m]", *lines]) + "\n")
    return path


def job(dataset: str, seed: int) -> dict[str, Any]:
    """A job of the default method on a stored record."""
    return {"model": "duffing-eq16", "datasets": [dataset], "seed": seed}
