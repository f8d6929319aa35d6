"""The one kind of task: advance a pack of work. Stateless but for a cache of built problems."""

import json
import logging
import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

from sysid.core.errors import SysidError
from sysid.data.noise import Noise
from sysid.identification.conclude import conclude
from sysid.identification.fit_problems import (
    FitRecords,
    ProblemPair,
    build_problems,
    prepare_records,
)
from sysid.identification.run import CALL_SECONDS, advance_island, begin, is_finished
from sysid.identification.run import advance as advance_run
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.search.island import Island
from sysid.simulation.problem import Problem, rms_against
from workers.ports import (  # fmt: skip
    Advance,
    Advanced,
    Concluded,
    Done,
    Evolve,
    Evolved,
    Failure,
    Item,
    Outcome,
    ProblemSpec,
    Records,
)

_log = logging.getLogger(__name__)

PACK_LIMIT_SECONDS = 1.0
"""No further item is begun after that; what is left goes back unchanged."""

CACHED_PROBLEMS, CACHED_MODELS = 8, 32

_problems: OrderedDict[str, tuple[str, ProblemPair]] = OrderedDict()


def advance(pack: Sequence[Item], keys: Sequence[str], *shared: Records) -> tuple[Done, ...]:
    """Work on every item of the pack in turn.

    What is wrong with a run comes back as its `Failure`, programming errors too: the other runs
    of the pack have no part in them.

    Parameters
    ----------
    pack : sequence of Item
    keys : sequence of str
        Names of the shared records, in order.
    shared : Records
        They travel as arguments of their own, so that Ray hands out one copy per machine.
    """
    records = dict(zip(keys, shared, strict=True))
    begun = time.perf_counter()
    done: list[Done] = []
    for item in pack:
        started = time.perf_counter()
        if done and started - begun > PACK_LIMIT_SECONDS:
            done.append(Done(item.run, None, 0.0))
            continue
        outcome = _outcome(item, records)
        done.append(Done(item.run, outcome, time.perf_counter() - started))
    return tuple(done)


def _outcome(item: Item, records: Mapping[str, Records]) -> Outcome:
    try:
        problem, validation = _problem(item.spec.problem, records)
        if isinstance(item, Evolve):
            return Evolved(_evolved(item, problem), item.target)
        return _advanced(item, problem, validation, records)
    except SysidError as error:
        return Failure(str(error), type(error).__name__)
    except MemoryError as error:
        return Failure(f"it needs more memory than a worker may use: {error}", "OutOfMemory")
    except Exception as error:  # noqa: BLE001 - the process border: its pack-mates go on
        _log.exception("run %s met a programming error", item.run)
        return Failure(f"internal error: {type(error).__name__}: {error}", "InternalError")


def _advanced(
    item: Advance, problem: Problem, validation: Problem | None, records: Mapping[str, Records]
) -> Outcome:
    algorithm = item.spec.algorithm
    state = item.state
    if state is None:
        state = begin(problem, algorithm, item.spec.seed, item.spec.warm)
    state = advance_run(problem, algorithm, state, item.seconds)
    if not is_finished(algorithm, state):
        return Advanced(state)
    noise_free = _without_noise(item.spec.problem, records)
    try:
        found = conclude(problem, algorithm, state, validation)
    except SysidError as error:
        return Failure(str(error), type(error).__name__, state.evaluations)
    without = found.rms if noise_free is None else rms_against(problem, found.simulated, noise_free)
    return Concluded(found, without)


def _evolved(item: Evolve, problem: Problem) -> Island:
    """The island at its border, in calls of about `CALL_SECONDS`: a cancel is heard between."""
    island, cost = item.island, CALL_SECONDS
    while island.generation < item.target:
        count = max(1, min(item.target - island.generation, int(CALL_SECONDS / cost)))
        started = time.perf_counter()
        before = island.generation
        island = advance_island(problem, item.spec.algorithm, island, count)
        cost = max((time.perf_counter() - started) / count, 1e-9)
        if island.generation < before + count:
            return island  # it rests
    return island


def _without_noise(spec: ProblemSpec, records: Mapping[str, Records]) -> Records | None:
    """The records of the estimate before noise was added; None if none was."""
    if spec.noise.sigma == 0:
        return None
    return prepared(replace(spec, noise=Noise()), records).estimation


def _problem(spec: ProblemSpec, records: Mapping[str, Records]) -> ProblemPair:
    """The problem and its validation; the last few are kept, since slices of a run follow."""
    if spec.key in _problems:
        _problems.move_to_end(spec.key)
        return _problems[spec.key][1]
    alike = (pair for family, pair in reversed(_problems.values()) if family == spec.family)
    built = build(spec, records, next(alike, None))
    _problems[spec.key] = (spec.family, built)
    while len(_problems) > CACHED_PROBLEMS:
        _problems.popitem(last=False)
    return built


@lru_cache(maxsize=CACHED_MODELS)
def _model(document: str) -> Model:
    """The model of a document as JSON: the runs of a sweep share it, whatever else they vary."""
    return parse_model(json.loads(document))


def build(
    spec: ProblemSpec, records: Mapping[str, Records], alike: ProblemPair | None = None
) -> ProblemPair:
    """The problem and that of its validation data, if there are any.

    Parameters
    ----------
    alike : pair of problems or None
        Of a specification that differs in its noise only: they save time, and change nothing.

    Raises
    ------
    SysidError
        If model, records or settings cannot be used.
    """
    fit_records = prepared(spec, records)
    if alike is not None and alike[0].model.selection is None:  # else noise may select others
        posed = alike[0].measured_anew(fit_records.estimation)
        if posed.output_weights == alike[0].output_weights:  # which are those of the validation
            return posed, alike[1]
    return build_problems(_model(json.dumps(spec.model)), fit_records, spec.settings)


def prepared(spec: ProblemSpec, records: Mapping[str, Records]) -> FitRecords:
    """Records as a run sees them: noise added to those for the estimate, validation split off."""
    validation = None if spec.validation is None else records[spec.validation]
    return prepare_records(records[spec.records], validation, spec.validation_fraction, spec.noise)
