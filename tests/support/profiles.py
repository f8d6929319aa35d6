"""How much a test repeats: little at the gate, much at night.

`LAGID_TEST_PROFILE` is ``gate`` (the default: the same examples and draws each time), ``dev`` (as
many examples as a test asks for, fresh ones) or ``night`` (many more of both, fresh ones).
`LAGID_NIGHT_SEED` repeats the draws of a night; the header of its output names it. Tests marked
`night` are left to the night.
"""

import os
import secrets

import pytest
from hypothesis import HealthCheck, settings

PROFILES = ("gate", "dev", "night")
PROFILE = os.environ.get("LAGID_TEST_PROFILE", "gate")
if PROFILE not in PROFILES:
    raise ValueError(f"LAGID_TEST_PROFILE is {PROFILE!r}; need one of {', '.join(PROFILES)}")

GATE_EXAMPLES = 40
"""Most examples of a law at the gate."""
NIGHT_FACTOR = 5
"""How many times as many examples a law has at night as it asks for."""

# Kept in the environment: all processes of one run have the same draws.
_NIGHT_SEED = int(os.environ.setdefault("LAGID_NIGHT_SEED", str(secrets.randbelow(10**9))))

# How long an example takes tells of the machine's load, not of the program.
_COMMON = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("gate", _COMMON, max_examples=GATE_EXAMPLES, derandomize=True)
settings.register_profile("dev", _COMMON)
settings.register_profile("night", _COMMON, max_examples=100 * NIGHT_FACTOR)
settings.load_profile(PROFILE)


def scale_examples(count: int) -> int:
    """Return how many examples a law that asks for `count` has in this profile."""
    if PROFILE == "night":
        return NIGHT_FACTOR * count
    return min(count, GATE_EXAMPLES) if PROFILE == "gate" else count


def draw_seeds(*, gate: int, night: int) -> range:
    """Return the seeds of a statistic: the first `gate` ones, at night `night` fresh ones."""
    if PROFILE == "night":
        return range(_NIGHT_SEED, _NIGHT_SEED + night)
    return range(gate)


def pytest_report_header() -> str:
    """Name the profile, and what repeats its draws."""
    seed = f", LAGID_NIGHT_SEED={_NIGHT_SEED}" if PROFILE == "night" else ""
    return f"LAGID_TEST_PROFILE={PROFILE}{seed}"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect what is left to the night, unless the command line says which marks it wants."""
    if PROFILE == "night" or "night" in config.getoption("markexpr"):
        return
    left = [item for item in items if item.get_closest_marker("night")]
    if left:
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if item not in left]
