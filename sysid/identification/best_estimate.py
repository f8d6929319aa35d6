"""The best estimate that a search leads to, and its analysis.

Least squares continues from the champion of each island. From the best end each parameter alone is
scanned for a better minimum (`minima`). The best is analysed, and the minima near it are searched
(`local_minima`). If half the integration step would change the estimates, all this is repeated with
it (`integration_step`). At last residuals that are not white get a noise model
(`generalised_least_squares`). The champions of the paper's two methods are analysed as they are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import NamedTuple

import numpy as np

from sysid.core.findings import Finding
from sysid.core.settings import GeneticAlgorithm, StartKind
from sysid.core.types import FloatArray
from sysid.identifiability.exchange import (
    ExchangeGroups,
    find_exchanges,
    order_exchangeable,
)
from sysid.identification.budget import Budget
from sysid.identification.deadline import Deadline
from sysid.identification.plant_noise_choice import (
    FilteredFit,
    ReplacedRun,
    fit_filters,
    fit_first_order_criterion,
)
from sysid.identification.state_conversion import convert_state
from sysid.islands.run_state import RunState
from sysid.islands.stopping import count_restarts
from sysid.judgement.input_hold import find_held_commands
from sysid.judgement.integration_step import (
    HalfStep,
    can_halve_step,
    choose_starts,
    compare_half_step,
    compute_work_limit,
    find_limit,
    halve_step,
    mark_changing,
)
from sysid.judgement.judge import Explained, explain_if_noise, explain_residuals
from sysid.judgement.levels import STRONG_ODDS
from sysid.judgement.noise_findings import find_feedback
from sysid.judgement.noise_sources import (
    OpenSource,
    SourceComparison,
    name_source,
    open_defect,
)
from sysid.judgement.residual_context import (
    ResidualContext,
    Simulations,
    find_delay_parameters,
)
from sysid.judgement.starts import (
    FittedStart,
    StartComparison,
    compare_starts,
)
from sysid.judgement.unrecorded_input import RecordedComparison, compare_where_recorded
from sysid.judgement.unstable_run import MIN_GROWTH, compute_growth
from sysid.minima.local_minima import (
    LocalMinima,
    count_affordable_simulations,
    find_local_minima,
    list_compatible_minima,
)
from sysid.minima.minima import (
    Fit,
    FoundMinima,
    collect_minima,
    continue_from_archive,
    find_nearest,
    is_same_point,
    scan_by_projection,
    scan_parameters,
)
from sysid.minima.search_evidence import is_explained
from sysid.noise_models.generalised_least_squares import (
    GeneralisedEstimate,
    fit_generalised_least_squares,
)
from sysid.residuals.residual_tests import run_residual_tests
from sysid.residuals.series import make_whitening
from sysid.residuals.whitening import Whitening
from sysid.search.archive import read_archive
from sysid.search.island import Island, compute_analysis_budget, get_island_settings
from sysid.search.refine import RefinedCandidate, refine_candidates
from sysid.search.state import SAME_OPTIMUM
from sysid.simulation.problem import Problem
from sysid.simulation.start_values import convert_point
from sysid.uncertainty.analysis import Analysis, analyse_estimate
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.intervals import (
    ProfileEnds,
    compose_intervals,
    keep_in_bounds,
    mark_poor_intervals,
)
from sysid.uncertainty.noise_sizes import explore_noise_sizes
from sysid.uncertainty.profile_ends import FoundEnds, extrapolate_ends, find_profile_ends
from sysid.uncertainty.unequal_noise import fit_unequal_noise

_MOST_PROJECTED = 6000  # simulations of a scan by projection
_ENOUGH_SHARE = 1 / 3  # of the random starts: if more agree, nothing is in doubt
_SCAN_SHARES = 4  # a scan takes at most one such share of the simulations that are left


@dataclass(frozen=True, slots=True, eq=False)
class IslandEnd:
    """Where an island ended.

    Attributes
    ----------
    theta : FloatArray, shape (D,)
    rms : float
        The fitness there.
    is_refined : bool
        Whether least squares ended there; else it is the champion of the search.
    evaluations : int
        Simulations of least squares and of scans from here.
    is_cut_short : bool
        Whether the time limit ended least squares.
    """

    theta: FloatArray
    rms: float
    is_refined: bool = False
    evaluations: int = 0
    is_cut_short: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class BestEstimate:
    """The best estimate of a search, analysed.

    Attributes
    ----------
    problem : Problem
        With the integration step that the estimate needs.
    ends : tuple of IslandEnd
        Of all islands, by least squares.
    minima : FoundMinima
    first : tuple of Estimate
        The estimates with the model's own integration step; empty if that is the one.
    noise : GeneralisedEstimate
        The estimate under the noise model.
    analysis : Analysis
        Of that estimate.
    explained : Explained
        What explains the residuals of least squares.
    starts : StartComparison or None
        The start that the estimate assumes, and the others; None if they were not compared.
    state : RunState
        The search, with the parameters of `problem`.
    free_run : ReplacedRun or None
        The estimate by squares, if a filter was chosen instead.
    sources : SourceComparison or None
        Other sources of noise; None if they were not compared.
    """

    problem: Problem
    ends: tuple[IslandEnd, ...]
    minima: FoundMinima
    first: tuple[Estimate, ...]
    noise: GeneralisedEstimate
    analysis: Analysis
    explained: Explained
    starts: StartComparison | None
    state: RunState
    free_run: ReplacedRun | None
    sources: SourceComparison | None

    @property
    def lowest_end(self) -> IslandEnd:
        """The best end of least squares, before a noise model."""
        return min(self.ends, key=lambda end: end.rms)


def is_refining(algorithm: GeneticAlgorithm, islands: int) -> bool:
    """Whether least squares continues from the end of a search."""
    methods = {get_island_settings(algorithm, i).method for i in range(islands)}
    return algorithm.refine and "improved" in methods


def find_best_estimate(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    budget: Budget,
    deadline: Deadline,
    *,
    explains: bool,
) -> BestEstimate:
    """Find the best estimate of a search that has ended, and analyse it.

    The integration step is halved until the estimates and their errors stand still, or until a
    limit is reached. Then those that still change are not identified, or have the change in their
    errors.

    With `explains`, residuals are explained, and intervals follow the profile likelihood where the
    linear model does not hold. If the data decide where the states start, they do so before and
    after the steps are halved. Without it, a run of a sweep takes no longer. Starts are compared
    if the setting asks for it, and residuals are explained if a noise model depends on it.
    """
    refines = is_refining(algorithm, len(state.islands))
    search = _EstimateSearch(
        problem, state, budget, deadline, refines=refines, compares_starts=explains
    )
    steps = _settle_steps(search)
    if search.hold_commands():
        steps = _settle_steps(search)
    recorded = search.compare_where_recorded()  # a noise model would hide a contradiction
    explained = search.explain(explains=explains)
    if search.use_plant_noise(explained):
        steps = _settle_steps(search)
        if search.hold_commands():
            steps = _settle_steps(search)
        recorded = search.compare_where_recorded()
        explained = search.explain(explains=explains)
    first, half, limit = steps
    is_settled = half is None or not half.changes
    noise = search.apply_noise_model(explained, is_settled=is_settled)
    minima = search.collect_minima(recorded)
    if explains and refines:
        search.follow_profiles(noise.theta)
    search.average_over_noise(noise.theta)
    parameters = search.problem.free_parameters
    marked = mark_poor_intervals(parameters, search.analysis.estimates)
    marked = mark_poor_intervals(parameters, mark_changing(marked, half, limit))
    analysis = replace(search.analysis, estimates=keep_in_bounds(marked))
    return BestEstimate(
        search.problem,
        tuple(search.ends),
        minima,
        first,
        noise,
        analysis,
        explained,
        search.starts,
        search.state,
        search.free_run,
        search.sources,
    )


class _SettledSteps(NamedTuple):
    """The estimates before the step was halved, the last comparison, and what forbade another."""

    first: tuple[Estimate, ...]
    half: HalfStep | None
    limit: str


def _settle_steps(search: "_EstimateSearch") -> _SettledSteps:
    """Analyse the best estimate, and halve the step until estimates and errors stand still."""
    search.choose_start()
    first: tuple[Estimate, ...] = ()
    while True:
        search.analyse_best()
        half = search.compare_half_step()
        if half is None or not half.changes:
            if search.choose_start():
                continue
            return _SettledSteps(first, half, "")
        estimates = search.analysis.estimates
        limit = search.use_half_step(half)
        if limit:
            if search.choose_start():
                continue
            return _SettledSteps(first, half, limit)
        first = first or estimates


class _EstimateSearch:
    """The steps from the champions of all islands to the best estimate.

    `ends` are those of the islands with the integration step of `problem`. The best of them is
    analysed. All simulations are counted in the budget.
    """

    analysis: Analysis
    _best: int
    _fits: list[Fit]

    def __init__(
        self,
        problem: Problem,
        state: RunState,
        budget: Budget,
        deadline: Deadline,
        *,
        refines: bool,
        compares_starts: bool,
    ) -> None:
        self.problem, self.state, self._budget = problem, state, budget
        self._initial = problem.settings.initial
        self._left: list[StartKind | None] = []
        self.starts: StartComparison | None = None
        self.free_run: ReplacedRun | None = None
        self.sources: SourceComparison | None = None
        self._deadline, self._refines = deadline, refines
        is_asked = compares_starts or self._initial == "auto"
        self._compares_starts = refines and is_asked
        self._reserved = compute_analysis_budget(len(state.islands[0].point))
        self._work = compute_work_limit(problem, state.evaluations)
        self._scanned: FloatArray | None = None
        self._projected = 0
        champions = [_get_champion(problem, island) for island in state.islands]
        self.ends = [
            IslandEnd(champion, island.champion_rms)
            for champion, island in zip(champions, state.islands, strict=True)
        ]
        if refines:
            most = budget.count_left(self._reserved)
            candidates = refine_candidates(problem, champions, most, deadline.is_past_grace)
            self.ends = [
                self._continue_end(end, candidate)
                for end, candidate in zip(self.ends, candidates, strict=True)
            ]

    @property
    def theta(self) -> FloatArray:
        """The best estimate (D,) by least squares."""
        return self.ends[self._best].theta

    def analyse_best(self) -> None:
        """Scan from the best of the ends, analyse the result, and search for minima near it."""
        self._choose_best()
        if self._refines:
            self._reweight()
            self._fits = self._find_minima()
        best = self.ends[self._best]
        groups, spent = find_exchanges(
            self.problem, best.theta, self._budget.count_left(self._reserved)
        )
        self._budget.spend(spent)
        if groups:
            self.ends = [
                replace(end, theta=order_exchangeable(self.problem, end.theta, groups))
                for end in self.ends
            ]
        self._scanned = self.theta
        self._analyse(self.theta, exchanges=groups)
        if self._refines:
            self._search_local_minima()

    def _choose_best(self) -> None:
        self._best = min(range(len(self.ends)), key=lambda i: self.ends[i].rms)

    def _reweight(self) -> None:
        """Weigh residuals by the noise of their series, if it is unequal; fit all ends again."""
        most, is_late = self._budget.count_left(self._reserved), self._deadline.is_past_grace
        fit = fit_unequal_noise(self.problem, self.theta, most, is_late)
        if fit is None:
            return
        self.problem = fit.problem
        self._budget.spend(fit.evaluations)
        self._move_best(IslandEnd(fit.theta, fit.rms, True), fit.evaluations)
        points = [end.theta for end in self.ends]
        values = self.problem.evaluate_fitness(np.array(points))
        most = self._budget.count_left(self._reserved)
        candidates = refine_candidates(self.problem, points, most, is_late)
        self.ends = [
            self._continue_end(replace(end, rms=rms), candidate)
            for end, rms, candidate in zip(self.ends, values.tolist(), candidates, strict=True)
        ]
        self._choose_best()

    def choose_start(self) -> bool:
        """Compare the starts if the data decide on them; move to a better one, if there is one.

        A start that was left is not taken again.
        """
        if not self._compares_starts:
            return False
        self._choose_best()
        if self._is_start_compared():
            return False
        most = self._budget.count_left(self._reserved)
        late = self._deadline.is_past_grace
        self.starts = compare_starts(self.problem, self.theta, self._initial, most, late)
        if self.starts is None:
            return False
        self._budget.spend(self.starts.evaluations)
        best = self.starts.best
        if best is self.starts.own or best.name in self._left:
            return False
        self._left.append(self.starts.own.name)
        self.starts = self.starts.take(best)
        self._use_start(best)
        return True

    def _is_start_compared(self) -> bool:
        """Whether the starts were compared at this estimate."""
        if self.starts is None or self.starts.own.problem is not self.problem:
            return False
        return is_same_point(self.problem, self.starts.own.theta, self.theta)

    def _use_start(self, best: FittedStart) -> None:
        """Continue with another start from the ends of all islands."""
        self._continue_with(best.problem, best.theta)

    def hold_commands(self) -> bool:
        """Read inputs held that a controller seems to compute, unless the request tells them."""
        if self.problem.settings.commands is not None or not self._refines:
            return False
        left = self._budget.count_left(self._reserved)
        simulations = Simulations(left, self._deadline.is_past_grace)
        commands = find_held_commands(self.problem, self.theta, simulations)
        self._budget.spend(simulations.spent)
        if not commands:
            return False
        self.starts, self._left = None, []
        self._continue_with(self.problem.rebuild(commands=commands, deviations=None), self.theta)
        return True

    def use_plant_noise(self, explained: Explained) -> bool:
        """Take a filter if noise inside the plant is likelier than what explains the residuals.

        It is as ordinary as the free run, so it takes strong odds. What was found has those of a
        defect, but for a closed loop, in which noise is a part of the input. The states may start
        otherwise beside a filter.
        """
        problem = self.problem
        if not self._may_choose_noise() or explained.criterion == -inf:
            return False
        ends = [one.theta for one in self.ends]
        known = (self.theta, *ends, *(one.theta for one in self._fits))
        most, late = self._budget.count_left(self._reserved), self._deadline.is_past_grace
        filters = fit_filters(problem, known, most, late)
        if not filters.fits:
            return False
        found = filters.fits[0]
        first_order, spent = fit_first_order_criterion(problem, self.theta)
        self._budget.spend(filters.evaluations + spent)
        gain = min(explained.criterion, first_order) - found.criterion
        defects = max(explained.odds, 0.0)
        is_likely, is_close = gain > STRONG_ODDS, gain - defects <= STRONG_ODDS
        feedback: tuple[Finding, ...] = ()
        if is_likely:
            simulated = problem.predict(self.theta[None])[0]
            feedback = tuple(find_feedback(problem, simulated, self.analysis))
        has_controller = is_likely and is_close and self._has_controller(feedback)
        values = dict(zip(problem.free_names, self.theta.tolist(), strict=True))
        if not is_likely or (gain <= defects and not has_controller):
            least = max(defects - STRONG_ODDS, 0.0)
            own = found.criterion + gain
            self.sources = SourceComparison("", values, self._list_open([found], own, least))
            return False
        others = self._list_open(filters.fits[1:], found.criterion, -STRONG_ODDS)
        if is_close and explained.findings and not has_controller:
            others = (*others, open_defect(explained.findings[0], values, defects - gain))
        self.sources = SourceComparison(name_source(found.problem), found.values, others)
        self.free_run = ReplacedRun(values, gain, feedback)
        self.starts, self._left = None, []
        equal = found.problem.rebuild(deviations=None)
        self._continue_with(equal, found.theta, found.sizes)
        return True

    def _has_controller(self, feedback: Sequence[Finding]) -> bool:
        """Whether a controller is declared or seen; an unstable plant must have one."""
        commands = self.problem.settings.commands
        if feedback or commands:
            return True
        return commands is None and compute_growth(self.problem, self.theta) >= MIN_GROWTH

    def _list_open(
        self, fits: Sequence[FilteredFit], criterion: float, least: float
    ) -> tuple[OpenSource, ...]:
        """List the sources of noise that lower a criterion by more than the least."""
        found = list[OpenSource]()
        for one in fits:
            gain = criterion - one.criterion
            if gain > least:
                analysis = analyse_estimate(one.problem, one.theta)
                self._budget.spend(analysis.evaluations)
                setting = f"loss: {{noise_model: {one.problem.loss.noise_model}}}"
                stderrs = {known.name: known.stderr for known in analysis.estimates if known.stderr}
                found.append(
                    OpenSource(name_source(one.problem), setting, gain, one.values, stderrs)
                )
        return tuple(found)

    def _continue_with(
        self, problem: Problem, theta: FloatArray, added: Mapping[str, float] | None = None
    ) -> None:
        """Continue with another problem from its estimate (D,), and from the ends of all islands.

        `added` are values of parameters that only that problem has.
        """
        before, self.problem, self._scanned = self.problem, problem, None
        self.state = convert_state(before, problem, self.state, added)
        points = [convert_point(before, problem, end.theta, added) for end in self.ends]
        points[self._best] = theta
        values = problem.evaluate_fitness(np.array(points))
        most = self._budget.count_left(self._reserved)
        candidates = refine_candidates(problem, points, most, self._deadline.is_past_grace)
        self.ends = [
            self._continue_end(replace(end, theta=point, rms=rms), candidate)
            for end, point, rms, candidate in zip(
                self.ends, points, values.tolist(), candidates, strict=True
            )
        ]

    def compare_half_step(self) -> HalfStep | None:
        """Compare the estimate with that of half the integration step."""
        most = self._budget.count_left(self._reserved)
        half = compare_half_step(self.problem, self.theta, self.analysis, most, self._is_late)
        self._budget.spend(0 if half is None else half.evaluations)
        return half

    def use_half_step(self, half: HalfStep) -> str:
        """Fit the champions of all islands with half the step; name the limit that forbids it.

        An island starts from the best of its champions with that step.
        """
        if not self._refines:
            return "estimates of this method are not refined"
        most = self._budget.count_left(self._reserved)
        limit = find_limit(half, self._work, most, self._deadline.is_past_grace)
        if limit:
            return limit
        most = self._budget.cap(self._work // half.problem.n_steps, self._reserved)
        latest = [[end.theta] for end in self.ends]
        latest[self._best].append(half.theta)
        champions = [
            [*(np.array(one.parameters) for one in island.history), *ends]
            for island, ends in zip(self.state.islands, latest, strict=True)
        ]
        starts, values, spent = choose_starts(half, champions)
        self._budget.spend(spent)
        if not np.isfinite(values).any():
            return "with half the step no simulation is finite"
        candidates = refine_candidates(
            half.problem, starts, max(0, most - spent), self._deadline.is_past_grace
        )
        each = spent // len(starts)
        self.ends = [
            self._continue_end(IslandEnd(start, rms, evaluations=end.evaluations + each), candidate)
            for start, rms, end, candidate in zip(
                starts, values.tolist(), self.ends, candidates, strict=True
            )
        ]
        self.problem = half.problem
        fitted = sum(0 if candidate is None else candidate.evaluations for candidate in candidates)
        self._work -= self.problem.n_steps * (fitted + spent)
        return ""

    def explain(self, *, explains: bool) -> Explained:
        """Explain the residuals of least squares, if asked for or if their colour needs it.

        Explanations that budget and time do not allow are left out.
        """
        if not (explains or self._may_choose_noise()):
            return Explained()
        left = self._budget.count_left(self._reserved)
        simulations = Simulations(left, self._deadline.is_past_grace)
        context = ResidualContext(self.problem, self.theta, self.analysis, simulations)
        explained = explain_residuals(context) if explains else explain_if_noise(context)
        self._budget.spend(simulations.spent)
        return explained

    def apply_noise_model(self, explained: Explained, *, is_settled: bool) -> GeneralisedEstimate:
        """Estimate and analyse under the noise model that was requested or selected.

        ``auto`` selects it for coloured residuals that nothing but noise explains. Estimates of
        the paper's methods stay unchanged. So do all if the residuals are consistent with white
        noise, or if the integration step is too long for them (not `is_settled`).
        """
        requested, squares = self.problem.loss.noise_model, GeneralisedEstimate(self.theta, {}, 0)
        if requested not in ("auto", "ar1") or not self._refines:
            return squares._replace(is_complete=requested != "ar1")
        if requested == "ar1":
            return self._use_noise_model()
        if not (is_settled and self._may_choose_noise() and explained.is_noise):
            return squares
        before = self.analysis
        estimate = self._use_noise_model()
        if estimate.is_complete:
            return estimate
        self.analysis = before
        return squares

    def _may_choose_noise(self) -> bool:
        """Whether the residuals of a free run by squares are coloured: else there is no choice."""
        problem, uncertainty = self.problem, self.analysis.uncertainty
        is_free = problem.is_free_run and problem.loss.kind == "squares"
        is_asked = problem.loss.noise_model == "auto" and self._refines
        colour = "white" if uncertainty is None else uncertainty.noise_colour
        return is_free and is_asked and colour in ("coloured", "drifting")

    def _use_noise_model(self) -> GeneralisedEstimate:
        """Estimate under first-order noise, and analyse, if the residuals are not white."""
        problem, theta, before = self.problem, self.theta, self.analysis
        uncertainty, most = before.uncertainty, self._count_noise_simulations()
        nothing = np.zeros((theta.size, theta.size))
        covariance = nothing if uncertainty is None else uncertainty.covariance
        estimate = fit_generalised_least_squares(problem, theta, covariance, self.state.seed, most)
        self._budget.spend(estimate.evaluations)
        if any(estimate.correlation_times.values()):
            white = make_whitening(problem, estimate.correlation_times)
            theta = order_exchangeable(problem, estimate.theta, before.exchanges)
            estimate = estimate._replace(theta=theta)
            self._analyse(theta, white, exchanges=before.exchanges)
            self.analysis = replace(self.analysis, is_cut_short=before.is_cut_short)
            self._widen_intervals(LocalMinima(None, estimate.minima, estimate.rms, 0))
        return estimate

    def _count_noise_simulations(self) -> int | None:
        """Count the simulations that a noise model may take, by budget and time."""
        state, left = self.state, self._budget.count_left(self._reserved)
        in_time = self._deadline.count_simulations_left(
            state.seconds, state.evaluations, self.problem.n_steps
        )
        return min((limit for limit in (left, in_time) if limit is not None), default=None)

    def compare_where_recorded(self) -> RecordedComparison:
        """Compare minima where the input is recorded, if the data contradict what is assumed."""
        if not self._refines:
            return RecordedComparison()
        recorded = compare_where_recorded(
            self.problem,
            self.theta,
            self.analysis,
            self._list_delays(),
            self._count_scan_simulations(),
            self._deadline.is_past_grace,
        )
        self._budget.spend(recorded.evaluations)
        return recorded

    def collect_minima(self, recorded: RecordedComparison) -> FoundMinima:
        """Collect the minima in which least squares ended, and those where input is recorded."""
        if not self._refines:
            return FoundMinima((), 0)
        problem, groups = self.problem, self.analysis.exchanges
        fits = self._fits
        if groups:
            fits = [
                replace(fit, theta=order_exchangeable(problem, fit.theta, groups)) for fit in fits
            ]
        minima = collect_minima(problem, fits, self.analysis.linear_model)
        own = find_nearest(problem, minima, self.theta)
        equal = own.rms * (1.0 + SAME_OPTIMUM)  # anywhere on a group's surface, or a mirror image
        agreeing = sum(one.independent for one in minima if one is own or one.rms <= equal)
        all_minima = (*minima, *recorded.minima)
        return FoundMinima(all_minima, agreeing, self._projected, recorded.is_contradicted)

    def follow_profiles(self, theta: FloatArray) -> None:
        """Replace the intervals around an estimate (D,) that those of a linear model miss."""
        if self._deadline.is_past_grace():
            return
        most = count_affordable_simulations(self.problem, self._deadline.is_over())
        found = find_profile_ends(self.problem, theta, self.analysis, self._budget.cap(most))
        self._budget.spend(found.evaluations)
        ends = {**found.by_name, **self._extrapolate_sets(theta, found, most - found.evaluations)}
        beyond = {
            name: self.analysis.minima[name].select_beyond(one.interval)
            for name, one in ends.items()
            if name in self.analysis.minima
        }
        estimates = compose_intervals(self.analysis.estimates, ends, beyond)
        self.analysis = replace(self.analysis, estimates=estimates)

    def average_over_noise(self, theta: FloatArray) -> None:
        """Extend the intervals around an estimate (D,) by what sizes of noise leave open."""
        uncertainty = self.analysis.uncertainty
        if uncertainty is None or not self.problem.model.corrections or self._is_late():
            return
        left = self._budget.count_left()
        found = explore_noise_sizes(self.problem, theta, uncertainty.covariance, left)
        self._budget.spend(found.evaluations)
        estimates = compose_intervals(self.analysis.estimates, found.average())
        self.analysis = replace(self.analysis, estimates=estimates)

    def _extrapolate_sets(
        self, theta: FloatArray, found: FoundEnds, most: int
    ) -> dict[str, ProfileEnds]:
        """Extrapolate the ends of sets of values that fit alike to an infinitely fine step."""
        sets = {name: ends for name, ends in found.by_name.items() if ends.is_set}
        if not sets or not can_halve_step(self.problem):
            return {}
        most = self._budget.cap(most)
        half = find_profile_ends(halve_step(self.problem), theta, self.analysis, most, sets)
        self._budget.spend(half.evaluations)
        return {
            name: extrapolate_ends(sets[name], ends)
            for name, ends in half.by_name.items()
            if ends.is_set
        }

    def _is_late(self) -> bool:
        """Whether no search may begin: the paper's methods have none."""
        return not self._refines or self._deadline.is_past_grace()

    def _continue_end(self, end: IslandEnd, candidate: RefinedCandidate | None) -> IslandEnd:
        """Continue from an end to what least squares found from there, if anything."""
        if candidate is None:
            return end
        self._budget.spend(candidate.evaluations)
        return IslandEnd(
            candidate.theta,
            candidate.rms,
            True,
            end.evaluations + candidate.evaluations,
            candidate.is_cut_short,
        )

    def _find_minima(self) -> list[Fit]:
        """Find minima by a scan from the best end and from those of the search; move to the best.

        Beside the estimate of a longer integration step its minima are fitted again instead.
        """
        end = self.ends[self._best]
        ends = [Fit(one.theta, one.rms) for one in self.ends if one.is_refined or one is end]
        if self._scanned is None or not is_same_point(self.problem, self._scanned, end.theta):
            fits, spent = self._scan_from(end, ends)
        else:
            fits, spent = self._repeat_fits(ends, self._count_scan_simulations())
        self._budget.spend(spent)
        fits = [*ends, *fits]
        best = min(fits, key=lambda fit: fit.rms)
        reached = end if best.rms >= end.rms else IslandEnd(best.theta, best.rms, True)
        self._move_best(reached, spent)
        return fits

    def _scan_from(self, end: IslandEnd, ends: list[Fit]) -> tuple[list[Fit], int]:
        """Scan from an end, and continue from the ends of the search; count the simulations."""
        problem, is_late = self.problem, self._deadline.is_past_grace
        start = RefinedCandidate(end.theta, end.rms, 0)
        most, delays = self._count_scan_simulations(), self._list_delays()
        is_doubtful = bool(delays) and self._is_doubtful(end)
        scanned = scan_parameters(problem, start, delays, most, is_late, is_doubtful=is_doubtful)
        fits, spent = [Fit(one.theta, one.rms) for one in scanned.ends[1:]], scanned.evaluations
        archived = [one for island in self.state.islands for one in read_archive(island.archive)]
        known = [*ends, *fits]
        continued, count = continue_from_archive(problem, archived, known, most - spent, is_late)
        fits, spent = fits + continued, spent + count
        if is_doubtful:
            most = count_affordable_simulations(problem, self._deadline.is_over(), _MOST_PROJECTED)
            most = self._budget.cap(most, spent, _SCAN_SHARES)
            projected = scan_by_projection(problem, start, self.state.seed, most, is_late)
            fits += [Fit(one.theta, one.rms, 1, 1) for one in projected.ends[1:]]
            spent += projected.evaluations
            self._projected = projected.starts
        return fits, spent

    def _is_doubtful(self, end: IslandEnd) -> bool:
        """Whether the search may have missed the best minimum, a time lag's above all.

        Innovations of a filter are white in any minimum, and show nothing. Nor does the search of
        a free run that it took the place of.
        """
        restarts = count_restarts(*self.state.champions_and_counters)
        share = _ENOUGH_SHARE * restarts.independent
        if restarts.confirmed > share and self.free_run is None:
            return False
        if self.problem.model.corrections:
            return True
        simulated = self.problem.predict(end.theta[None])[0]
        tests = run_residual_tests(self.problem, simulated, "estimation")
        return not is_explained(self.problem, end.rms, tests)

    def _repeat_fits(self, ends: list[Fit], most: int) -> tuple[list[Fit], int]:
        """Fit the minima of a longer integration step again, unless they are among the ends."""
        moved, fits, spent = [(end.theta, end) for end in ends], [], 0
        for fit in self._fits:
            near = next(
                (new for old, new in moved if is_same_point(self.problem, old, fit.theta)), None
            )
            if near is None:
                late = self._deadline.is_past_grace
                (end,) = refine_candidates(self.problem, [fit.theta], most - spent, late)
                if end is None:
                    continue
                spent += end.evaluations
                near = Fit(end.theta, end.rms)
                moved.append((fit.theta, near))
            fits.append(replace(near, count=fit.count, independent=fit.independent))
        return fits, spent

    def _search_local_minima(self) -> None:
        """Search the minima near the estimate; move to the best, with intervals that cover all."""
        problem, state, end = self.problem, self.state, self.ends[self._best]
        linear = self.analysis.linear_model
        if linear is None:
            return
        is_late = self._deadline.is_over()
        most = count_affordable_simulations(problem, is_late)
        if most == 0 and is_late:
            self.analysis = replace(self.analysis, is_cut_short=True)
            return
        shares = 2 if problem.loss.noise_model == "ar1" else 1  # the other is the noise model's
        most = self._budget.cap(most, self._reserved, shares)
        may_jump = self._may_jump()
        minima = find_local_minima(
            problem, end.theta, end.rms, linear, state.seed, most, may_jump=may_jump
        )
        self._budget.spend(minima.evaluations)
        self._move_best(end, minima.evaluations)
        if minima.best is not None:
            groups = self.analysis.exchanges
            theta = order_exchangeable(problem, minima.best.theta, groups)
            self._move_best(IslandEnd(theta, minima.best.rms, True))
            self._analyse(theta, exchanges=groups)
        self._widen_intervals(minima)

    def _may_jump(self) -> bool:
        """Whether the search met jumps of the loss, or did not probe for them."""
        searches = [island.search for island in self.state.islands]
        is_probed = any(one["hop_count"] > 0 for one in searches) and not self.state.is_warm
        return not is_probed or any(one["fitness_discontinuities"] > 0 for one in searches)

    def _move_best(self, reached: IslandEnd, evaluations: int = 0) -> None:
        """Move the best end to where these simulations led from it."""
        end = self.ends[self._best]
        self.ends[self._best] = replace(
            reached, evaluations=end.evaluations + evaluations, is_cut_short=end.is_cut_short
        )

    def _analyse(self, theta: FloatArray, *whitening: Whitening, exchanges: ExchangeGroups) -> None:
        analysis = analyse_estimate(self.problem, theta, self._budget.count_left(), *whitening)
        self.analysis = replace(analysis, exchanges=exchanges) if exchanges else analysis
        self._budget.spend(self.analysis.evaluations)

    def _widen_intervals(self, minima: LocalMinima) -> None:
        """Widen the intervals so that they contain those of all minima."""
        linear, likelihood = self.analysis.linear_model, self.analysis.likelihood
        if linear is None or likelihood is None:
            return
        problem = self.problem
        values = order_exchangeable(problem, minima.values, self.analysis.exchanges)
        near = list_compatible_minima(
            problem.free_names,
            problem.n_scored,
            replace(minima, values=values),
            linear.variance_ratio,
            likelihood.quantiles,
        )
        estimates = compose_intervals(self.analysis.estimates, near)
        self.analysis = replace(self.analysis, estimates=estimates, minima=near)

    def _count_scan_simulations(self) -> int:
        """Count the simulations that a scan may take."""
        most = count_affordable_simulations(self.problem, self._deadline.is_over())
        return self._budget.cap(most, shares=_SCAN_SHARES)

    def _list_delays(self) -> list[int]:
        """List the numbers of the free parameters that time lags depend on."""
        names = find_delay_parameters(self.problem)
        return [d for d, name in enumerate(self.problem.free_names) if name in names]


def _get_champion(problem: Problem, island: Island) -> FloatArray:
    if island.history:
        return np.array(island.history[-1].parameters)
    return 0.5 * (problem.evaluator.lower + problem.evaluator.upper)
