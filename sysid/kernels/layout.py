"""Layout of an experiment's numbers in the arrays `ints` and `floats`.

Both arrays begin with a head of fixed indices, which locates the data that follow. All indices
count from the beginning of the experiment.
"""

from dataclasses import dataclass

from sysid.models.model import Model

HEAD_FIELDS = ("last", "reach", "rows", "deviations")
"""Fields of an experiment.

Last integration step; rows of history that delays reach back; rows of the buffer; rows from a
prediction to its deviation (for corrections only).
"""

STATE_FIELDS = ("row", "given")
"""Row of theta with the initial value, or -1; index of the measured first samples, or -1."""

INPUT_FIELDS = ("zero", "points", "begin", "end", "cap")
"""Fields of an input.

Index of the value at step 0; fine points in a step; begin and end of a step in fine points (a held
input jumps, so they differ from 0 and `points`); largest delay in fine points.
"""

OUTPUT_FIELDS = ("measured", "weight", "samples", "fraction", "first", "grid", "precision")
"""Fields of an output.

Indices of measured values and weights; index (in ints) of each grid point's row, or of the bounds
of its interval's samples; index of the samples' positions in their interval; first row of the
predictions; index of the measurement interpolated to the grid; index of the sensor's weight
at each grid point with a measured value, else 0 (for corrections only).
"""

FLOAT_FIELDS = ("step", "cap", "scale")
"""Integration step in s (difference form: h); largest delay in steps; scale of soft-l1.

The states' initial values follow, then the inputs' values at the start.
"""


@dataclass(frozen=True, slots=True)
class KernelVariant:
    """Options that are compiled into a kernel, besides the model.

    Attributes
    ----------
    one_step : bool
        Measured outputs replace the states they measure.
    soft : bool
        The loss is soft-l1 instead of squares.
    on_grid : bool
        Every measured sample lies on a grid point of its own.
    weighted : bool
        At least one weight is not 1.
    """

    one_step: bool = False
    soft: bool = False
    on_grid: bool = True
    weighted: bool = False


@dataclass(frozen=True, slots=True)
class ExperimentLayout:
    """Indices of the head, for a model with these numbers of signals."""

    states: int
    inputs: int
    outputs: int

    @classmethod
    def from_model(cls, model: Model) -> "ExperimentLayout":
        """Build the layout of a model's experiments."""
        return cls(len(model.states), len(model.inputs), len(model.outputs))

    def locate_state(self, number: int, field: str) -> int:
        """Return the index (in ints) of a state's field."""
        return len(HEAD_FIELDS) + number * len(STATE_FIELDS) + STATE_FIELDS.index(field)

    def locate_input(self, number: int, field: str) -> int:
        """Return the index (in ints) of an input's field."""
        return (
            self.locate_state(self.states, STATE_FIELDS[0])
            + number * len(INPUT_FIELDS)
            + INPUT_FIELDS.index(field)
        )

    def locate_output(self, number: int, field: str) -> int:
        """Return the index (in ints) of an output's field."""
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
        return self.locate_first_input(self.inputs)

    def locate_initial(self, number: int) -> int:
        """Return the index (in floats) of a state's initial value."""
        return len(FLOAT_FIELDS) + number

    def locate_first_input(self, number: int) -> int:
        """Return the index (in floats) of an input's value at the start."""
        return self.locate_initial(self.states) + number
