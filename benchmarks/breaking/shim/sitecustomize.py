"""Put first on PYTHONPATH, this breaks a process from inside: its clock, its runs.

``BREAK_CLOCK`` names a file with seconds that are added to the time of day of rows;
``BREAK_SEEDS`` lists seeds of runs that kill the worker that computes them.
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
    advance = module.advance

    @functools.wraps(advance)
    def broken(pack, keys, *shared):
        if any(item.spec.seed in deadly for item in pack):
            os.kill(os.getpid(), signal.SIGKILL)
        return advance(pack, keys, *shared)

    module.advance = broken


_BREAKERS = {
    "service.storage.columns": ("BREAK_CLOCK", _break_clock),
    "workers.tasks": ("BREAK_SEEDS", _break_runs),
}


class _Finder(importlib.abc.MetaPathFinder):
    """Changes a module right after it was loaded."""

    def find_spec(self, fullname, path=None, target=None):
        """The usual module, with a loader that breaks it."""
        variable, breaker = _BREAKERS.get(fullname, ("", None))
        if breaker is None or not os.environ.get(variable):
            return None
        sys.meta_path.remove(self)
        try:
            spec = importlib.util.find_spec(fullname)
        finally:
            sys.meta_path.insert(0, self)
        execute = spec.loader.exec_module

        def load(module):
            execute(module)
            breaker(module)

        spec.loader.exec_module = load
        return spec


sys.meta_path.insert(0, _Finder())
