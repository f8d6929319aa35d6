"""The figure of a trend: what is drawn, and how laws are written."""

from service.figures.trend_figure import plot_trend, trend_height
from service.trends.trend_schemas import CoefficientOut, LawOut, PointOut, QuantityOut, TrendOut


def find_quantity(name: str, kind: str, laws: list[LawOut]) -> QuantityOut:
    points = [
        PointOut(x=x, value=x, stderr=None, runs=["run"], status="measured", is_used=False)
        for x in (1.0, 2.0)
    ]
    return QuantityOut(
        name=name, unit="s", kind=kind, points=points, between_runs=None, laws=laws, reason="none"
    )


def power_law(a: float) -> LawOut:
    coefficients = [CoefficientOut(name=n, value=v, stderr=0.1) for n, v in (("a", a), ("b", 2.0))]
    return LawOut(
        law="power",
        formula="a·x^b",
        is_chosen=True,
        coefficients=coefficients,
        chi_squared=1.0,
        degrees=1,
        birge=1.0,
        aic=0.0,
        aicc=None,
    )


def read_trend(*quantities: QuantityOut) -> TrendOut:
    return TrendOut(
        job="job", x="length_m", outliers="exclude", labels=[], quantities=list(quantities)
    )


def list_captions(shown: TrendOut) -> list[str]:
    return [one["text"] for one in plot_trend(shown)["layout"]["annotations"]]


def test_an_onset_delay_without_a_law_is_not_drawn_and_has_no_room() -> None:
    parameter = find_quantity("L", "parameter", [])
    both = read_trend(parameter, find_quantity("onset delay", "onset delay", []))
    assert list_captions(both) == ["<b>L</b>: no law"]
    many = read_trend(parameter, *[find_quantity("onset delay", "onset delay", [])] * 4)
    assert trend_height(many) == trend_height(read_trend(parameter))


def test_a_law_is_written_with_its_label_and_powers_of_ten() -> None:
    shown = read_trend(find_quantity("onset delay", "onset delay", [power_law(8.403e-5)]))
    assert list_captions(shown) == ["<b>onset delay</b> = 8.403·10⁻⁵·length_m<sup>2.000</sup>"]
