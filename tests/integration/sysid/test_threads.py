"""A result does not depend on how many threads the linear algebra may use."""

import contextlib
import io
import json
import os
import subprocess
import sys

import pytest

from sysid.core.threads import _load_libraries, use_one_thread
from tests.support.checkout import ROOT

CONCLUDED = """
import hashlib
import numpy as np
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.data.records import Channel
from sysid.data.records import Record
from sysid.core.settings import GeneticAlgorithm

times = 0.01 * np.arange(20_000)
random = np.random.default_rng(1)
u = np.repeat(random.standard_normal(200), 100)
y = 2.0 * np.convolve(u, np.exp(-times[:600]) * 0.01)[:20_000]
y += 0.01 * random.standard_normal(20_000)
record = Record((Channel("u", times, u),), (Channel("y", times, y),))
settings = GeneticAlgorithm(population=16, generations=4)
found = identify(load_model("fopdt"), record, settings, validation_fraction=0.2)
text = repr((found.parameters, found.rms, found.fit_percent, found.rms_validation, found.agreement,
             found.history, found.covariance.tobytes()))
print(hashlib.sha256(text.encode()).hexdigest())
"""


def conclude_with_two_threads() -> str:
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, "-c", CONCLUDED],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    return done.stdout


@pytest.mark.slow
def test_a_long_record_gives_the_same_bits_with_one_and_two_threads() -> None:
    told = io.StringIO()
    with use_one_thread(), contextlib.redirect_stdout(told):
        exec(compile(CONCLUDED, "concluded", "exec"), {})
    assert told.getvalue() == conclude_with_two_threads()


def test_the_number_of_threads_comes_back_when_the_last_caller_is_done() -> None:
    before = [library.get_threads() for library in _load_libraries()]
    for library in _load_libraries():
        library.set_threads(2)
    try:
        with use_one_thread():
            with use_one_thread():
                pass
            assert all(library.get_threads() == 1 for library in _load_libraries())
        assert all(library.get_threads() == 2 for library in _load_libraries())
    finally:
        for library, threads in zip(_load_libraries(), before, strict=True):
            library.set_threads(threads)


STARTED = """
import sys
from service.cli.main import main

assert "numpy" not in sys.modules
sys.argv = ["lagid", "--help"]
try:
    main()
except SystemExit:
    from sysid.core.threads import _load_libraries

    print([library.get_threads() for library in _load_libraries()], file=sys.stderr)
"""


@pytest.mark.skipif(os.cpu_count() == 1, reason="one processor: one thread anyway")
def test_a_process_of_the_command_line_has_one_thread_unless_told_otherwise() -> None:
    free = {name: text for name, text in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    assert threads_of_a_command(free) == {1}
    assert threads_of_a_command({**free, "OPENBLAS_NUM_THREADS": "2"}) == {2}


def threads_of_a_command(environment: dict[str, str]) -> set[int]:
    done = subprocess.run(
        [sys.executable, "-c", STARTED],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    return set(json.loads(done.stderr))
