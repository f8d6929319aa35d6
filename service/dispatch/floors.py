"""What the runs of a job with noise are measured by: true values, and the Cramér–Rao floor.

A job may pose several problems (axes over datasets or bounds, say); each has a truth of its own.
σ enters in proportion, so one floor a problem serves every σ. It is made here, in the dispatcher
and when all runs of the job are over, so that the web process need not compute (decision 15); in a
thread of its own, problem by problem, so that the workers are fed
meanwhile (`service.dispatch.background`).
"""
