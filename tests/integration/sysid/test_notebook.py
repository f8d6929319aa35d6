"""What a notebook does: tables to a result, which shows, draws, saves and simulates itself."""

import json
import pickle
import re
import sys
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import pytest

from sysid import (
    Channel,
    GeneticAlgorithm,
    Identification,
    Loss,
    Record,
    Recording,
    SysidError,
    export_model,
    identify,
    load_identified,
    load_model,
    simulate,
)
from sysid.core.errors import (
    InvalidRecord,
    InvalidSettings,
    MissingLibrary,
    UnknownParameter,
    UnreadableResult,
    UnwritableFile,
)
from sysid.models.model import Model, replace_substeps
from sysid.residuals.residual_tests import judge_tests
from sysid.results.figures import FIGURES, draw_figures, list_experiments
from sysid.results.parts import InputHold
from sysid.results.result import FitPercent
from sysid.results.saved_result import FORMAT
from sysid.results.summary import summarise_result
from sysid.uncertainty.estimates import CorrelationMatrix, Posterior
from tests.support.library.polynomials import TRUTH as POLYNOMIAL
from tests.support.library.polynomials import document, frols, record_of

N = 240
T = np.arange(N) * 0.5
STEPS = np.where((T // 20) % 2 == 0, 0.0, 20.0)
TRUTH = {"K": 0.8, "T": 6.0, "L": 3.2, "y0": 20.0, "x(0)": 0.0}
QUICK = GeneticAlgorithm(population=32, generations=60)
FEW = {"y0": 20.0, "K": (0.1, 2.0), "T": (1.0, 20.0), "L": (0.0, 10.0), "x(0)": 0.0}


NO_CORRELATION = CorrelationMatrix((), np.zeros((0, 0)))
NO_SAMPLES = Posterior((), np.zeros((0, 3)), NO_CORRELATION, 0, 0, 0.0, 0, False, "no budget")


def make_frame() -> pd.DataFrame:
    clean = simulate("fopdt", Channel("u", T, STEPS), TRUTH).channel("y").values
    noise = np.random.default_rng(5).normal(0.0, 0.15, N)
    index = pd.date_range("2026-11-20 08:00", periods=N, freq="500ms", tz="Europe/Berlin")
    table = {"Heizung [%]": STEPS.astype(np.float32), "Temperatur [°C]": clean + noise}
    return pd.DataFrame(table, index=index)


@pytest.fixture(scope="module")
def frame() -> pd.DataFrame:
    return make_frame()


@pytest.fixture(scope="module")
def frame_result(frame: pd.DataFrame) -> Identification:
    return identify("fopdt", frame, QUICK, parameters=FEW, validation_fraction=0.25)


@pytest.fixture(scope="module")
def posterior_result(frame: pd.DataFrame) -> Identification:
    """A result of two records, with other validation data and a posterior."""
    parts = [frame.iloc[:150], frame.iloc[100:]]
    return identify("fopdt", parts, QUICK, parameters=FEW, validation=frame, posterior=True)


@pytest.fixture(scope="module")
def filtered_result(frame: pd.DataFrame) -> Identification:
    """A result of two records with noise inside the plant."""
    parts = [frame.iloc[:150], frame.iloc[100:]]
    return identify("fopdt", parts, QUICK, parameters=FEW, loss=Loss(noise_model="load"))


def same(one: Any, other: Any) -> bool:
    """Whether two results have the same numbers, bit for bit."""
    if isinstance(one, Model):
        return one.document == other.document
    if isinstance(one, np.ndarray):
        return one.shape == other.shape and one.tobytes() == other.tobytes()
    if is_dataclass(one):
        names = [field.name for field in fields(one) if field.init]
        return all(same(getattr(one, name), getattr(other, name)) for name in names)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float):
        return isinstance(other, float) and (one == other or (one != one and other != other))
    return type(one) is type(other) and one == other


def test_a_table_of_dates_gives_the_truth_and_says_how_it_was_read(
    frame_result: Identification,
) -> None:
    for name in ("K", "T", "L"):
        assert frame_result[name].value == pytest.approx(TRUTH[name], rel=0.05)
    assert any("'u': 'Heizung', 'y': 'Temperatur'" in text for text in frame_result.warnings)


def test_every_form_of_the_same_data_gives_the_same_result(frame: pd.DataFrame) -> None:
    u, y = (frame[name].to_numpy(np.float64) for name in frame)
    quick = GeneticAlgorithm(population=8, islands=1, generations=3, refine=False)
    channels = Channel("Heizung", T, u, "%"), Channel("Temperatur", T, y, "°C")
    forms = [
        frame,
        Recording(channels),
        Record(*channels),
        {"t": list(T), "u [%]": list(u), "y [°C]": y[:, None]},
        [frame],
    ]
    model = load_model("fopdt")
    document = dict(model.document)
    results = [identify("fopdt", form, quick, parameters=FEW) for form in forms]
    results += [identify(source, frame, quick, parameters=FEW) for source in (model, document)]
    results.append(identify("fopdt", frame, quick, parameters=FEW, channels={"u": "Heizung [%]"}))
    assert {result.parameter_values["L"] for result in results} == {
        results[0].parameter_values["L"]
    }


def test_bounds_and_fixed_values_have_a_short_form(frame_result: Identification) -> None:
    assert (frame_result["L"].lower, frame_result["L"].upper) == (0.0, 10.0)
    assert (frame_result["y0"].value, frame_result["y0"].status) == (20.0, "fixed")


def test_a_result_is_a_few_lines(frame_result: Identification) -> None:
    text = repr(frame_result)
    head, verdict, *rows = text.splitlines()
    assert verdict == f"verdict: {frame_result.verdict.text}"
    assert head.startswith(
        f"Identification of 'fopdt', fit {frame_result.fit_percent.estimation:.2f} %, RMS 0.1"
    )
    assert "°C, validation fit" in head
    assert rows[0].split() == [
        "parameter",
        "estimate",
        "95",
        "%",
        "interval",
        "standard",
        "error",
        "unit",
        "status",
    ]
    assert rows[1].split()[:3] == ["K", *summarise_estimate(frame_result, "K")]
    assert all(f"  {estimate.name}" in text for estimate in frame_result.parameters)
    assert "residuals on validation data: " in text
    assert len(text) < 1500
    many = replace(frame_result, warnings=tuple(f"number {n} " + "x" * 500 for n in range(9)))
    *_, first, second, third, last = repr(many).splitlines()
    # The end of a note says what to do, so none is cut.
    assert [first, second, third] == [f"note: {warning}" for warning in many.warnings[:3]]
    assert last.startswith("and ")
    assert last.endswith(" more in `warnings`")


def summarise_estimate(frame_result: Identification, name: str) -> list[str]:
    estimate = frame_result[name]
    row = next(line for line in summarise_result(frame_result).splitlines() if f" {name} " in line)
    value = float(row.split()[1])
    assert value == pytest.approx(estimate.value, abs=estimate.stderr)
    return row.split()[1:3]


def test_the_html_of_a_result_is_complete_and_escaped(frame_result: Identification) -> None:
    evil = replace(frame_result, warnings=("<script>alert(1)</script>", *frame_result.warnings))
    html = evil._repr_html_()
    assert "<script>" not in html
    assert "&lt;script&gt;" in html
    for estimate in frame_result.parameters:
        assert f"<b>{estimate.name}</b>" in html
    assert html.count("<li>") >= len(evil.warnings)  # what an estimate says besides, too
    assert "residuals on validation data" in html


def test_an_estimate_has_its_name(frame_result: Identification) -> None:
    assert frame_result["T"] is frame_result.parameters[1]
    assert list(frame_result) == [estimate.name for estimate in frame_result.parameters]
    assert "T" in frame_result
    assert "TT" not in frame_result
    assert frame_result.parameter_values["T"] == frame_result["T"].value
    with pytest.raises(UnknownParameter, match=r"there is no parameter 'TT'; did you mean 'T'\?"):
        frame_result["TT"]
    with pytest.raises(KeyError):
        frame_result["TT"]


def test_estimates_are_a_table_of_pandas(frame_result: Identification) -> None:
    table = frame_result.to_pandas()
    assert list(table.index) == [estimate.name for estimate in frame_result.parameters]
    assert table.loc["L", "value"] == frame_result["L"].value
    assert table.loc["L", "low95"] == frame_result["L"].interval95[0]
    assert np.isnan(table.loc["y0", "stderr"])
    assert table.loc["y0", "status"] == "fixed"


@pytest.mark.parametrize("which", ["frame_result", "posterior_result"])
def test_a_result_is_saved_and_read_bit_for_bit(
    which: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    result = request.getfixturevalue(which)
    path = tmp_path / "found.json"
    result.save(path)
    again = Identification.load(path)
    assert same(again, result)
    assert again == result
    assert hash(again) == hash(result)
    assert repr(again) == repr(result)
    assert json.loads(path.read_text())["format"] == FORMAT
    assert same(pickle.loads(pickle.dumps(result)), result)


def test_numbers_that_json_lacks_are_saved(frame_result: Identification, tmp_path: Path) -> None:
    odd = replace(
        frame_result,
        rms=float("inf"),
        fit_percent=FitPercent(float("nan"), None),
        simulated=((np.zeros(0),),),
    )
    odd = replace(odd, posterior=NO_SAMPLES, covariance=None, data=None)
    path = tmp_path / "odd.json"
    odd.save(path)
    assert same(Identification.load(path), odd)
    assert Identification.load(path) == odd != frame_result
    assert frame_result != "found"


DAMAGES = [
    (lambda d: d.update(format="lagid-model/1"), "read it with load_identified"),
    (lambda d: d.update(format="lagid-identification/1"), "a build before 0.1.0 saved it"),
    (lambda d: d.update(format="other/7"), "its format is 'other/7'; need 'lagid-identification"),
    (lambda d: d.pop("rms"), "/rms: found None; need this field"),
    (lambda d: d.update(rms="many"), "/rms: found 'many'; need a number"),
    (lambda d: d.update(rms=True), "/rms: found True; need a number"),
    (lambda d: d.update(evaluations=1.5), "/evaluations: found 1.5; need a whole number"),
    (lambda d: d.update(extra=1), "/: found 'extra'; need one of the fields"),
    (lambda d: d["parameters"][0].update(status="sure"), "/parameters/0/status: found 'sure'"),
    (lambda d: d["parameters"][0].update(interval95=[1]), "/parameters/0/interval95.*2 entries"),
    (lambda d: d.update(warnings="none"), "/warnings: found 'none'; need a list"),
    (lambda d: d["simulated"][0].__setitem__(0, {"shape": [3]}), "shape of an empty array"),
    (lambda d: d["simulated"][0].__setitem__(0, ["a"]), "/simulated/0/0.*need a list of numbers"),
    (lambda d: d.update(rms=10**400), "/rms: found 10+…; need a number"),
    (lambda d: d["simulated"][0].__setitem__(0, [10**400]), "/simulated/0/0.*list of numbers"),
    (lambda d: d["simulated"][0].__setitem__(0, {"shape": [0, 10**30]}), "of an empty array"),
    (lambda d: d["simulated"][0].__setitem__(0, {"shape": [0] * 80}), "of an empty array"),
    (lambda d: d.update(covariance=[[1.0, None]]), "/covariance: .*need a list of numbers"),
    (lambda d: d.update(covariance=[True, 1.0]), "/covariance: .*need a list of numbers"),
    (lambda d: d.update(covariance=[[1.0], ["1.5"]]), "/covariance: .*need a list of numbers"),
    (lambda d: d["data"].update(records=[]), "no record, or one without outputs"),
    (lambda d: d["data"]["records"][0].update(outputs=[]), "no record, or one without outputs"),
    (lambda d: d["data"]["model"].pop("equations"), "equations"),
    (lambda d: d["data"]["records"][0]["inputs"][0].update(values=[1.0]), "values of shape"),
]


@pytest.mark.parametrize(("damage", "told"), DAMAGES)
def test_a_damaged_file_is_told_by_its_field(
    frame_result: Identification, tmp_path: Path, damage, told: str
) -> None:
    path = tmp_path / "found.json"
    frame_result.save(path)
    document = json.loads(path.read_text())
    damage(document)
    path.write_text(json.dumps(document))
    with pytest.raises(UnreadableResult, match=told) as caught:
        Identification.load(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (None, "it cannot be read: No such file"),
        ("{", "it is not JSON"),
        ("[1]", "found no object"),
        ('{"parameters": [], "fit_percent": {}}', "the document of a run"),
    ],
)
def test_another_file_is_told(tmp_path: Path, content: str | None, told: str) -> None:
    path = tmp_path / "a.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(UnreadableResult, match=told):
        Identification.load(path)


def test_a_place_that_cannot_be_written_is_told(
    frame_result: Identification, tmp_path: Path
) -> None:
    with pytest.raises(UnwritableFile, match="cannot be written: No such file"):
        frame_result.save(tmp_path / "absent" / "found.json")


def test_simulation_repeats_what_was_identified(frame_result: Identification) -> None:
    record = frame_result.data.records[0]
    assert np.array_equal(
        simulate("fopdt", record, frame_result).channel("y").values, frame_result.simulated[0][0]
    )


def test_simulation_of_a_table_reads_the_input_as_the_identification_did(
    frame_result: Identification, frame: pd.DataFrame
) -> None:
    answer = simulate("fopdt", frame["Heizung [%]"], frame_result).channel("y").values
    estimated = frame_result.simulated[0][0]
    assert np.allclose(answer[: estimated.size], estimated, rtol=0, atol=1e-9)
    held = simulate("fopdt", Channel("u", T, STEPS, hold="first"), frame_result).channel("y").values
    assert not np.allclose(held, answer, rtol=1e-3)


def test_simulation_has_the_step_of_the_result(frame_result: Identification) -> None:
    record, model = frame_result.data.records[0], load_model("fopdt")
    finer = simulate(model, record, replace(frame_result, substeps=7)).channel("y").values
    asked = simulate(replace_substeps(model, 7), record, frame_result.parameter_values)
    assert np.array_equal(finer, asked.channel("y").values)
    assert not np.array_equal(finer, frame_result.simulated[0][0])


def test_simulation_reads_an_input_as_the_result_did(frame_result: Identification) -> None:
    inputs, values = Channel("u", T, STEPS), frame_result.parameter_values
    assert inputs.effective_hold == "zero"
    lines = replace(frame_result, input_hold=(InputHold("u", "first", None),))
    answer = simulate("fopdt", inputs, lines).channel("y").values
    asked = replace_substeps(load_model("fopdt"), frame_result.substeps)
    expected = simulate(asked, replace(inputs, hold="first"), values).channel("y").values
    assert np.array_equal(answer, expected)


def test_simulation_has_the_terms_of_the_result() -> None:
    model = document(frols(5))
    record = record_of(POLYNOMIAL, samples=200)
    result = identify(model, record, QUICK)
    assert len(result.selection) == 5
    answer = simulate(model, record, result).channel("y").values
    assert np.allclose(answer, result.simulated[0][0], rtol=0, atol=1e-9)


def test_simulation_of_several_records_starts_as_the_first(
    posterior_result: Identification,
) -> None:
    record = posterior_result.data.records[0]
    answer = simulate("fopdt", record, posterior_result).channel("y").values
    assert np.array_equal(answer, posterior_result.simulated[0][0])


@pytest.mark.parametrize("name", ["tube", "narx"])
def test_simulation_starts_where_the_measurement_started(name: str) -> None:
    y = np.zeros(N)
    for k in range(3, N):
        y[k] = 0.6 * y[k - 1] + 0.02 * STEPS[k - 3]
    y += 1.0 + np.random.default_rng(2).normal(0.0, 0.01, N)
    record = Record(Channel("u", T, STEPS), Channel("y", T, y))
    result = identify(name, record, QUICK)
    for inputs in (record, record.inputs):
        answer = simulate(name, inputs, result).channel("y").values
        assert np.allclose(answer, result.simulated[0][0], rtol=0, atol=1e-9)
    later = simulate(name, Channel("u", T + 500.0, STEPS), result).channel("y").values
    assert np.allclose(later, result.simulated[0][0], rtol=0, atol=1e-6)
    with pytest.raises(InvalidSettings, match=r"/parameters/y\(0\): a value is missing"):
        simulate(name, record.inputs, replace(result, data=None))


def test_an_exported_model_is_read_and_simulated(
    frame_result: Identification, tmp_path: Path
) -> None:
    path = tmp_path / "model.json"
    path.write_text(export_model(load_model("fopdt"), frame_result, "json"), encoding="utf-8")
    model = load_identified(path)
    assert model.parameter_values == frame_result.parameter_values
    assert model.holds == frame_result.holds
    assert "L = " in repr(model)
    assert len(repr(model)) < 300
    record = frame_result.data.records[0]
    answer = simulate(model.model, record, model).channel("y").values
    assert np.allclose(answer, frame_result.simulated[0][0], rtol=0, atol=1e-9)
    assert export_model(model.model, model.parameter_values, "json")


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("{}", "its format is None, not 'lagid-model/1'"),
        (f'{{"format": "{FORMAT}"}}', "read it with Identification.load"),
        ('{"format": "lagid-model/1"}', "it is damaged"),
        (
            '{"format": "lagid-model/1", "model": {}, "values": [], "covariance": null}',
            "damaged|faults",
        ),
    ],
)
def test_a_file_that_is_no_identified_model_is_told(
    tmp_path: Path, content: str, told: str
) -> None:
    path = tmp_path / "model.json"
    path.write_text(content)
    with pytest.raises(UnreadableResult, match=told):
        load_identified(path)


def test_the_usual_figure_has_response_residuals_correlation_and_waterfall(
    frame_result: Identification,
) -> None:
    figure = frame_result.plot()
    assert isinstance(figure, go.Figure)
    titles = [note.text for note in figure.layout.annotations if note.text.startswith("<b>")]
    assert titles == [
        "<b>Measured against identified</b>",
        "<b>Correlation of the residuals</b>",
        "<b>Correlation of the estimates</b>",
        "<b>What each island found</b>",
    ]
    drawn = {trace.name: trace for trace in figure.data}
    measured = np.array(drawn["measured"].y)
    assert measured.size == N  # both parts of the record
    assert np.array(drawn["u"].y).size == N
    assert np.array(drawn["identified"].y)[: frame_result.simulated[0][0].size] == pytest.approx(
        frame_result.simulated[0][0], rel=1e-6
    )


@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_can_be_drawn_alone(
    posterior_result: Identification, filtered_result: Identification, name: str
) -> None:
    found = filtered_result if name == "disturbances" else posterior_result
    figure = found.plot(name, theme="dark")
    assert figure.data
    assert figure.layout.template.layout.font.color == "#c6ced6"


def test_disturbances_of_every_record(filtered_result: Identification) -> None:
    drawn = [draw_figures(filtered_result, ["disturbances"], number)[0] for number in (0, 1)]
    assert [title for title, _ in drawn] == [
        "Estimated disturbances: record 1",
        "Estimated disturbances: record 2",
    ]
    for number, (_, figure) in enumerate(drawn):
        (load,) = filtered_result.compute_disturbances(number)
        assert figure["data"][-1]["y"] == pytest.approx(load.values, rel=1e-5)


def test_figures_of_every_record(posterior_result: Identification) -> None:
    names = [experiment.name for experiment in list_experiments(posterior_result)]
    assert names == ["estimation 1", "estimation 2", "validation 1"]
    [(title, _)] = draw_figures(posterior_result, ["response"], 2)
    assert title == "Measured against identified: validation 1"
    with pytest.raises(InvalidSettings, match=r"found 3; the records are 0 \(estimation 1\)"):
        posterior_result.plot(experiment=3)
    with pytest.raises(InvalidSettings, match=r"'respons'; did you mean 'response'\?"):
        posterior_result.plot("respons")


def test_residuals_are_drawn_for_each_tested_record(frame: pd.DataFrame) -> None:
    parts = [frame.iloc[:120], frame.iloc[120:]]
    result = identify("fopdt", parts, QUICK, parameters=FEW)
    for number in (0, 1):
        [(title, figure)] = draw_figures(result, ["residuals"], number)
        assert title.endswith(f": estimation {number + 1}")
        bars = [trace["y"] for trace in figure["data"] if trace["type"] == "bar"]
        tested = [c for c in result.data.correlations if c.test.experiment == number]
        assert bars[1] == pytest.approx(tested[1].values, rel=1e-5)


def test_a_result_without_data_draws_what_it_has(frame_result: Identification) -> None:
    bare = replace(frame_result, data=None)
    titles = [title for title, _ in draw_figures(bare, FIGURES)]
    assert "Measured against identified" not in titles
    assert "What each island found" in titles
    assert repr(bare).startswith("Identification, fit")


def test_a_picture_file_says_what_it_needs(
    frame_result: Identification, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "kaleido", None)
    with pytest.raises(Exception, match="requires the Kaleido package") as told:
        frame_result.plot("response").write_image(tmp_path / "answer.svg")
    assert 'pip install --upgrade "kaleido>=1"' in str(told.value)


@pytest.mark.parametrize(("library", "call"), [("pandas", "to_pandas"), ("plotly", "plot")])
def test_a_missing_library_is_told(
    frame_result: Identification, monkeypatch: pytest.MonkeyPatch, library: str, call: str
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    if library == "plotly":
        monkeypatch.setitem(sys.modules, "plotly.graph_objects", None)
    with pytest.raises(MissingLibrary, match=rf"{call}\(\) needs {library}, which is not inst"):
        getattr(frame_result, call)()


def test_drawn_residuals_are_those_that_were_tested(
    frame_result: Identification, posterior_result: Identification, frame: pd.DataFrame
) -> None:
    robust = identify(
        "fopdt", frame, QUICK, parameters=FEW, loss=Loss("soft-l1", scale=0.2), skip=7
    )
    one_step = identify("narx", frame, QUICK, prediction="one-step")
    for result in (frame_result, posterior_result, robust, one_step):
        verdict = judge_tests(result.data.correlations, result.residual_tests.data)
        assert verdict == result.residual_tests


ARGUMENTS = [
    ({"records": "heating.csv"}, "found the text 'heating.csv'.*read_recording"),
    ({"records": T}, "type ndarray of shape .240,..*with named columns"),
    ({"records": Channel("u", T, T)}, "Join channels in a record: Record"),
    ({"records": []}, "there is no record"),
    ({"records": Path("a.csv")}, "found the path 'a.csv'.*Read a file first, with read_recording"),
    ({"records": [pd.Series(T, T), pd.Series(T, T)]}, "one signal; model 'fopdt' has 2. Join"),
    ({"records": pd.DataFrame({"t": [], "u": [], "y": []})}, "the table has no rows"),
    ({"records": {"t": T[::-1], "u": T, "y": T}}, "decrease: sample 1 is at .*Sort the samples"),
    (
        {"hold": {"uu": "zero"}},
        "/hold/uu: model 'fopdt' has no input or output 'uu'; did you mean 'u'?",
    ),
    ({"hold": {"u": "zoh"}}, "/hold/u: found 'zoh'; need one of auto, zero, first, band-limited"),
    ({"hold": "zero"}, "/hold: found 'zero'; need a mapping of inputs to holds"),
    ({"settings": "fast"}, "/settings: found 'fast'; need GeneticAlgorithm"),
    ({"settings": pd.Series(T)}, r"/settings: found an object of type Series of shape \(240,\)"),
    ({"settings": np.zeros(2)}, r"ndarray of shape \(2,\).*join them: Record\(inputs, outputs\)"),
    ({"weights": list(range(99))}, "/weights: found an object of type list; need a mapping"),
    ({"loss": "soft-l1"}, "/loss: found 'soft-l1'; need Loss"),
    ({"noise": 0.1}, "/noise: found 0.1; need Noise"),
    ({"seed": "a"}, "/seed: found 'a'; need a whole number"),
    ({"seed": True}, "/seed: found True"),
    ({"skip": 0.5}, "/skip: found 0.5; need a number of samples"),
    ({"skip": None}, "/skip: found None; need a number of samples"),
    ({"seed": None}, "/seed: found None; need a whole number"),
    ({"posterior": "no"}, "/posterior: found 'no'; need True or False"),
    ({"progress": 1}, "/progress: found 1; need a function"),
    ({"warm": {"K": "2"}}, "/warm/K: found '2'; need a finite number"),
    ({"warm": {"LL": 2.0}}, "/warm/LL: there is no parameter 'LL'; did you mean 'L'?"),
    ({"weights": 3}, "/weights: found 3; need a mapping"),
    ({"warm": [1]}, r"/warm: found \[1\]; need a mapping"),
    ({"validation_fraction": "a"}, "/validation_fraction: found 'a'; need a number"),
    ({"channels": "u=P1"}, "/channels: found 'u=P1'; need a mapping"),
    ({"parameters": ["L"]}, r"/parameters: found \['L'\]; need a mapping"),
    ({"parameters": {"L": (0, 1, 2)}}, r"/parameters/L: found \(0, 1, 2\); need bounds"),
    ({"parameters": {"L": True}}, "/parameters/L: found True"),
    ({"parameters": {"L": (2, 0)}}, r"'L' has bounds \[2, 0\]"),
    ({"parameters": {"LL": (0, 2)}}, "no parameter 'LL'; did you mean 'L'?"),
]


@pytest.mark.parametrize(("wrong", "told"), ARGUMENTS)
def test_a_wrong_argument_is_told_in_one_line(
    frame: pd.DataFrame, wrong: dict[str, Any], told: str
) -> None:
    arguments = {"records": frame, **wrong}
    with pytest.raises(SysidError, match=told) as caught:
        identify("fopdt", **arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("inputs", "values", "more", "told"),
    [
        (T, TRUTH, {}, "the inputs: found an object of type ndarray"),
        (Channel("u", T, T), 5, {}, "/values: found an object of type int; need values by name"),
        (Channel("u", T, T), {**TRUTH, "K": "a"}, {}, "/parameters/K: 'a' is not a finite number"),
        (Channel("u", T, T), TRUTH, {"times": [1.0]}, "Need two times or more"),
        ((), TRUTH, {}, "give the times of the outputs"),
    ],
)
def test_a_wrong_argument_of_a_simulation_is_told(inputs, values, more, told: str) -> None:
    with pytest.raises((InvalidRecord, InvalidSettings), match=told):
        simulate("fopdt", inputs, values, **more)


def test_a_result_simulates_the_table_that_it_was_identified_from(
    frame_result: Identification, frame: pd.DataFrame, tmp_path: Path
) -> None:
    path = tmp_path / "found.json"
    frame_result.save(path)
    for result in (frame_result, Identification.load(path)):
        simulated = simulate("fopdt", frame, result).channel("y")
        assert simulated.values.size == N
        one = simulate("fopdt", frame[["Heizung [%]"]].rename(columns={"Heizung [%]": "u"}), result)
        np.testing.assert_array_equal(one.channel("y").values, simulated.values)


@pytest.mark.parametrize(
    ("names", "options", "told"),
    [
        (("posterior",), {}, "/names: no posterior was sampled; call identify"),
        (("respons",), {}, "/names: there is no figure 'respons'; did you mean 'response'"),
        ((["response", 3],), {}, "/names: there is no figure 3"),
        ((), {"theme": "drak"}, "/theme: found 'drak'; need one of light, dark"),
        ((), {"experiment": "1"}, "/experiment: found '1'; need a whole number"),
        ((), {"experiment": True}, "/experiment: found True; need a whole number"),
    ],
)
def test_a_wrong_argument_of_plot_is_told(
    frame_result: Identification, names: tuple[Any, ...], options: dict[str, Any], told: str
) -> None:
    with pytest.raises(InvalidSettings, match=re.escape(told)):
        frame_result.plot(*names, **options)


def test_figures_may_be_a_list(frame_result: Identification) -> None:
    assert len(frame_result.plot(["response", "waterfall"]).data) == len(
        frame_result.plot("response", "waterfall").data
    )
    with pytest.raises(InvalidSettings, match="no data for the figure 'response'"):
        replace(frame_result, data=None).plot("response")


def test_a_result_is_a_mapping_of_names_to_estimates(frame_result: Identification) -> None:
    names = [estimate.name for estimate in frame_result.parameters]
    assert len(frame_result) == len(names)
    assert list(frame_result) == list(frame_result.keys()) == names
    assert list(frame_result.values()) == list(frame_result.parameters)
    assert (
        dict(frame_result)
        == dict(frame_result.items())
        == {name: frame_result[name] for name in names}
    )
    assert frame_result.get("L") is frame_result["L"]
    assert frame_result.get("M") is None
    assert frame_result.get("M", frame_result["L"]) is frame_result["L"]
    with pytest.raises(UnknownParameter, match=r"there is no parameter 0; the names are K, T, L"):
        frame_result[0]  # type: ignore[index]
    with pytest.raises(UnknownParameter, match="there is no parameter 'l'; known are K, L"):
        frame_result["l"]


def test_a_failure_to_write_leaves_the_old_file_whole(
    frame_result: Identification, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "found.json"
    frame_result.save(path)
    before = path.read_bytes()

    def fill_disk(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", fill_disk)
    with pytest.raises(UnwritableFile, match=r"found\.json: it cannot be written: No space left"):
        frame_result.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
