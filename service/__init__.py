"""REST, pages, command line, storage and dispatch."""

_DISTRIBUTION = "lagid"
"""Tells this package from others of the name; `lagid` looks at it."""
