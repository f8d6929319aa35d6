"""A pack of work as a worker sees it."""

from dataclasses import replace

import pytest

import workers.tasks
from sysid.identify import identify
from sysid.models.spec import parse_model
from sysid.settings import GeneticAlgorithm
from tests.polynomials import frols, lagged
from tests.runs import RECORDS, bits, carry_out, spec
from workers.inline import InlineCrew
from workers.ports import Advance, Concluded, Failure, ProblemSpec, RunSpec

FAULTY_SEED = 13


def test_a_programming_error_in_one_run_fails_it_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = workers.tasks.begin

    def begin(problem, algorithm, seed, warm):
        if seed == FAULTY_SEED:
            raise OverflowError("too large")
        return sound(problem, algorithm, seed, warm)

    monkeypatch.setattr(workers.tasks, "begin", begin)
    monkeypatch.setattr(workers.tasks, "PACK_LIMIT_SECONDS", 1000.0)
    pack = [Advance(f"r{seed}", spec(seed, generations=5), None, 100.0) for seed in (1, 13, 2)]
    first, faulty, last = workers.tasks.advance(pack, ["short"], RECORDS["short"])
    assert isinstance(first.outcome, Concluded)
    assert isinstance(last.outcome, Concluded)
    assert faulty.outcome == Failure(
        "internal error: OverflowError: too large", "InternalError"
    )  # fmt: skip


def test_a_run_whose_model_diverges_everywhere_fails_with_that_message() -> None:
    whole = spec(1, generations=5)
    wild = {
        "name": "wild",
        "form": "difference",
        "inputs": {"u": "1"},
        "states": {"x": "1"},
        "parameters": {"a": {"lower": 1e6, "upper": 1e7}},
        "equations": {"x": "a*x(k-1) + u(k-1)"},
        "outputs": {"y": "x"},
        "initial": {"x": 1},
    }
    problem = replace(whole.problem, model=wild, parameters={})
    item = Advance("r1", replace(whole, problem=problem), None, 100.0)
    (done,) = workers.tasks.advance([item], ["short"], RECORDS["short"])
    assert isinstance(done.outcome, Failure)
    assert "the model diverged for every one of" in done.outcome.reason
    assert "narrow the bounds" in done.outcome.reason


def test_a_run_that_selects_terms_gives_the_bits_of_the_library_call() -> None:
    asked = lagged(frols(4))
    problem = ProblemSpec(model=asked, records="short", skip=3)
    settings = GeneticAlgorithm(generations=10)
    (result,) = carry_out(InlineCrew(), {"r": RunSpec(problem, settings, 4)}).results["r"]
    alone = identify(parse_model(asked), RECORDS["short"], settings, seed=4, skip=3)
    assert len(alone.selection) == 4
    assert result.selection == alone.selection
    assert bits(result) == bits(alone)
