"""Vector versions of exp, log, pow, sin …, where the machine's C library has them.

LLVM has no instructions for these functions and would call the scalar one for each lane. GNU's
libmvec computes 8 (AVX-512), 4 (AVX2) or 2 lanes in one call, within 4 units in the last place;
lanes do not influence one another. Its symbols are named by the x86-64 vector function ABI:
``_ZGV`` instruction set ``N`` lanes, one ``v`` for each argument, ``_`` name. Elsewhere, and for
functions an older libmvec lacks, the scalar calls stay.
"""

import ctypes
import platform
from functools import cache
from typing import NamedTuple

import llvmlite.binding as llvm

_LIBRARY = "libmvec.so.1"
_ARGUMENTS = {"exp": 1, "log": 1, "sin": 1, "cos": 1, "tan": 1, "tanh": 1, "atan": 1, "pow": 2}


class VectorFunctions(NamedTuple):
    """What the machine offers: lanes a call, and the symbol of each function that is there."""

    lanes: int
    symbols: dict[str, str]


@cache
def vector_functions() -> VectorFunctions:
    """The vector functions of this machine, loaded so that compiled code finds them."""
    none = VectorFunctions(1, {})
    if platform.machine() != "x86_64":
        return none
    try:
        library = ctypes.CDLL(_LIBRARY)
    except OSError:
        return none
    llvm.load_library_permanently(_LIBRARY)
    features = llvm.get_host_cpu_features()
    wide = (("avx512f", "e", 8), ("avx2", "d", 4), ("sse2", "b", 2))
    letter, lanes = next((isa, n) for feature, isa, n in wide if features.get(feature))
    names = {
        name: f"_ZGV{letter}N{lanes}{'v' * count}_{name}" for name, count in _ARGUMENTS.items()
    }
    return VectorFunctions(lanes, {n: s for n, s in names.items() if hasattr(library, s)})
