"""Samples of the posterior distribution of the free parameters.

The likelihood assumes the same noise as the standard errors (`sysid.uncertainty.likelihood`). The
prior is uniform between the bounds, on a log scale uniform in the logarithm. So in a linear model
inside its bounds the samples have the reported intervals. Elsewhere they show what the covariance
cannot: curved valleys, several minima, a bound.

An ensemble of walkers takes the samples (emcee; Foreman-Mackey et al., PASP 125, 2013, 306). Half
of the walkers move at once, in one call of the kernel. Most moves are differences of two other
walkers (ter Braak, Stat. Comput. 16, 2006, 239). Those of full length lead from one minimum to
another.

The first fifth of the steps is left out. The chain has converged if the rest is 50 times as long as
the integrated autocorrelation time of every parameter (Sokal 1996). Deviations are from the mean of
all walkers. So walkers that stay in different minima are seen, too.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sysid.core.distributions import CHI_SQUARE_95
from sysid.core.linear_algebra import compute_truncated_svd
from sysid.core.types import FloatArray
from sysid.core.units import format_unit
from sysid.identifiability.exchange import ExchangeGroups, order_exchangeable
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit, to_unit
from sysid.uncertainty.analysis import Analysis
from sysid.uncertainty.estimates import CorrelationMatrix, Estimate, Posterior, PosteriorParameter
from sysid.uncertainty.likelihood import Likelihood, LikelihoodModel

_RANDOM_STREAM = 2**63 + 1
_MIN_WALKERS, _WALKERS_PER_PARAMETER, _LANES = 32, 4, 16  # half of the lanes move at once
_MOVE_SHARES = (0.8, 0.1, 0.1)  # differences, differences of full length, stretches
_SHARES_OF_MINIMA = (0.5, 0.4, 0.1)  # the same if several minima are known
_MAX_SPREAD = 0.3  # of the range: standard deviation of the starts, nearly that of a uniform law
_MAX_DROP = 10.0  # and one for each parameter: logarithm by which a start may be less likely
_MAX_SHRINKS = 20  # halvings of the distance of a start that is much too unlikely
_FIRST_STEPS, _GROWTH = 200, 1.25  # steps before the first test of convergence; their growth
_BURN_IN = 5  # the first of so many parts is left out
_MIN_TIMES = 50.0  # autocorrelation times that a converged chain is long
_WINDOW = 5.0  # autocorrelation times over which correlations are summed
_ALIKE = 2.0  # ratio of the widths of two intervals
_SAME_POINT = 1e-3  # of the range: a minimum nearer to the estimate is the estimate
_MIN_STEPS = 20  # of a chain that is worth reporting
_MAX_SIMULATIONS = 200_000
_MAX_WORK = 1_000_000_000  # steps of integration or recursion: about 10 s
_MAX_SAMPLES = 1000  # that a result keeps
_LIMIT_MET = "the limit of simulations"
_ROUNDING_RMS = 1e-9  # of the outputs' size: residuals that are rounding


def sample_posterior(
    problem: Problem,
    theta: FloatArray,
    analysis: Analysis,
    others: Sequence[FloatArray],
    seed: int,
    max_simulations: int | None = None,
    is_late: Callable[[], bool] = lambda: False,
) -> Posterior:
    """Sample the posterior around an estimate (D,) and `others`, minima that fit nearly as well.

    At most `max_simulations` simulations are used. `is_late` is called after every step.
    """
    obstacle = _find_obstacle(problem, theta, analysis)
    if obstacle or analysis.likelihood is None:
        return _make_empty_posterior(theta.size, obstacle)
    limit = min(_MAX_SIMULATIONS, _MAX_WORK // max(problem.n_steps, 1))
    if max_simulations is not None:
        limit = min(limit, max_simulations)
    centres = np.array([theta, *others])
    sampler = _Sampler(problem, analysis.likelihood, analysis.exchanges, centres, seed)
    if not sampler.run(limit, is_late):
        reason = "the limits of simulations and time left too few steps"
        return _make_empty_posterior(theta.size, reason, sampler.evaluations)
    return sampler.summarise()


def _make_empty_posterior(d: int, reason: str, evaluations: int = 0) -> Posterior:
    none, no_correlation = np.zeros((0, d)), CorrelationMatrix((), np.zeros((0, 0)))
    return Posterior((), none, no_correlation, 0, 0, 0.0, evaluations, False, reason)


def describe_posterior(posterior: Posterior, estimates: Sequence[Estimate] = ()) -> list[str]:
    """Describe why there are no samples, what is wrong with them, or where errors differ."""
    if not posterior.parameters:
        return [f"no posterior was sampled: {posterior.reason}"]
    described = []
    if not posterior.converged:
        described.append(
            f"the samples of the posterior have not converged: {posterior.reason}. Take their "
            "intervals as a rough indication"
        )
    if posterior.gain > CHI_SQUARE_95:
        described.append(
            "samples of the posterior fit clearly better than the estimate (likelihood ratio "
            f"{posterior.gain:.3g}). The search missed a better minimum: search longer, or with "
            "another seed"
        )
    return [*described, *_describe_differences(posterior, estimates)]


def _describe_differences(posterior: Posterior, estimates: Sequence[Estimate]) -> list[str]:
    """Describe the parameters whose interval has another width than that of the samples."""
    by_name = {one.name: one for one in estimates if one.stderr and one.interval95 is not None}
    differences = []
    for sampled in posterior.parameters if posterior.converged else ():
        low, high = sampled.interval95
        if sampled.name in by_name and high > low:
            stated = by_name[sampled.name].interval95 or (0.0, 0.0)
            if not 1.0 / _ALIKE <= (stated[1] - stated[0]) / (high - low) <= _ALIKE:
                unit = format_unit(sampled.unit)
                differences.append(
                    f"{sampled.name} is from {low:.4g} to {high:.4g}{unit} by the posterior, from "
                    f"{stated[0]:.4g} to {stated[1]:.4g}{unit} by the standard error"
                )
    if not differences:
        return []
    return [
        f"{'; '.join(differences)}. The posterior follows bounds and curved valleys, the standard "
        "error a linear model. Take the posterior if the bounds are physical limits"
    ]


def _find_obstacle(problem: Problem, theta: FloatArray, analysis: Analysis) -> str:
    """Find what prevents a likelihood; empty if nothing does."""
    if analysis.likelihood is None:
        return next(
            (one.reason for one in analysis.estimates if one.reason and one.stderr is None),
            "there are no standard errors",
        )
    rms = float(problem.evaluate_fitness(theta[None])[0])
    if rms <= _ROUNDING_RMS * problem.output_scale:
        return "the simulation equals the records up to rounding"
    return ""


class _Sampler:
    """Ensemble of walkers in unit coordinates, counting simulations."""

    def __init__(
        self,
        problem: Problem,
        likelihood: LikelihoodModel,
        groups: ExchangeGroups,
        centres: FloatArray,
        seed: int,
    ) -> None:
        self._problem, self._groups = problem, groups
        self._likelihood = Likelihood(problem, likelihood)
        self._random = np.random.Generator(np.random.Philox(key=[seed, _RANDOM_STREAM]))
        points = to_unit(problem.evaluator, centres)
        is_other = np.max(np.abs(points - points[0]), axis=1) > _SAME_POINT
        self._centres = np.vstack([points[:1], points[is_other]])
        self._spread = _factor_start_covariance(likelihood)
        self._least_ratio, self.evaluations, self._cause = 0.0, 0, _LIMIT_MET
        wanted = max(_MIN_WALKERS, _WALKERS_PER_PARAMETER * centres.shape[1])
        self._walkers = -(-wanted // _LANES) * _LANES
        self._ensemble: Any = None

    def run(self, limit: int, is_late: Callable[[], bool]) -> bool:
        """Move the walkers until they converge or a limit is met; return whether there is a chain.

        emcee is imported only here, because that takes a second.
        """
        if limit < (_MIN_STEPS + _MAX_SHRINKS) * self._walkers:
            return False
        from emcee import EnsembleSampler, State
        from emcee.moves import DEMove, StretchMove

        moves = (DEMove(), DEMove(gamma0=1.0), StretchMove())
        shares = _MOVE_SHARES if len(self._centres) == 1 else _SHARES_OF_MINIMA
        self._ensemble = EnsembleSampler(
            self._walkers,
            self._centres.shape[1],
            self._compute_logarithms,
            moves=list(zip(moves, shares, strict=True)),
            vectorize=True,
        )
        points, logarithms = self._make_starts()
        random = np.random.RandomState(int(self._random.integers(2**32))).get_state()
        state = State(points, log_prob=logarithms, random_state=random)
        steps = self._ensemble.sample(
            state, iterations=limit // (self._walkers // 2), skip_initial_state_check=True
        )
        target = _FIRST_STEPS
        with np.errstate(invalid="ignore"):  # a walker that starts where the simulation diverges
            for step, _ in enumerate(steps, 1):
                if step >= target:
                    if self._has_converged():
                        break
                    target = int(_GROWTH * target)
                self._cause = self._find_cause(limit, is_late)
                if self._cause:
                    break
        return bool(self._ensemble.iteration >= _MIN_STEPS)

    def summarise(self) -> Posterior:
        """Summarise the chain."""
        chain = self._get_chain()
        times = _compute_autocorrelation_times(chain)
        flat = chain.reshape(-1, chain.shape[2])
        low, middle, high = np.quantile(flat, [0.025, 0.5, 0.975], axis=0)
        reason = ""
        if not self._has_converged():
            worst = int(np.argmax(times))
            reason = (
                f"the chain is {len(chain) / times[worst]:.0f} autocorrelation times of "
                f"{self._problem.free_names[worst]} long, and needs {_MIN_TIMES:.0f}; "
                f"{self._cause} ended it"
            )
        kept = self._random.choice(len(flat), min(len(flat), _MAX_SAMPLES), replace=False)
        return Posterior(
            tuple(
                PosteriorParameter(
                    parameter.name,
                    parameter.unit,
                    float(middle[d]),
                    (float(low[d]), float(high[d])),
                    float(len(flat) / times[d]),
                )
                for d, parameter in enumerate(self._problem.free_parameters)
            ),
            flat[np.sort(kept)],
            CorrelationMatrix(self._problem.free_names, _compute_correlation(flat)),
            self._walkers,
            int(self._ensemble.iteration),
            float(np.mean(self._ensemble.acceptance_fraction)),
            self.evaluations,
            not reason,
            reason,
            abs(self._least_ratio),
        )

    def _compute_logarithms(self, points: FloatArray) -> FloatArray:
        """Compute the logarithm (P,) of the posterior at points (P, D)."""
        logarithms = np.full(len(points), -np.inf)
        inside = np.all((points >= 0.0) & (points <= 1.0), axis=1)
        if inside.any():
            ratios = self._likelihood.compute_ratios(
                from_unit(self._problem.evaluator, points[inside])
            )
            self.evaluations += ratios.size
            self._least_ratio = min(self._least_ratio, float(np.min(ratios)))
            logarithms[inside] = self._likelihood.to_logarithms(ratios)
        return logarithms

    def _make_starts(self) -> tuple[FloatArray, FloatArray]:
        """Draw points (W, D) of the walkers around the minima, with their logarithms (W,).

        A minimum has as many walkers as its likelihood suggests. Walkers that are much less likely
        than their minimum would hardly move, so they start nearer to it.
        """
        of_centres = self._compute_logarithms(self._centres)
        weights = np.cumsum(np.exp(of_centres - np.max(of_centres)))
        chosen = np.searchsorted(
            weights, (np.arange(self._walkers) + 0.5) / self._walkers * weights[-1]
        )
        centres, dimensions = self._centres[chosen], self._centres.shape[1]
        moves = self._random.standard_normal(centres.shape) @ self._spread
        points = _fold(centres + moves)
        logarithms = self._compute_logarithms(points)
        least = of_centres[chosen] - (dimensions + _MAX_DROP)
        for _ in range(_MAX_SHRINKS):
            far = np.flatnonzero(~(logarithms >= least))
            if not far.size:
                break
            moves[far] *= 0.5
            points[far] = _fold(centres[far] + moves[far])
            logarithms[far] = self._compute_logarithms(points[far])
        return points, logarithms

    def _find_cause(self, limit: int, is_late: Callable[[], bool]) -> str:
        """Find what ends the chain; empty if nothing does."""
        if self.evaluations + self._walkers > limit:
            return _LIMIT_MET
        return "the time limit" if is_late() else ""

    def _has_converged(self) -> bool:
        if self._ensemble.iteration < _FIRST_STEPS:
            return False
        chain = self._get_chain()
        return bool(len(chain) >= _MIN_TIMES * np.max(_compute_autocorrelation_times(chain)))

    def _get_chain(self) -> FloatArray:
        """Get the values (N, W, D) of the walkers after the first part."""
        steps = self._ensemble.iteration
        chain = self._ensemble.get_chain(discard=steps // _BURN_IN)
        values = from_unit(self._problem.evaluator, chain.reshape(-1, chain.shape[2]))
        return order_exchangeable(self._problem, values, self._groups).reshape(chain.shape)


def _factor_start_covariance(likelihood: LikelihoodModel) -> FloatArray:
    """Factor the covariance of the starts, RᵀR with R (D, D): s²(SᵀS)⁻¹, but at most the range."""
    n, d = likelihood.columns.shape
    noise = np.sqrt(float(likelihood.residuals @ likelihood.residuals) / (n - d))
    _, singular, rows, retained = compute_truncated_svd(likelihood.columns)
    deviation = np.full(d, _MAX_SPREAD)
    deviation[retained] = np.minimum(noise / singular[retained], _MAX_SPREAD)
    return deviation[:, None] * rows


def _fold(points: FloatArray) -> FloatArray:
    """Reflect points at 0 and 1."""
    return np.asarray(1.0 - np.abs(1.0 - np.mod(points, 2.0)))


def _compute_autocorrelation_times(chain: FloatArray) -> FloatArray:
    """Compute the integrated autocorrelation times (D,) of a chain (N, W, D), in steps."""
    steps = len(chain)
    spectrum = np.fft.rfft(chain - np.mean(chain, axis=(0, 1)), 2 * steps, axis=0)
    covariance = np.mean(np.fft.irfft(np.abs(spectrum) ** 2, axis=0)[:steps], axis=1)
    times = np.full(chain.shape[2], float(steps))
    for d in np.flatnonzero(covariance[0] > 0.0):
        sums = 2.0 * np.cumsum(covariance[:, d] / covariance[0, d]) - 1.0
        window = np.flatnonzero(np.arange(steps) >= _WINDOW * sums)
        times[d] = max(sums[window[0]], 1.0) if window.size else steps
    return times


def _compute_correlation(flat: FloatArray) -> FloatArray:
    covariance = np.atleast_2d(np.cov(flat, rowvar=False))
    deviation = np.sqrt(np.diag(covariance))
    safe = np.where(deviation > 0.0, deviation, 1.0)
    correlation = np.clip(covariance / np.outer(safe, safe), -1.0, 1.0)
    np.fill_diagonal(correlation, 1.0)
    return np.asarray(correlation)
