"""A pack of work as a worker sees it."""

import os
import signal
from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

import workers.tasks
from sysid.core.settings import FitSettings, GeneticAlgorithm, Loss
from sysid.data.noise import Noise
from sysid.identification import best_estimate, conclude
from sysid.identification.identify import identify
from sysid.identification.run import begin_run
from sysid.kernels.compilation import build, limited_compilation
from sysid.kernels.layout import KernelVariant
from sysid.models.catalogue.load import copy_catalogue_document
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.noise_models import generalised_least_squares
from sysid.simulation.problem import Problem
from tests.support.cluster.inline_executor import InlineExecutor
from tests.support.cluster.small_runs import RECORDS, bits, carry_out, spec
from tests.support.library.local_compilation import compile_here
from tests.support.library.polynomials import build_lagged, frols
from workers.protocol import AdvanceRun, ProblemSpec, RunConclusion, RunFailure, RunSpec

FAULTY_SEED = 13


def test_a_programming_error_in_one_run_fails_it_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = begin_run

    def begin(problem, algorithm, seed, warm):
        if seed == FAULTY_SEED:
            raise OverflowError("too large")
        return sound(problem, algorithm, seed, warm)

    monkeypatch.setattr(workers.tasks, "begin_run", begin)
    monkeypatch.setattr(workers.tasks, "PACK_LIMIT_SECONDS", 1000.0)
    pack = [AdvanceRun(f"r{seed}", spec(seed, generations=5), None, 100.0) for seed in (1, 13, 2)]
    first, faulty, last = workers.tasks.process_pack(pack, ["short"], RECORDS["short"])
    assert isinstance(first.outcome, RunConclusion)
    assert isinstance(last.outcome, RunConclusion)
    assert faulty.outcome == RunFailure("internal error: OverflowError: too large", "InternalError")


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
    problem = replace(whole.problem, model=wild, settings=FitSettings())
    item = AdvanceRun("r1", replace(whole, problem=problem), None, 100.0)
    (done,) = workers.tasks.process_pack([item], ["short"], RECORDS["short"])
    assert isinstance(done.outcome, RunFailure)
    assert "the model diverged for every one of" in done.outcome.reason
    assert "Narrow the bounds" in done.outcome.reason


@pytest.mark.usefixtures("endless_children")
def test_a_run_whose_model_needs_too_long_to_compile_fails_alone_with_the_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def compile_one(model: Model, variant: KernelVariant) -> bytes:
        is_costly = model.name == "costly"
        return (limited_compilation.compile_kernel if is_costly else compile_here)(model, variant)

    monkeypatch.setattr(build, "compile_kernel", compile_one)
    monkeypatch.setattr(limited_compilation, "_WALL_SECONDS", 0.05)
    whole = spec(1, generations=5)
    costly = {
        **whole.problem.model,
        "name": "costly",
        "equations": {"x": "(K*u(t-L) - x)/T - 0.015625*x**5"},
    }
    problem = replace(whole.problem, model=costly)
    pack = [
        AdvanceRun("r1", replace(whole, problem=problem), None, 100.0),
        AdvanceRun("r2", whole, None, 100.0),
    ]
    refused, done = workers.tasks.process_pack(pack, ["short"], RECORDS["short"])
    assert isinstance(refused.outcome, RunFailure)
    assert "compiling them needs more than 0.05 s" in refused.outcome.reason
    assert refused.outcome.kind == "InvalidModel"
    assert isinstance(done.outcome, RunConclusion)


def test_a_run_that_selects_terms_gives_the_bits_of_the_library_call() -> None:
    asked = build_lagged(frols(4))
    problem = ProblemSpec(model=asked, records="short", settings=FitSettings(skip=3))
    settings = GeneticAlgorithm(generations=10)
    (result,) = carry_out(InlineExecutor(), {"r": RunSpec(problem, settings, 4)}).results["r"]
    alone = identify(
        parse_model(asked), RECORDS["short"], settings, seed=4, skip=3, compare_orders=False
    )
    assert len(alone.selection) == 4
    assert result.selection == alone.selection
    assert bits(result) == bits(alone)


TWO_OUTPUTS = {
    "name": "two",
    "form": "difference",
    "inputs": {"u": "1"},
    "states": {"x": "1", "z": "1"},
    "parameters": {"a": {"lower": 0, "upper": 1}, "g": {"lower": 0, "upper": 5}},
    "equations": {"x": "a*x(k-1) + g*u(k-2)", "z": "0.5*z(k-1) + x(k-1)"},
    "outputs": {"y": "x", "w": "z"},
    "initial": {"x": "measured", "z": 0},
}


def laid_out(problem: Problem | None) -> tuple[object, ...]:
    """All that a search and its result see of a problem."""
    if problem is None:
        return ()
    parts = (one.tobytes() if isinstance(one, np.ndarray) else one for one in problem.evaluator)
    measured = tuple(
        channel.values.tobytes() for record in problem.records for channel in record.outputs
    )
    return (*parts, measured, problem.output_weights, problem.all_parameters)


@pytest.mark.parametrize("fraction", [None, 0.3])
@pytest.mark.parametrize(
    "model", [copy_catalogue_document("fopdt"), TWO_OUTPUTS], ids=["one", "two outputs"]
)
def test_runs_that_differ_in_noise_only_see_the_bits_they_would_see_alone(
    model: Mapping[str, object], fraction: float | None
) -> None:
    (short,) = RECORDS["short"]
    other = replace(short.outputs[0], name="w", values=2.0 * short.outputs[0].values)
    records = {"r": (replace(short, outputs=(*short.outputs, other)),)}
    quiet = ProblemSpec(model, "r", validation_fraction=fraction, settings=FitSettings(skip=2))
    alike = workers.tasks.build_pack_problems(quiet, records)
    for seed in (1, 2):
        noisy = replace(quiet, noise=Noise(0.1, seed))
        assert noisy.noise_free_key == quiet.noise_free_key
        assert noisy.cache_key != quiet.cache_key
        alone = workers.tasks.build_pack_problems(noisy, records)
        beside = workers.tasks.build_pack_problems(noisy, records, alike)
        for one, same in zip(alone, beside, strict=True):
            assert laid_out(one) == laid_out(same)
        alike = beside


def test_what_a_worker_did_before_changes_no_bit_of_a_run() -> None:
    """Nor does the same model with its parameters in another order, which are other genes."""
    model = copy_catalogue_document("fopdt")
    turned = {**model, "parameters": dict(reversed([*model["parameters"].items()]))}
    first = replace(spec(generations=5), problem=ProblemSpec(model, "short"))
    runs = [first]
    for noise in (Noise(), Noise(0.1, 1), Noise(0.3, 2)):
        for one in (model, turned):
            problem = replace(first.problem, model=one, noise=noise)
            runs.append(replace(first, problem=problem))
    alone = []
    for run in runs:
        workers.tasks._problem_cache.clear()
        alone.append(result_of(run))
    for order in (runs, runs[::-1]):
        after = {run.reuse_key: result_of(run) for run in order}
        assert [after[run.reuse_key] for run in runs] == alone
    assert len(set(alone)) == 6


def result_of(run: RunSpec) -> tuple[object, ...]:
    """The bits of what a worker makes of a run."""
    pack = [AdvanceRun("r", run, None, 100.0)]
    (done,) = workers.tasks.process_pack(pack, ["short"], RECORDS["short"])
    assert isinstance(done.outcome, RunConclusion)
    return bits(done.outcome.identification)


def test_terms_are_selected_anew_for_other_noise() -> None:
    quiet = ProblemSpec(model=build_lagged(frols(4)), records="short", settings=FitSettings(skip=3))
    noisy = replace(quiet, noise=Noise(2.0, 1))
    alone = workers.tasks.build_pack_problems(noisy, RECORDS)[0]
    beside = workers.tasks.build_pack_problems(
        noisy, RECORDS, workers.tasks.build_pack_problems(quiet, RECORDS)
    )[0]
    assert beside.model.selection == alone.model.selection


@pytest.fixture
def interrupts() -> Iterator[None]:
    """SIGINT is Python's own here, whatever a dispatcher or Ray of another test has made of it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    if before is not None:  # one that was not set from Python cannot be set again
        signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interrupts")
@pytest.mark.parametrize(
    ("module", "part"),
    [
        (best_estimate, "refine_candidates"),
        (best_estimate, "analyse_estimate"),
        (conclude, "run_residual_tests"),
        (conclude, "estimate_onset_delays"),
        (generalised_least_squares, "estimate_correlation_times"),
        (generalised_least_squares, "_draw_starts"),
    ],
    ids=lambda one: one if isinstance(one, str) else one.__name__.rpartition(".")[2],
)
def test_a_cancel_between_the_parts_of_a_conclusion_ends_the_pack_and_harms_no_later_one(
    module: ModuleType, part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (short,) = RECORDS["short"]
    slow = np.cumsum(np.random.default_rng(1).normal(0.0, 0.02, short.outputs[0].values.size))
    drifting = replace(short.outputs[0], values=short.outputs[0].values + slow)
    records = (replace(short, outputs=(drifting,)),)
    run = spec(generations=5, records="drifting")
    fit = replace(run.problem.settings, loss=Loss(noise_model="ar1"))
    problem = replace(run.problem, settings=fit)
    pack = [AdvanceRun("r", replace(run, problem=problem), None, 100.0)]
    (whole,) = workers.tasks.process_pack(pack, ["drifting"], records)

    def interrupt_process(*arguments: object, **_: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)  # as Ray does to a worker

    with monkeypatch.context() as patched:
        patched.setattr(module, part, interrupt_process)
        with pytest.raises(KeyboardInterrupt):
            workers.tasks.process_pack(pack, ["drifting"], records)
    (again,) = workers.tasks.process_pack(pack, ["drifting"], records)
    assert isinstance(whole.outcome, RunConclusion)
    assert isinstance(again.outcome, RunConclusion)
    assert bits(again.outcome.identification) == bits(whole.outcome.identification)
