"""Control law as expressions: signal, and equations of the integral and the derivative filter.

In the differential form the controller is continuous. In the difference form it acts once a step.
The integral uses forward, the derivative backward differences (Åström and Hägglund, Advanced PID
Control, ISA 2006, section 13.3):

    I(k) = I(k-1) + K h/T_i e(k-1) + min(1, h/T_t) (u(k-1) - v(k-1))
    D(k) = T_d/(T_d + N h) D(k-1) + K T_d N/(T_d + N h) (d(k) - d(k-1)),  d = c r - y.

Here D = K N (d - z), and z is d filtered by a time constant T_d/N.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from sysid.control.controllers import PidControl
from sysid.language.transform import shift_expression
from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, Symbol, Unary

_PERIOD_SYMBOL = Symbol("h", "period")


@dataclass(frozen=True, slots=True)
class ControllerState:
    """State of a controller; `has_input_unit`: its unit is that of the plant's input."""

    name: str
    has_input_unit: bool
    equation: Expression


class DerivativeFilter(NamedTuple):
    """Filter of the derivative: its state, its input signal, and its time constant in s."""

    state: str
    followed_signal: Expression
    time_constant: float


@dataclass(frozen=True, slots=True)
class ControlLaw:
    """Control law whose reference and output are signals of a model.

    Attributes
    ----------
    command : Expression
        Present signal of the controller.
    states : tuple of ControllerState
    filter : DerivativeFilter or None
    """

    command: Expression
    states: tuple[ControllerState, ...]
    filter: DerivativeFilter | None


ParameterFactory = Callable[..., Symbol]
"""Makes a parameter from name, value and optional unit."""


def build_control_law(
    control: PidControl,
    reference: str,
    output: Expression,
    *,
    is_sampled: bool,
    fixed: ParameterFactory,
    state: Callable[[str], str],
) -> ControlLaw:
    """Build the law of a controller.

    Parameters
    ----------
    reference : str
        Input for the reference.
    output : Expression
        The controlled output.
    is_sampled : bool
        Whether the model is a recursion.
    fixed : callable
        Makes a parameter of the loop from name, value and unit.
    state : callable
        Makes an unused name of a state.
    """
    return _ControlLawBuilder(control, reference, output, is_sampled, fixed, state).build()


class _ControlLawBuilder:
    def __init__(
        self,
        control: PidControl,
        reference: str,
        output: Expression,
        is_sampled: bool,
        fixed: ParameterFactory,
        state: Callable[[str], str],
    ) -> None:
        self.control, self.output, self.is_sampled = control, output, is_sampled
        self.add_parameter, self.choose_state_name = fixed, state
        self.reference = PastValue(reference, "input", 0, None)
        self.error = Binary("-", self.reference, output)
        self.gain = fixed("gain", control.gain)
        low, high = control.output_limits
        self.limit = None if control.limit is None else fixed("limit", control.limit)
        self.lower = self.upper = None
        if self.limit is None:
            self.lower = None if low is None else fixed("lower_limit", low)
            self.upper = None if high is None else fixed("upper_limit", high)

    def build(self) -> ControlLaw:
        wanted, states, filter_ = self._build_proportional(), [], None
        integral = None
        if self.control.has_integral_action:
            integral = PastValue(self.choose_state_name("integral"), "state", 0, None)
            wanted = Binary("+", wanted, integral)
        if self.control.has_derivative_action:
            action, filter_state, filter_ = self._build_derivative()
            wanted = Binary("+", wanted, action)
            states.append(filter_state)
        if integral is not None:
            states.insert(0, self._build_integral(integral, wanted))
        return ControlLaw(self._limit_signal(wanted), tuple(states), filter_)

    def _build_proportional(self) -> Expression:
        if self.control.setpoint_weight == 1.0:
            return Binary("*", self.gain, self.error)
        weight = self.add_parameter("setpoint_weight", self.control.setpoint_weight)
        weighted = Binary("*", weight, self.reference)
        return Binary("*", self.gain, Binary("-", weighted, self.output))

    def _build_derivative(self) -> tuple[Expression, ControllerState, DerivativeFilter]:
        """Build K N (d - z), the equation of z, and its filter."""
        control = self.control
        divisor = self.add_parameter("derivative_filter", control.derivative_filter)
        time = self.add_parameter("derivative_time", control.derivative_time, "s")
        is_of_error = control.derivative_on == "error"
        followed = self.error if is_of_error else Unary("-", self.output)
        z = PastValue(self.choose_state_name("filtered"), "state", 0, None)
        action = Binary("*", Binary("*", self.gain, divisor), Binary("-", followed, z))
        time_constant = Binary("/", time, divisor)
        equation: Expression
        if self.is_sampled:
            before = PastValue(z.name, "state", 1, None)
            part = Binary("/", _PERIOD_SYMBOL, Binary("+", time_constant, _PERIOD_SYMBOL))
            equation = Binary("+", before, Binary("*", part, Binary("-", followed, before)))
        else:
            equation = Binary("/", Binary("-", followed, z), time_constant)
        filter_ = DerivativeFilter(z.name, followed, control.filter_time)
        return action, ControllerState(z.name, False, equation), filter_

    def _build_integral(self, integral: PastValue, wanted: Expression) -> ControllerState:
        control = self.control
        assert control.integral_time is not None
        time = self.add_parameter("integral_time", control.integral_time, "s")
        rate: Expression = Binary("*", Binary("/", self.gain, time), self.error)
        if self.is_sampled:
            rate = Binary("*", _PERIOD_SYMBOL, rate)
        if control.active_tracking_time is not None:
            tracking = self.add_parameter("tracking_time", control.active_tracking_time, "s")
            excess = Binary("-", self._limit_signal(wanted), wanted)
            back: Expression = Binary("/", excess, tracking)
            if self.is_sampled:
                part = FunctionCall("min", (Number(1.0), Binary("/", _PERIOD_SYMBOL, tracking)))
                back = Binary("*", part, excess)
            rate = Binary("+", rate, back)
        if self.is_sampled:
            rate = Binary("+", integral, rate)
            return ControllerState(
                integral.name, True, shift_expression(rate, 1, None, counts=True)
            )
        return ControllerState(integral.name, True, rate)

    def _limit_signal(self, wanted: Expression) -> Expression:
        if self.limit is not None:
            least = FunctionCall("min", (self.limit, wanted))
            return FunctionCall("max", (Unary("-", self.limit), least))
        if self.upper is not None:
            wanted = FunctionCall("min", (self.upper, wanted))
        if self.lower is not None:
            wanted = FunctionCall("max", (self.lower, wanted))
        return wanted
