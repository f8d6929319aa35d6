"""Recognition of a process with dead time in the equations of a model, however it is written."""

import numpy as np

from sysid.control.linear_form import AffineForm, IdentifiedModel, NotLinear, to_linear_form
from sysid.core.types import FloatArray
from sysid.models.catalogue.process_family import Process

_NEGLIGIBLE = 1e-9  # of the largest: rounding


def recognise_process(identified: IdentifiedModel) -> Process | None:
    """Recognise a process with dead time in a model with values; None if it is something else.

    The model must be linear and differential, with one input, one dead time and one output. Its
    transfer function needs real poles, at most one of them at 0, and no zeros.

    Examples
    --------
    >>> values = {"K": 2.0, "T": 1.5, "L": 0.4, "y0": 20.0}
    >>> recognise_process(IdentifiedModel.from_numbers(load_model("fopdt"), values)).time_constants
    (1.5,)
    """
    model = identified.model
    if model.form != "differential" or (len(model.inputs), len(model.outputs)) != (1, 1):
        return None
    try:
        linear = to_linear_form(identified, None)
    except NotLinear:
        return None
    rows = [_read_row(model.inputs[0].name, identified, form) for form in linear.equations]
    output = _read_row(model.inputs[0].name, identified, linear.outputs[0])
    if output is None or output[1] or any(row is None for row in rows):
        return None
    read = [row for row in rows if row is not None]
    delays = {delay for _, driven, _ in read for delay in driven}
    if len(delays) != 1:
        return None
    [delay] = delays
    matrix = np.array([states for states, _, _ in read])
    drive = np.array([driven.get(delay, 0.0) for _, driven, _ in read])
    return _to_process(
        matrix,
        drive,
        output[0],
        delay,
        np.array([constant for _, _, constant in read]),
        output[2],
    )


def _read_row(
    driving: str, identified: IdentifiedModel, form: AffineForm
) -> tuple[FloatArray, dict[float, float], float] | None:
    """Read the coefficients of the states and, by delay, of the input; None with delayed states."""
    names = [state.name for state in identified.model.states]
    states, driven = np.zeros(len(names)), dict[float, float]()
    for signal, coefficient in form.terms.items():
        if signal.kind == "input" and signal.name == driving:
            driven[signal.delay] = coefficient
        elif signal.kind == "state" and signal.delay == 0.0:
            states[names.index(signal.name)] = coefficient
        else:
            return None
    return states, driven, form.constant


def _to_process(
    matrix: FloatArray,
    drive: FloatArray,
    output: FloatArray,
    delay: float,
    constants: FloatArray,
    offset: float,
) -> Process | None:
    """Convert x' = A x + b u(t - L) + e, y = c x + d to a process."""
    if not all(np.isfinite(part).all() for part in (matrix, drive, output, constants)):
        return None
    poles = np.linalg.eigvals(matrix)
    speed = float(np.max(np.abs(poles)))
    if np.any(np.abs(poles.imag) > _NEGLIGIBLE**0.5 * speed) or np.any(
        poles.real > _NEGLIGIBLE * speed
    ):
        return None
    is_zero = np.abs(poles) <= _NEGLIGIBLE * speed
    integrators = int(np.count_nonzero(is_zero))
    # c A^k b is 0 for k < n - 1 if the transfer function has no zeros.
    moments = [drive]
    for _ in range(len(poles) - 1):
        moments.append(matrix @ moments[-1])
    products = [float(output @ moment) for moment in moments]
    sizes = [float(np.abs(output) @ np.abs(moment)) for moment in moments]
    has_zeros = any(
        abs(product) > _NEGLIGIBLE * size
        for product, size in zip(products[:-1], sizes[:-1], strict=True)
    )
    if has_zeros or products[-1] == 0.0 or integrators > 1 or (integrators and constants.any()):
        return None
    lags = -poles.real[~is_zero]
    if not integrators:
        offset -= float(output @ np.linalg.solve(matrix, constants))
    return Process(
        products[-1] / float(np.prod(lags)),
        tuple(sorted((1.0 / lags).tolist(), reverse=True)),
        delay,
        0.0 if integrators else offset,
        integrators,
    )
