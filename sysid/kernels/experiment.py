"""What a kernel knows of the experiment it simulates: the numbers of its head, once loaded."""

from sysid.kernels.lanes import Lanes, Value
from sysid.kernels.layout import HEAD, INPUT, NUMBERS, OUTPUT, STATE, Layout


class Experiment:
    """The head of an experiment's numbers, loaded where it is made: at the kernel's entry."""

    def __init__(self, lanes: Lanes, layout: Layout, ints: Value, floats: Value) -> None:
        self.ints, self.floats = ints, floats
        self._head = {name: lanes.load_int(ints, lanes.integer(i)) for i, name in enumerate(HEAD)}
        self._numbers = {
            name: lanes.load(floats, lanes.integer(i)) for i, name in enumerate(NUMBERS)
        }
        self._states = [
            {f: lanes.load_int(ints, lanes.integer(layout.state(i, f))) for f in STATE}
            for i in range(layout.states)
        ]
        self._inputs = [
            {f: lanes.load_int(ints, lanes.integer(layout.input(i, f))) for f in INPUT}
            for i in range(layout.inputs)
        ]
        self._outputs = [
            {f: lanes.load_int(ints, lanes.integer(layout.output(i, f))) for f in OUTPUT}
            for i in range(layout.outputs)
        ]
        self.initial = [
            lanes.load(floats, lanes.integer(layout.initial(i))) for i in range(layout.states)
        ]

    def head(self, field: str) -> Value:
        """A number of the experiment as a whole."""
        return self._head[field]

    def number(self, field: str) -> Value:
        """A real number of the experiment as a whole."""
        return self._numbers[field]

    def state(self, i: int, field: str) -> Value:
        """A number of the i-th state."""
        return self._states[i][field]

    def input(self, i: int, field: str) -> Value:
        """A number of the i-th input."""
        return self._inputs[i][field]

    def output(self, i: int, field: str) -> Value:
        """A number of the i-th output."""
        return self._outputs[i][field]
