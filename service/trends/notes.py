"""Notes on the laws and predictions of one quantity."""

from collections.abc import Iterator, Mapping, Sequence

from service.repositories.trend_rows import TrendRow
from service.trends.points import TrendQuantity
from sysid.core.units import format_unit
from sysid.trends.trend import Trend, TrendPoint

BIRGE_LIMIT = 1.5  # Birge ratios below that happen by chance in small batches


def describe_quantity(quantity: TrendQuantity, fitted: Trend) -> list[str]:
    """List all notes: on the points, the laws, and the predictions."""
    return [
        *_describe_points(quantity, fitted),
        *_describe_laws(quantity, fitted),
        *_describe_predictions(quantity, fitted),
    ]


def describe_noise_models(
    x: str, rows_by_label: Mapping[float, Sequence[TrendRow]], reference: str
) -> str:
    """Report that estimates use different noise models; empty if all use one.

    Parameters
    ----------
    x : str
        The label's name.
    reference : str
        Noise model of the reference run; empty if there is none.
    """
    models_by_x = {
        x_value: {row.noise_model for row in rows} for x_value, rows in rows_by_label.items()
    }
    if len({reference, *(model for models in models_by_x.values() for model in models)} - {""}) < 2:
        return ""
    whitened = [f"{x_value:g}" for x_value, models in models_by_x.items() if "ar1" in models]
    where = f"{x} = {', '.join(whitened)}" if whitened else "the reference run"
    if whitened and reference == "ar1":
        where += " and the reference run"
    return (
        f"estimates of {where} use the noise model ar1, others use least squares. Their RMS and "
        "fits do not compare. If the model lacks dynamics, the estimates differ too. "
        "With loss: {noise_model: white} all points use least squares"
    )


def _describe_points(quantity: TrendQuantity, fitted: Trend) -> Iterator[str]:
    if fitted.excluded:
        with_error = _list_used_x(quantity)
        outliers = ", ".join(f"{with_error[i]:g}" for i in fitted.excluded)
        yield f"the laws leave out the outlier at {outliers}"
    without = [f"{point.x:g}" for point in quantity.points if point.estimate is None]
    if without:
        why = "; an onset delay has one from two steps on" if quantity.kind == "onset delay" else ""
        yield f"no standard error at {', '.join(without)}, so the laws leave it out{why}"
    if quantity.between_runs is not None and quantity.between_runs > 1:
        yield (
            f"runs of one label differ by {quantity.between_runs:.2g} times their standard errors. "
            "The errors shown include this scatter"
        )


def _describe_laws(quantity: TrendQuantity, fitted: Trend) -> Iterator[str]:
    chosen = fitted.best_law
    if chosen is None:
        return
    if chosen.birge_ratio > BIRGE_LIMIT:
        yield (
            f"the points scatter about the law by {chosen.birge_ratio:.2g} times their errors "
            "(Birge ratio). Band and intervals are widened by this factor"
        )
    if all(law.kind != "power" for law in fitted.laws):
        wrong = [f"{x:g}" for x in _list_used_x(quantity) if not x > 0]
        yield "no power law: " + (
            f"it needs x > 0, found {', '.join(wrong)}"
            if wrong
            else "these points do not determine it"
        )
    _, (_, value, error) = chosen.coefficients
    if error > abs(value):
        name = "slope" if chosen.kind == "line" else "exponent"
        yield (
            f"the {name} of the chosen law, {value:.2g}, is smaller than its error, {error:.2g}. "
            "The points show no dependence on x"
        )


def _describe_predictions(quantity: TrendQuantity, fitted: Trend) -> Iterator[str]:
    outside = [f"{prediction.x:g}" for prediction in fitted.predictions if prediction.is_outside]
    if outside:
        yield f"{', '.join(outside)} is outside the measured range, so this is an extrapolation"
    used = _list_used_x(quantity)
    beyond = [f"{prediction.x:g}" for prediction in fitted.predictions if not prediction.x > 0]
    if beyond and used and min(used) > 0:
        yield f"{', '.join(beyond)} is not above 0, unlike all measured points"
    for prediction in fitted.predictions:
        yield from _compare_with_bounds(quantity, prediction)


def _list_used_x(quantity: TrendQuantity) -> list[float]:
    return [point.x for point in quantity.points if point.estimate is not None]


def _compare_with_bounds(quantity: TrendQuantity, prediction: TrendPoint) -> Iterator[str]:
    """Report predictions or intervals outside the bounds of the parameter."""
    lower, upper = quantity.bounds
    unit = format_unit(quantity.unit)
    limits = f"{lower:g} to {upper:g}{unit}" if upper < float("inf") else f"{lower:g}{unit} or more"
    if not lower <= prediction.value <= upper and prediction.value == prediction.value:
        yield (
            f"{prediction.value:.4g}{unit}, predicted at {prediction.x:g}, is outside the bounds "
            f"of {quantity.name} ({limits}). The law does not hold there"
        )
    elif prediction.lower < lower or prediction.upper > upper:
        yield (
            f"the interval at {prediction.x:g} reaches beyond the bounds of {quantity.name} "
            f"({limits})"
        )
