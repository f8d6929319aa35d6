"""Equations to show: well-formed MathML with its text, for every kind of model."""

from xml.etree import ElementTree

import pytest

from sysid.language.mathml import format_mathml
from sysid.models.catalogue.load import catalogue, load_model
from sysid.models.equation_display import MAX_SHOWN_TERMS, format_equations
from sysid.models.parse import parse_model
from tests.support.library.small_models import differential

_MATH = "{http://www.w3.org/1998/Math/MathML}math"


@pytest.mark.parametrize("name", catalogue())
def test_every_equation_of_the_catalogue_is_mathml_with_its_text_as_label(name: str) -> None:
    equations = format_equations(load_model(name))
    assert equations
    for text, mathml in equations:
        element = ElementTree.fromstring(mathml)
        assert (element.tag, element.get("aria-label")) == (_MATH, text)


def test_a_model_shows_equations_then_intermediate_names_then_outputs_and_keeps_constants() -> None:
    model = differential(
        {"x": "rate - g*x"},
        "2*x",
        outputs={"y": "2*x", "x": "x"},
        let={"rate": "c*u(t - L)"},
        constants={"g": 9.81},
    )
    texts = [equation.text for equation in format_equations(model)]
    assert texts == ["dx/dt = rate - g*x", "rate = c*u(t - L)", "y = 2*x"]


def test_a_long_polynomial_shows_its_first_terms_and_counts_the_others() -> None:
    lags = [str(lag) for lag in range(1, 9)]
    model = parse_model(
        {
            "name": "long",
            "form": "polynomial",
            "inputs": {"u": "1"},
            "output": {"y": "1"},
            "degree": 2,
            "lags": {"y": lags, "u": lags},
            "coefficients": {"lower": -1, "upper": 1},
        }
    )
    [equation] = format_equations(model)
    assert equation.text.startswith("y(k) = a[y(k-1)]*y(k-1) + ")
    assert equation.text.endswith(f" + {len(model.terms) - MAX_SHOWN_TERMS} more terms")
    assert equation.mathml.count("<msub>") == MAX_SHOWN_TERMS


@pytest.mark.parametrize(
    ("text", "letters"),
    [
        ("F_max*omega(k-1)", "Fmax⋅ω\u2061(k−1)"),
        ("abs(mu) - 2.5e-7", "|μ|−2.5⋅10−7"),
        (
            "where(x > 0 and not x >= 1, 1, where(x == 2, log(x), 0))",
            "{1ifx>0andnotx≥1ln\u2061(x)ifx=20otherwise",
        ),
        ("table(u, [0, 1], [0, 5])", "table\u2061(u,[0,1],[0,5])"),
    ],
)
def test_names_functions_and_conditions_are_written_as_by_hand(text: str, letters: str) -> None:
    element = ElementTree.fromstring(f"<math>{format_mathml(text)}</math>")
    assert "".join(element.itertext()).replace("\u00a0", "") == letters


def test_a_text_that_is_no_expression_has_no_mathml() -> None:
    with pytest.raises(ValueError, match="column 3"):
        format_mathml("a ^ b")
