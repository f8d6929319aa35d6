"""The catalogue, files, and YAML: every built-in model loads, and nothing dangerous does."""

import json
from pathlib import Path

import numpy as np
import pytest

from sysid.core.errors import InvalidModel, InvalidSettings, UnknownModel
from sysid.models import catalogue as folder
from sysid.models.catalogue.load import catalogue, copy_catalogue_document, load_model
from sysid.models.document_reader import MAX_DOCUMENT_CHARACTERS, parse_yaml
from sysid.models.model_delays import check_delays
from sysid.models.parameters import override_parameters
from sysid.models.parse import parse_model
from tests.support.library.expression_values import simulate

BUILT_IN = (
    "actuator",
    "coulomb-delay",
    "coulomb-eq16",
    "delayed-logistic",
    "delayed-van-der-pol",
    "duffing-delay",
    "duffing-eq16",
    "emps",
    "exponential",
    "foipdt",
    "fopdt",
    "ipdt",
    "mackey-glass",
    "narx",
    "silverbox",
    "silverbox-9",
    "sopdt",
    "topdt",
    "tube",
    "tube-second-order",
)

FOLDER = Path(folder.__path__[0])


def test_the_catalogue_holds_the_systems_of_the_paper_and_of_the_field() -> None:
    assert catalogue() == BUILT_IN


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_built_in_model_says_its_name_source_and_units_and_round_trips(name: str) -> None:
    model = load_model(name)
    assert model.name == name
    assert {"title", "source"} <= set(copy_catalogue_document(name))
    assert all("unit" in entry for entry in copy_catalogue_document(name)["parameters"].values())
    assert parse_model(model.document) == model == parse_model(copy_catalogue_document(name))


def test_a_document_of_the_catalogue_can_be_changed_without_changing_the_catalogue() -> None:
    copy_catalogue_document("tube")["parameters"]["K"]["upper"] = 9
    assert copy_catalogue_document("tube")["parameters"]["K"]["upper"] == 1.5


def test_an_unknown_name_suggests_the_nearest_one() -> None:
    with pytest.raises(UnknownModel, match="no model 'tueb'; did you mean 'tube'"):
        load_model("tueb")


@pytest.mark.parametrize("name", ["../catalogue/tube", "tube.yaml", "/etc/passwd", ""])
def test_a_name_never_opens_a_file(name: str) -> None:
    with pytest.raises(UnknownModel):
        load_model(name)


def test_a_yaml_file_and_a_json_file_load_alike(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text((FOLDER / "tube.yaml").read_text("utf-8"), "utf-8")
    (tmp_path / "m.json").write_text(json.dumps(copy_catalogue_document("tube")), "utf-8")
    assert load_model(tmp_path / "m.yaml") == load_model(tmp_path / "m.json") == load_model("tube")


def test_files_that_cannot_be_read_are_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "binary.yaml").write_bytes(b"name: \xff\xfe")
    (tmp_path / "empty.yaml").write_text("# nothing yet")
    (tmp_path / "large.yaml").write_text("#" * (4 * MAX_DOCUMENT_CHARACTERS + 1))
    parts = {
        "absent": "No such file",
        "binary": "not UTF-8",
        "empty": "is empty; need the document of a model",
        "large": "larger",
    }
    for name, part in parts.items():
        with pytest.raises(InvalidModel, match=part) as caught:
            load_model(tmp_path / f"{name}.yaml")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("a: [1", "line 1, column 6"),
        ("a: 1\n b: 2", "line 2, column 3"),
        ("a: &x [1]\nb: *x", "line 2, column 4: aliases are not allowed"),
        ("a: 1\nb: 2\na: 3", "line 3, column 1: 'a' is given twice"),
        ("a: !!python/object/apply:os.system [ls]", "the tag"),
        ("a: !!int x", "the tag"),
        ("[" * 1000, "nested deeper than 20"),
        ("[" + "0," * 20_000 + "]", "more than 20000 names"),
        ("? {a: 1}\n: 2", "unhashable key"),
        ("a: 1\n---\nb: 2", "expected a single document"),
        ("a: \x00", "special characters"),
        ("#" * (MAX_DOCUMENT_CHARACTERS + 1), "at most 262144"),
    ],
)
def test_yaml_that_cannot_be_read_or_is_dangerous_is_refused_in_one_line(
    text: str, part: str
) -> None:
    with pytest.raises(InvalidModel) as caught:
        parse_yaml(text)
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


def test_yaml_numbers_and_truth_values_are_those_of_version_1_2() -> None:
    text = "{a: 1e-3, b: 1., c: .5, d: 010, on: no, e: true, f: ~, g: 2020-01-01, h: 1:30, i: -2}"
    assert parse_yaml(text) == {
        "a": 1e-3,
        "b": 1.0,
        "c": 0.5,
        "d": 10,
        "on": "no",
        "e": True,
        "f": None,
        "g": "2020-01-01",
        "h": "1:30",
        "i": -2,
    }


def test_the_recursion_of_the_catalogue_is_the_papers_equation_16() -> None:
    c, L, b, a, h, n = 0.2, 0.5, 5.0, 1.0, 0.02, 200
    q = 10.0 * np.cos(5.0 * h * np.arange(n))
    x = np.zeros(n)
    d = round(L / h)
    for k in range(n - 2):
        late, later = (x[i] if i > 0 else 0.0 for i in (k + 1 - d, k - d))
        x[k + 2] = (
            2 * x[k + 1]
            - c * h * (late - later)
            - (1 + h * h * b) * x[k]
            - h * h * a * x[k] ** 3
            + h * h * q[k]
        )
    values = {"c": c, "L": L, "b": b, "a": a}
    found = simulate(load_model("duffing-eq16"), values, {"q": q}, h, n)["x"]
    np.testing.assert_allclose(found, x, rtol=0, atol=1e-10)


def test_friction_holds_a_mass_that_the_force_cannot_break_away() -> None:
    model, h, n = load_model("coulomb-delay"), 0.02, 100
    values = {"c": 0.2, "L": 0.1, "b": 5.0, "mu": 0.5}
    weak = simulate(model, values, {"q": np.full(n, 0.4)}, h, n)["x"]
    strong = simulate(model, values, {"q": np.full(n, 0.6)}, h, n)["x"]
    assert np.all(weak == 0.0)
    assert strong[-1] > 0.0


def test_the_truncated_series_approaches_the_exponential() -> None:
    L, h, n = 0.8, 0.001, 1000
    y = simulate(load_model("exponential"), {"L": L}, {}, h, n)["y"]
    exact = (np.exp(L * h * np.arange(n)) - 1) / L
    np.testing.assert_allclose(y, exact, atol=1e-3)


def test_bounds_of_a_request_that_let_a_lag_be_negative_are_refused() -> None:
    tube = load_model("tube")
    check_delays(tube, tube.parameters)
    with pytest.raises(InvalidSettings, match=r"delay of u\(t - L\) can be as small as -0.5 s"):
        check_delays(tube, override_parameters(tube.parameters, {"L": {"lower": -0.5}}))
    with pytest.raises(InvalidSettings, match=r"-0\.2 s"):
        check_delays(
            tube, override_parameters(tube.parameters, {"L": {"fixed": -0.2, "lower": -1}})
        )


def test_lags_in_samples_are_checked_from_the_whole_delay() -> None:
    narx = load_model("narx")
    with pytest.raises(InvalidSettings, match=r"as small as 0\.5 samples"):
        check_delays(narx, override_parameters(narx.parameters, {"dk": {"lower": -0.5}}), 0.1)
