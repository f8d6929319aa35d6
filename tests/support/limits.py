"""How long a test waits for what must happen: the time limits of all tests, by the clock."""

LIMIT_SECONDS = 240.0
"""Beside other work the search alone compiles for two minutes.

The limit of pytest counts for set-up, test and tear-down together. Two waits end before it, so
that a test that fails says what it waited for.
"""
