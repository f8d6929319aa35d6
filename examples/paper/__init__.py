"""Reproduce the paper's tables and figures by real jobs of a service.

``python -m examples.paper`` starts a service, submits the jobs of each part, and prints the tables.
The figures are in an HTML report. A part of the study is a module: `series`, `oscillators`,
`noise` with `force_noise`, `tube`, `actuator`. Each gives sections of plain tables and figures.
"""
