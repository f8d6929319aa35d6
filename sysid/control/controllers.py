"""Parameters of PID controllers, and of the transport between controller and plant.

The standard (ISA) form with two weights of the reference r (Åström and Hägglund, Advanced PID
Control, ISA 2006, sections 3.3 to 3.5). The controlled output is y:

    v = K [ (b r - y) + 1/T_i ∫(r - y) dt + T_d s/(1 + s T_d/N) (c r - y) ]
    u = min(upper, max(lower, v))
"""

from dataclasses import KW_ONLY, dataclass
from math import sqrt
from typing import Literal

from sysid.core.errors import InvalidSettings

MAX_NUMBER = 1e300
"""Larger numbers are not allowed in a model; a larger time counts as infinite."""

DerivativeOn = Literal["measurement", "error"]
AntiWindup = Literal["back-calculation", "none"]


@dataclass(frozen=True, slots=True)
class Transport:
    """Transport between controller and plant: gain · e^(-delay s) / (time_constant s + 1).

    Attributes
    ----------
    gain : float
    time_constant, delay : float
        In s, 0 or more. Without a time constant it is a pure dead time.
    """

    gain: float = 1.0
    time_constant: float = 0.0
    delay: float = 0.0

    def __post_init__(self) -> None:
        if not _is_number(self.gain):
            raise InvalidSettings("/transport/gain", _describe_not_finite(self.gain))
        for name in ("time_constant", "delay"):
            value = getattr(self, name)
            if not _is_number(value) or value < 0:
                raise InvalidSettings(f"/transport/{name}", f"{value!r} is not a number 0 or more")


@dataclass(frozen=True, slots=True)
class PidControl:
    """Control of one output by one input: P, PI, PD or PID.

    Attributes
    ----------
    input, output : str
        Signals of the model.
    gain : float
        K, unit of the input per unit of the output.
    limit : float or None
        Largest absolute value of the controller's signal, in the unit of the input.
    transport : Transport or None
        Transport between controller and plant.
    integral_time : float or None
        T_i in s; None or infinite: no integral action.
    derivative_time : float
        T_d in s; 0: no derivative action.
    derivative_filter : float
        N: the derivative is filtered by a time constant T_d/N, so its gain is N K at most.
    derivative_on : {"measurement", "error"}
        c = 0 or c = 1: whether steps of the reference are differentiated.
    setpoint_weight : float
        b, the weight of the reference in the proportional action.
    lower, upper : float or None
        Limits of the controller's signal, instead of `limit`.
    anti_windup : {"back-calculation", "none"}
        At a limit the integral is corrected by (u - v)/T_t, or not at all.
    tracking_time : float or None
        T_t in s; None: √(T_i T_d), without derivative action T_i.
    """

    input: str
    output: str
    gain: float
    limit: float | None = None
    transport: Transport | None = None
    _: KW_ONLY
    integral_time: float | None = None
    derivative_time: float = 0.0
    derivative_filter: float = 10.0
    derivative_on: DerivativeOn = "measurement"
    setpoint_weight: float = 1.0
    lower: float | None = None
    upper: float | None = None
    anti_windup: AntiWindup = "back-calculation"
    tracking_time: float | None = None

    def __post_init__(self) -> None:
        for name in ("gain", "setpoint_weight"):
            if not _is_number(getattr(self, name)):
                raise InvalidSettings(f"/{name}", _describe_not_finite(getattr(self, name)))
        for name in ("limit", "tracking_time", "derivative_filter"):
            value = getattr(self, name)
            if value is not None and not (_is_number(value) and value > 0):
                raise InvalidSettings(f"/{name}", f"{value!r} is not a number above 0")
        if self.integral_time is not None and not self.integral_time > 0:
            raise InvalidSettings(
                "/integral_time", f"{self.integral_time!r} is not a time above 0 s, or infinity"
            )
        if not (_is_number(self.derivative_time) and self.derivative_time >= 0):
            raise InvalidSettings(
                "/derivative_time", f"{self.derivative_time!r} is not a time of 0 s or more"
            )
        self._check_limits()

    def _check_limits(self) -> None:
        for name in ("lower", "upper"):
            value = getattr(self, name)
            if value is not None and not _is_number(value):
                raise InvalidSettings(f"/{name}", _describe_not_finite(value))
            if value is not None and self.limit is not None:
                raise InvalidSettings(
                    f"/{name}", "the limit ± is given too; use either that, or lower and upper"
                )
        if self.lower is not None and self.upper is not None and self.lower >= self.upper:
            raise InvalidSettings(
                "/upper", f"found {self.upper:g}, and {self.lower:g} as lower limit; need more"
            )

    @property
    def has_integral_action(self) -> bool:
        """Whether there is integral action."""
        return self.integral_time is not None and self.integral_time < MAX_NUMBER

    @property
    def has_derivative_action(self) -> bool:
        """Whether there is derivative action."""
        return self.derivative_time > 0

    @property
    def filter_time(self) -> float:
        """Time constant T_d/N of the derivative's filter in s."""
        return self.derivative_time / self.derivative_filter

    @property
    def output_limits(self) -> tuple[float | None, float | None]:
        """Lower and upper limit of the controller's signal; None if there is no limit."""
        if self.limit is not None:
            return -self.limit, self.limit
        return self.lower, self.upper

    @property
    def active_tracking_time(self) -> float | None:
        """T_t in s; None without windup or without anti-windup."""
        is_limited = any(limit is not None for limit in self.output_limits)
        if not (self.has_integral_action and is_limited and self.anti_windup == "back-calculation"):
            return None
        if self.tracking_time is not None:
            return self.tracking_time
        assert self.integral_time is not None
        if not self.has_derivative_action:
            return self.integral_time
        return sqrt(self.integral_time) * sqrt(self.derivative_time)


def _describe_not_finite(value: float) -> str:
    return f"{value!r} is not a finite number between ±{MAX_NUMBER:g}"


def _is_number(value: float) -> bool:
    return -MAX_NUMBER < value < MAX_NUMBER
