"""Reference values and Cramér–Rao bounds for the runs of a job with noise.

A job may have several problems, for example axes over datasets or bounds. Each has its own true
values. Bounds are proportional to σ, so one bound per problem serves every σ.

The dispatcher computes them when all runs of the job have ended, so that the web process need not
(decision 15). It does so problem by problem in a background thread, to keep the workers busy
(`service.dispatch.background`).
"""
