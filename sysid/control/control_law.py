"""A controller as expressions: its signal, and the equations of its integral and its filter.

In the differential form the controller is continuous. In the difference form it acts once a step:
the integral by forward, the derivative by backward differences (Åström and Hägglund, Advanced PID
Control, ISA 2006, section 13.3),

    I(k) = I(k-1) + K h/T_i e(k-1) + min(1, h/T_t) (u(k-1) - v(k-1))
    D(k) = T_d/(T_d + N h) D(k-1) + K T_d N/(T_d + N h) (d(k) - d(k-1)),  d = c r - y,

where D = K N (d - z) and z is d behind a lag of T_d/N.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from sysid.control.controllers import PidControl
from sysid.language.transform import shifted
from sysid.language.tree import Binary, Call, Expression, Number, Past, Symbol, Unary

_PERIOD = Symbol("h", "period")


@dataclass(frozen=True, slots=True)
class LawState:
    """A state of the controller: its name, whether its unit is the input's, and its equation."""

    name: str
    is_of_input: bool
    equation: Expression


class Filter(NamedTuple):
    """The derivative's filter: its state, what it follows, and its time constant in s."""

    state: str
    followed: Expression
    time: float


@dataclass(frozen=True, slots=True)
class Law:
    """A controller whose reference and output are signals of a model.

    Attributes
    ----------
    command : Expression
        What it gives now.
    states : tuple of LawState
    filter : Filter or None
    """

    command: Expression
    states: tuple[LawState, ...]
    filter: Filter | None


Fixed = Callable[..., Symbol]
"""Gives the parameter of a name, a value and, if it has one, a unit."""


def law_of(
    control: PidControl, reference: str, output: Expression, *,
    is_sampled: bool, fixed: Fixed, state: Callable[[str], str],
) -> Law:  # fmt: skip
    """The law of a controller.

    Parameters
    ----------
    reference : str
        Input that stands for the reference.
    output : Expression
        The controlled output.
    is_sampled : bool
        Whether the model is a recursion.
    fixed : callable
        Makes a parameter of the loop from name, value and unit.
    state : callable
        Makes the name of a state that nothing else has.
    """
    return _Writer(control, reference, output, is_sampled, fixed, state).law()


class _Writer:
    def __init__(
        self, control: PidControl, reference: str, output: Expression, is_sampled: bool,
        fixed: Fixed, state: Callable[[str], str],
    ) -> None:  # fmt: skip
        self.control, self.output, self.is_sampled = control, output, is_sampled
        self.fixed, self.state = fixed, state
        self.reference = Past(reference, "input", 0, None)
        self.error = Binary("-", self.reference, output)
        self.gain = fixed("gain", control.gain)
        low, high = control.range
        self.limit = None if control.limit is None else fixed("limit", control.limit)
        self.lower = self.upper = None
        if self.limit is None:
            self.lower = None if low is None else fixed("lower_limit", low)
            self.upper = None if high is None else fixed("upper_limit", high)

    def law(self) -> Law:
        wanted, states, filter_ = self._proportional(), [], None
        integral = None
        if self.control.integrates:
            integral = Past(self.state("integral"), "state", 0, None)
            wanted = Binary("+", wanted, integral)
        if self.control.differentiates:
            action, lag, filter_ = self._derivative()
            wanted = Binary("+", wanted, action)
            states.append(lag)
        if integral is not None:
            states.insert(0, self._integral(integral, wanted))
        return Law(self._limited(wanted), tuple(states), filter_)

    def _proportional(self) -> Expression:
        if self.control.setpoint_weight == 1.0:
            return Binary("*", self.gain, self.error)
        weight = self.fixed("setpoint_weight", self.control.setpoint_weight)
        weighted = Binary("*", weight, self.reference)
        return Binary("*", self.gain, Binary("-", weighted, self.output))

    def _derivative(self) -> tuple[Expression, LawState, Filter]:
        """K N (d - z), the equation of z, and its filter."""
        control = self.control
        divisor = self.fixed("derivative_filter", control.derivative_filter)
        time = self.fixed("derivative_time", control.derivative_time, "s")
        is_of_error = control.derivative_on == "error"
        followed = self.error if is_of_error else Unary("-", self.output)
        z = Past(self.state("filtered"), "state", 0, None)
        action = Binary("*", Binary("*", self.gain, divisor), Binary("-", followed, z))
        lag = Binary("/", time, divisor)
        equation: Expression
        if self.is_sampled:
            before = Past(z.name, "state", 1, None)
            part = Binary("/", _PERIOD, Binary("+", lag, _PERIOD))
            equation = Binary("+", before, Binary("*", part, Binary("-", followed, before)))
        else:
            equation = Binary("/", Binary("-", followed, z), lag)
        filter_ = Filter(z.name, followed, control.filter_time)
        return action, LawState(z.name, False, equation), filter_

    def _integral(self, integral: Past, wanted: Expression) -> LawState:
        control = self.control
        assert control.integral_time is not None
        time = self.fixed("integral_time", control.integral_time, "s")
        rate: Expression = Binary("*", Binary("/", self.gain, time), self.error)
        if self.is_sampled:
            rate = Binary("*", _PERIOD, rate)
        if control.tracking is not None:
            tracking = self.fixed("tracking_time", control.tracking, "s")
            excess = Binary("-", self._limited(wanted), wanted)
            back: Expression = Binary("/", excess, tracking)
            if self.is_sampled:
                part = Call("min", (Number(1.0), Binary("/", _PERIOD, tracking)))
                back = Binary("*", part, excess)
            rate = Binary("+", rate, back)
        if self.is_sampled:
            rate = Binary("+", integral, rate)
            return LawState(integral.name, True, shifted(rate, 1, None, counts=True))
        return LawState(integral.name, True, rate)

    def _limited(self, wanted: Expression) -> Expression:
        if self.limit is not None:
            least = Call("min", (self.limit, wanted))
            return Call("max", (Unary("-", self.limit), least))
        if self.upper is not None:
            wanted = Call("min", (self.upper, wanted))
        if self.lower is not None:
            wanted = Call("max", (self.lower, wanted))
        return wanted
