"""The catalogue's family of processes with dead time, and the position of each entry in it.

A process is K e^(-Ls)/((T1 s + 1)(T2 s + 1)…), or the same behind an integrator 1/s. Entries of the
family differ in the number of their first-order parts. So each has a neighbour with one order more
or one less.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple


class Process(NamedTuple):
    """A process with dead time.

    Attributes
    ----------
    gain : float
        Static gain; with an integrator the slope of the output at u = 1.
    time_constants : tuple of float
        Of the first-order parts (s), the slowest first.
    delay : float
        Dead time (s).
    offset : float
        Output at u = 0; 0 with an integrator.
    integrators : {0, 1}
    """

    gain: float
    time_constants: tuple[float, ...]
    delay: float
    offset: float = 0.0
    integrators: int = 0


class ProcessEntry(NamedTuple):
    """The position of a model of the catalogue in the family.

    Attributes
    ----------
    model : str
        Name in the catalogue.
    parts : int
        First-order parts.
    integrators : {0, 1}
    to_parameters : callable
        The model's parameters of a process with as many parts.
    """

    model: str
    parts: int
    integrators: int
    to_parameters: Callable[[Process], Mapping[str, float]]

    @property
    def order(self) -> int:
        """Number of poles."""
        return self.parts + self.integrators


_ENTRIES = (
    ProcessEntry(
        "fopdt",
        1,
        0,
        lambda p: {"K": p.gain, "T": p.time_constants[0], "L": p.delay, "y0": p.offset},
    ),
    ProcessEntry(
        "sopdt",
        2,
        0,
        lambda p: {
            "K": p.gain,
            "T1": p.time_constants[0],
            "r": p.time_constants[1] / p.time_constants[0],
            "L": p.delay,
            "y0": p.offset,
        },
    ),
    ProcessEntry(
        "topdt",
        3,
        0,
        lambda p: {
            "K": p.gain,
            "T1": p.time_constants[0],
            "r2": p.time_constants[1] / p.time_constants[0],
            "r3": p.time_constants[2] / p.time_constants[1],
            "L": p.delay,
            "y0": p.offset,
        },
    ),
    ProcessEntry("ipdt", 0, 1, lambda p: {"K": p.gain, "L": p.delay}),
    ProcessEntry("foipdt", 1, 1, lambda p: {"K": p.gain, "T": p.time_constants[0], "L": p.delay}),
)


def list_neighbouring_orders(process: Process) -> tuple[ProcessEntry, ...]:
    """List the entries with one part less, as many, and one more, as far as there are any.

    Empty if the catalogue has no entry with as many parts as the process.

    Examples
    --------
    >>> [entry.model for entry in list_neighbouring_orders(Process(2.0, (1.5,), 0.4))]
    ['fopdt', 'sopdt']
    """
    own = len(process.time_constants)
    family = [entry for entry in _ENTRIES if entry.integrators == process.integrators]
    if own not in {entry.parts for entry in family}:
        return ()
    return tuple(entry for entry in family if abs(entry.parts - own) <= 1)
