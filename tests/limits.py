"""How long a test waits for what must happen: the time limits of all tests, by the clock."""

LIMIT_SECONDS = 240.0
"""Below the limit of pytest. Beside other work the search alone compiles for two minutes."""
