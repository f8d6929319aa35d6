"""Levels of the judgement, each with its source or its measurement, in one table.

Odds are compared as twice their logarithm, the scale of Schwarz's criterion (Kass and Raftery, J.
Am. Stat. Assoc. 90 (1995) 773).
"""

STRONG_ODDS = 6.0
"""2 ln 20: odds of 20 to 1, "strong evidence" (Kass and Raftery 1995). For alternatives that are as
ordinary as the model itself: another order, reading or start."""

DEFECT_GAIN = 12.0
"""2 ln 20 + 2 ln 20: strong evidence for a defect of which a record in twenty has one. That many
explanations are tried is paid for by it too (Scott and Berger, Ann. Statist. 38 (2010) 2587)."""

NOTABLE_MOVE = 1.0
"""Standard errors of an estimate. What moves it by less is covered by its error."""

SEPARABLE = 2.0
"""Standard errors: a smaller time lag is not distinguishable from 0 (95 %)."""

UNLIKELY_MOVE = 3.3
"""Standard errors: two consistent estimates differ by more in one of a thousand records (normal
quantile)."""

UNLIKELY = 1e-3
"""Probability of residuals under a true model: below it, a test has failed clearly. One in a
thousand records is hedged for nothing."""

SOLVER_SHARE = 1e-5
"""Of the output: smaller residuals are the errors of the integration, and no noise."""

BENT_SHARE = 0.25
"""Of the variance of the residuals. An explanation that takes more, and that changes the response
itself, is no small change: moves by a linear step are not to be relied on. Measured with
`benchmarks.judgement`: of crosstalk, curves and missing parts, that left values four errors off."""

ADDED_SHARE = 0.8
"""The same for what only adds to the output, such as a drift. With larger ones the search itself
was led astray (`unit_jump` of the benchmark)."""
