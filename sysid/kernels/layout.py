"""How an experiment's numbers lie in `ints` and `floats`, for those who write and who read them.

Both begin with a head of fixed places; the arrays follow, and the head says where. All places
count from the experiment's own beginning.
"""

from dataclasses import dataclass

from sysid.models.model import Model

HEAD_FIELDS = ("last", "reach", "rows")
"""Last integration step; rows of history that lags reach back; rows of the history's buffer."""

STATE_FIELDS = ("row", "given")
"""Row of theta that holds the initial value, or -1; place of the given first samples, or -1."""

INPUT_FIELDS = ("zero", "points", "begin", "end", "cap")
"""Place of the value at step 0; fine points in a step; where a step begins and ends, in fine
points (they differ from 0 and `points` where a held input jumps); largest lag in fine points."""

OUTPUT_FIELDS = ("measured", "weight", "samples", "fraction", "first", "grid")
"""Places of measured values and weights; place (in ints) of each grid point's row or of the
bounds of its interval's samples; place of the samples' positions inside their interval; first row
of the predictions; place of the measurement interpolated to the grid."""

FLOAT_FIELDS = ("step", "cap", "scale")
"""Integration step in s (difference form: h); largest lag in steps; scale of soft-l1. The
states' initial values follow."""


@dataclass(frozen=True, slots=True)
class KernelVariant:
    """What is compiled into a kernel besides the model.

    Attributes
    ----------
    one_step : bool
        Measured outputs replace the states they measure.
    soft : bool
        The loss is soft-l1 instead of squares.
    on_grid : bool
        Every measured sample lies on a grid point of its own.
    weighted : bool
        Some weight is not 1.
    """

    one_step: bool = False
    soft: bool = False
    on_grid: bool = True
    weighted: bool = False


@dataclass(frozen=True, slots=True)
class ExperimentLayout:
    """Places of the head, in ints, for a model of these sizes."""

    states: int
    inputs: int
    outputs: int

    @classmethod
    def from_model(cls, model: Model) -> "ExperimentLayout":
        """Layout for a model's experiments."""
        return cls(len(model.states), len(model.inputs), len(model.outputs))

    def locate_state(self, number: int, field: str) -> int:
        """Place of a state's entry."""
        return len(HEAD_FIELDS) + number * len(STATE_FIELDS) + STATE_FIELDS.index(field)

    def locate_input(self, number: int, field: str) -> int:
        """Place of an input's entry."""
        return (
            self.locate_state(self.states, STATE_FIELDS[0])
            + number * len(INPUT_FIELDS)
            + INPUT_FIELDS.index(field)
        )

    def locate_output(self, number: int, field: str) -> int:
        """Place of an output's entry."""
        return (
            self.locate_input(self.inputs, INPUT_FIELDS[0])
            + number * len(OUTPUT_FIELDS)
            + OUTPUT_FIELDS.index(field)
        )

    @property
    def n_ints(self) -> int:
        """Length of the head in ints."""
        return self.locate_output(self.outputs, OUTPUT_FIELDS[0])

    @property
    def n_floats(self) -> int:
        """Length of the head in floats."""
        return len(FLOAT_FIELDS) + self.states

    def locate_initial(self, number: int) -> int:
        """Place (in floats) of a state's initial value."""
        return len(FLOAT_FIELDS) + number
