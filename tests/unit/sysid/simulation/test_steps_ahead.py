"""Predictions several samples ahead beside those of records that end at their origin."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import Loss
from sysid.data.records import Channel, Record
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.simulation.steps_ahead import measure_prediction_errors

PERIOD, SAMPLES, SKIP = 0.25, 60, 4
MODEL = parse_model(
    {
        "name": "fed-back",
        "form": "differential",
        "inputs": {"u": "1"},
        "states": {"x": "1"},
        "parameters": {
            "a": {"lower": 0.1, "upper": 3},
            "b": {"lower": 0.1, "upper": 3},
            "L": {"lower": 0, "upper": 2},
        },
        "equations": {"x": "b*u - a*x(t - L)"},
        "outputs": {"y": "x"},
        "initial": {"x": 0.4},
    }
)
THETA = np.array([0.8, 1.1, 0.6, 1.2, 2.0])


def make_record(seed: int, missing: tuple[int, ...] = ()) -> Record:
    random, times = np.random.default_rng(seed), PERIOD * np.arange(SAMPLES)
    y = np.cumsum(0.3 * random.normal(size=SAMPLES))
    y[list(missing)] = np.nan
    u = Channel("u", times, random.normal(size=SAMPLES), hold="zero")
    return Record((u,), (Channel("y", times, y),))


def build(records: list[Record], skip: int = 0) -> Problem:
    return Problem.build(MODEL, records, loss=Loss(noise_model="load"), skip=skip)


def end_at(record: Record, origin: int) -> Record:
    """Leave out the samples after the origin but for the last, which predicts none before it."""
    values = record.outputs[0].values.copy()
    values[origin + 1 : -1] = np.nan
    return replace(record, outputs=(replace(record.outputs[0], values=values),))


def list_errors(record: Record, horizon: int) -> list[float]:
    """Errors of one record, by a record of its own for each origin."""
    errors, values = [], record.outputs[0].values
    for origin in range(SAMPLES - horizon):
        predicted = build([end_at(record, origin)]).predict_ahead(THETA[None])[0][0]
        errors.append(float(values[origin + horizon] - predicted[origin + horizon]))
    return errors


def test_a_prediction_knows_no_sample_after_its_origin() -> None:
    records = [make_record(1), make_record(2, missing=(11, 12, 30))]
    measured = measure_prediction_errors(build(records), THETA)
    assert [one.samples for one in measured] == [1, 2, 5]
    assert [one.time for one in measured] == pytest.approx([0.25, 0.5, 1.25])
    for one in measured:
        errors = np.array([e for r in records for e in list_errors(r, one.samples)])
        known = errors[np.isfinite(errors)]
        assert one.rms == pytest.approx(np.sqrt(np.mean(known**2)), rel=1e-9)


def test_one_sample_ahead_are_the_innovations() -> None:
    record = make_record(3)
    problem = build([record], SKIP)
    predicted, _ = problem.predict_ahead(THETA[None])
    errors = (problem.evaluator.measured - predicted[0])[SKIP:]
    first = measure_prediction_errors(problem, THETA)[0]
    assert first.rms == pytest.approx(np.sqrt(np.mean(errors**2)), rel=1e-12)


def test_a_prediction_that_diverges_has_no_error() -> None:
    problem = build([make_record(4)])
    unstable = np.array([3.0, 1.1, 2.0, 1e200, 2.0])
    assert {one.rms for one in measure_prediction_errors(problem, unstable)} == {None}
