"""The only kind of task: advance a pack of work. Stateless except for a cache of problems."""

import json
import logging
import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

from sysid.core.errors import SysidError
from sysid.core.jit import read_clock
from sysid.core.threads import use_one_thread
from sysid.data.noise import Noise
from sysid.identification.conclude import conclude_run
from sysid.identification.fit_problems import (
    FitRecords,
    ProblemPair,
    build_problems,
    prepare_records,
)
from sysid.identification.run import CALL_SECONDS, advance_island, begin_run, is_finished
from sysid.identification.run import advance_run as advance_run
from sysid.kernels.compilation.limited_compilation import get_compile_seconds
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.search.island import Island, get_island_settings, split_population
from sysid.simulation.problem import Problem, compute_reference_rms
from workers.errors import InvalidCheckpoint
from workers.pack_watch import PACK_LIMIT_SECONDS
from workers.protocol import (
    AdvanceRun,
    CompleteRun,
    Encoder,
    EvolveIsland,
    IslandProgress,
    ItemResult,
    Outcome,
    PackResult,
    ProblemSpec,
    Records,
    RunConclusion,
    RunEnd,
    RunFailure,
    RunProgress,
    WorkItem,
)

_log = logging.getLogger(__name__)

MAX_CACHED_PROBLEMS, MAX_CACHED_MODELS = 8, 32

_problem_cache: OrderedDict[str, tuple[str, ProblemPair]] = OrderedDict()


def run_pack(
    encoder: Encoder, pack: Sequence[WorkItem], keys: Sequence[str], *shared: Records
) -> PackResult:
    """Process the pack, and encode its complete runs."""
    before = get_compile_seconds()
    results = process_pack(pack, keys, *shared)
    encoded = encode_pack(encoder, pack, results, dict(zip(keys, shared, strict=True)))
    return encoded._replace(compile_seconds=get_compile_seconds() - before)


def encode_pack(
    encoder: Encoder,
    pack: Sequence[WorkItem],
    results: Sequence[ItemResult],
    records: Mapping[str, Records],
) -> PackResult:
    """Encode the complete runs of a pack. One that cannot be encoded fails, and no other."""
    begun = time.perf_counter()
    complete = {
        item.run: CompleteRun(
            item.run,
            item.spec,
            result.outcome,
            item.spent + result.seconds,
            item.state if item.is_reported else None,
        )
        for item, result in zip(pack, results, strict=True)
        if isinstance(result.outcome, RunConclusion) and isinstance(item, AdvanceRun)
    }
    if not complete:
        return PackResult(tuple(results))
    failures: dict[str, RunFailure] = {}
    try:
        encoded = encoder([*complete.values()], records)
    except Exception:  # noqa: BLE001 - the process border: which run it is, is found below
        failures = _find_unencodable(encoder, complete, records)
        left = [run for name, run in complete.items() if name not in failures]
        encoded = encoder(left, records) if left else None
    each = (time.perf_counter() - begun) / len(complete)
    ended = {name: failures.get(name, _END) for name in complete}
    return PackResult(
        tuple(
            result
            if result.run not in ended
            else ItemResult(result.run, ended[result.run], result.seconds + each)
            for result in results
        ),
        encoded,
    )


_END = RunEnd()


def _find_unencodable(
    encoder: Encoder, complete: Mapping[str, CompleteRun], records: Mapping[str, Records]
) -> dict[str, RunFailure]:
    failures: dict[str, RunFailure] = {}
    for name, run in complete.items():
        try:
            encoder([run], records)
        except Exception as error:  # noqa: BLE001 - the process border: its pack-mates go on
            _log.exception("the result of run %s cannot be encoded", name)
            reason = f"internal error: its result cannot be stored: {type(error).__name__}: {error}"
            evaluations = run.concluded.identification.evaluations
            failures[name] = RunFailure(reason, "InternalError", evaluations)
    return failures


def process_pack(
    pack: Sequence[WorkItem], keys: Sequence[str], *shared: Records
) -> tuple[ItemResult, ...]:
    """Process every item of the pack in turn.

    An error of a run is returned as its `RunFailure`, also a programming error. It does not affect
    the other runs of the pack.

    Parameters
    ----------
    pack : sequence of WorkItem
    keys : sequence of str
        Keys of the shared records, in order.
    shared : Records
        Separate arguments, so that Ray makes one copy per machine.
    """
    records = dict(zip(keys, shared, strict=True))
    begun = read_clock()
    done: list[ItemResult] = []
    with use_one_thread():  # once for all runs
        for item in pack:
            started = read_clock()
            if done and started - begun > PACK_LIMIT_SECONDS:
                done.append(ItemResult(item.run, None, 0.0))
                continue
            outcome = _process_item(item, records)
            done.append(ItemResult(item.run, outcome, read_clock() - started))
    return tuple(done)


def _process_item(item: WorkItem, records: Mapping[str, Records]) -> Outcome:
    try:
        problem, validation = _get_problem(item.spec.problem, records)
        _check_islands(item, problem)
        if isinstance(item, EvolveIsland):
            return IslandProgress(_evolve_item(item, problem), item.target)
        return _advance_item(item, problem, validation, records)
    except (SysidError, InvalidCheckpoint) as error:
        return RunFailure(str(error), type(error).__name__)
    except MemoryError as error:
        return RunFailure(f"it needs more memory than a worker may use: {error}", "OutOfMemory")
    except Exception as error:  # noqa: BLE001 - the process border: its pack-mates go on
        _log.exception("run %s met a programming error", item.run)
        return RunFailure(f"internal error: {type(error).__name__}: {error}", "InternalError")


def _check_islands(item: WorkItem, problem: Problem) -> None:
    """Refuse islands of another problem, for which compiled code would leave its arrays.

    A checkpoint comes from the database, and not only lagid can write there.
    """
    if isinstance(item, EvolveIsland):
        islands: tuple[Island, ...] = (item.island,)
    else:
        islands = () if item.state is None else item.state.islands
        if islands and len(islands) != item.spec.algorithm.n_islands:
            raise InvalidCheckpoint
    n, sizes = len(problem.free_parameters), split_population(item.spec.algorithm)
    for island in islands:
        bits = get_island_settings(item.spec.algorithm, island.index).bits
        is_larger = island.chromosomes.max(initial=0) >= 1 << bits
        if island.chromosomes.shape != (sizes[island.index], n) or is_larger:
            raise InvalidCheckpoint


def _advance_item(
    item: AdvanceRun, problem: Problem, validation: Problem | None, records: Mapping[str, Records]
) -> Outcome:
    algorithm = item.spec.algorithm
    state = item.state
    if state is None:
        state = begin_run(problem, algorithm, item.spec.seed, item.spec.warm_starts)
    state = advance_run(problem, algorithm, state, item.seconds)
    if not is_finished(algorithm, state):
        return RunProgress(state)
    noise_free = _load_noise_free_records(item.spec.problem, records)
    try:
        identification = conclude_run(
            problem,
            algorithm,
            state,
            validation,
            posterior=item.spec.posterior,
            orders=item.spec.compare_orders,
        )
    except SysidError as error:
        return RunFailure(str(error), type(error).__name__, state.evaluations)
    rms_noise_free = (
        identification.rms
        if noise_free is None
        else compute_reference_rms(problem, identification.simulated, noise_free)
    )
    return RunConclusion(identification, rms_noise_free)


def _evolve_item(item: EvolveIsland, problem: Problem) -> Island:
    """Evolve an island to its border, in calls of `CALL_SECONDS` that a cancel can interrupt."""
    island, cost = item.island, CALL_SECONDS
    while island.generation < item.target:
        count = max(1, min(item.target - island.generation, int(CALL_SECONDS / cost)))
        started = read_clock()
        before = island.generation
        island = advance_island(problem, item.spec.algorithm, island, count)
        cost = max((read_clock() - started) / count, 1e-9)
        if island.generation < before + count:
            return island  # it rests
    return island


def _load_noise_free_records(spec: ProblemSpec, records: Mapping[str, Records]) -> Records | None:
    """Load the estimation data without added noise; None if none was added."""
    if spec.noise.sigma == 0:
        return None
    return prepare_run_records(replace(spec, noise=Noise()), records).estimation


def _get_problem(spec: ProblemSpec, records: Mapping[str, Records]) -> ProblemPair:
    """Get the problem and its validation; the last few are cached for further slices."""
    if spec.cache_key in _problem_cache:
        _problem_cache.move_to_end(spec.cache_key)
        return _problem_cache[spec.cache_key][1]
    alike = (
        pair for family, pair in reversed(_problem_cache.values()) if family == spec.noise_free_key
    )
    built = build_pack_problems(spec, records, next(alike, None))
    _problem_cache[spec.cache_key] = (spec.noise_free_key, built)
    while len(_problem_cache) > MAX_CACHED_PROBLEMS:
        _problem_cache.popitem(last=False)
    return built


@lru_cache(maxsize=MAX_CACHED_MODELS)
def _parse_cached_model(document: str) -> Model:
    """Parse a model document (JSON); the runs of a sweep share the model."""
    return parse_model(json.loads(document))


def build_pack_problems(
    spec: ProblemSpec, records: Mapping[str, Records], alike: ProblemPair | None = None
) -> ProblemPair:
    """Build the problem and that of its validation data, if there are any.

    Parameters
    ----------
    alike : pair of problems or None
        Problems of a specification that differs in its noise only. They save time and change no
        result.

    Raises
    ------
    SysidError
        If model, records or settings cannot be used.
    """
    fit_records = prepare_run_records(spec, records)
    if alike is not None and alike[0].model.selection is None:  # else noise may select others
        problem = alike[0].replace_outputs(fit_records.estimation)
        if problem.output_weights == alike[0].output_weights:  # which are those of the validation
            return problem, alike[1]
    return build_problems(_parse_cached_model(json.dumps(spec.model)), fit_records, spec.settings)


def prepare_run_records(spec: ProblemSpec, records: Mapping[str, Records]) -> FitRecords:
    """Prepare the records of a run: split off validation data, add noise to the others."""
    validation = None if spec.validation is None else records[spec.validation]
    model = _parse_cached_model(json.dumps(spec.model))
    return prepare_records(
        model, records[spec.records], validation, spec.validation_fraction, spec.noise
    )
