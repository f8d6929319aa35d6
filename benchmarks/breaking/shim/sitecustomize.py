"""Break a process from inside, its clock or its runs; must be first on PYTHONPATH.

``BREAK_CLOCK`` names a file with seconds that are added to the times of rows. ``BREAK_SEEDS`` lists
the seeds of runs that kill their worker. ``BREAK_MEMORY`` lists the seeds of runs that take all
available memory. While the file ``BREAK_RAY`` exists, Ray does not start. ``BREAK_PARCELS`` is the
number of runs of a parcel, so that also a small sweep has several.
"""

import functools
import importlib.abc
import importlib.util
import os
import signal
import sys
from datetime import datetime, timedelta
from pathlib import Path


class _Stepped(datetime):
    """A clock that somebody has set."""

    @classmethod
    def now(cls, tz=None):
        """The time with the step of this moment."""
        step = Path(os.environ["BREAK_CLOCK"]).read_text()
        return datetime.now(tz) + timedelta(seconds=float(step or 0.0))


def _break_clock(module):
    module.datetime = _Stepped


def _break_runs(module):
    deadly = {int(seed) for seed in os.environ["BREAK_SEEDS"].split(",")}
    advance = module.process_pack

    @functools.wraps(advance)
    def broken(pack, keys, *shared):
        if any(item.spec.seed in deadly for item in pack):
            os.kill(os.getpid(), signal.SIGKILL)
        return advance(pack, keys, *shared)

    module.process_pack = broken


def _break_memory(module):
    greedy = {int(seed) for seed in os.environ["BREAK_MEMORY"].split(",")}
    advanced = module._advance_item

    def broken(item, *parts):
        blocks = []
        while item.spec.seed in greedy:
            blocks.append(b"x" * 2**24)
        return advanced(item, *parts)

    module._advance_item = broken


def _break_start(module):
    initialise = module._start_ray

    def broken(*arguments):
        if Path(os.environ["BREAK_RAY"]).exists():
            raise ConnectionError("nobody answers")
        initialise(*arguments)

    module._start_ray = broken


def _break_sizes(module):
    size = int(os.environ["BREAK_PARCELS"])
    module.FIRST_RUNS = module.MAX_RUNS = size
    module.RUNS_PER_CORE = 0


_BREAKERS = {
    ("service.dispatch.held_jobs", "BREAK_PARCELS"): _break_sizes,
    ("service.storage.columns", "BREAK_CLOCK"): _break_clock,
    ("workers.tasks", "BREAK_SEEDS"): _break_runs,
    ("workers.tasks", "BREAK_MEMORY"): _break_memory,
    ("workers.local_ray", "BREAK_RAY"): _break_start,
}


class _Finder(importlib.abc.MetaPathFinder):
    """Changes a module right after it was loaded."""

    def find_spec(self, fullname, path=None, target=None):
        """The usual module, with a loader that breaks it."""
        breakers = [
            breaker
            for (module, variable), breaker in _BREAKERS.items()
            if module == fullname and os.environ.get(variable)
        ]
        if not breakers:
            return None
        sys.meta_path.remove(self)
        try:
            spec = importlib.util.find_spec(fullname)
        finally:
            sys.meta_path.insert(0, self)
        execute = spec.loader.exec_module

        def load(module):
            execute(module)
            for breaker in breakers:
                breaker(module)

        spec.loader.exec_module = load
        return spec


sys.meta_path.insert(0, _Finder())
