"""The page on which an identified model is simulated, and the free run over a recording."""

import html
import json
import re
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.api.app import create_app
from service.control.loop_answer import suggest_controller
from service.core.process.concurrency import (
    MAX_OF_PROJECT,
    MAX_WAITING,
    simulation_places,
)
from service.jobs.stored_run import StoredRun
from service.pages.simulation_page import _default_values, _FormContext
from service.storage.tables import DEFAULT_PROJECT, Dataset, Job, Run
from sysid.models.catalogue.load import load_model
from sysid.search import refine
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from tests.support.service.filled_folder import copy_filled
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import parts_of, read_faults, settings_of, store_csv

INPUT = {"kind": "binary", "period": 2}
TRUE = {"K": 2.0, "T": 1.0, "L": 0.5}
NOISELESS = {"model": "fopdt", "inputs": {"u": INPUT}, "samples": 200, "sample_time": 0.1}


@dataclass(frozen=True)
class SimulationSite:
    """A client, a run that found the true parameters, and recordings to run it over."""

    client: TestClient
    run: str
    other: str
    faster: str
    lonely: str
    page: str


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulationSite]:
    with TestClient(create_app(settings_of(tmp_path_factory.mktemp("simulated")))) as client:

        def simulate_dataset(name: str, parameters: dict[str, float], **changes: Any) -> str:
            body = {**NOISELESS, "name": name, "parameters": parameters, **changes}
            answer = client.post("/v1/datasets:simulate", json=body)
            assert answer.status_code == 201, answer.text
            return str(answer.json()["id"])

        fitted = simulate_dataset("fitted", {**TRUE, "y0": 0})
        seeds = {"inputs": {"u": {**INPUT, "seed": 5}}}
        other = simulate_dataset("other", {**TRUE, "y0": 0, "x(0)": 1}, **seeds)
        faster = simulate_dataset("faster", {**TRUE, "T": 0.3, "y0": 0}, **seeds)
        answer = client.post(
            "/v1/datasets?name=lonely",
            content=b"t,u\n0,1\n1,2\n2,3\n",
            headers={"content-type": "text/csv"},
        )
        body = {
            "model": "fopdt",
            "datasets": [fitted],
            "name": "found",
            "parameters": {"L": {"upper": 2}},
            "algorithm": {"stop": {"evaluations": 6000}},
        }
        _, [run] = identify_job(parts_of(client), body)
        yield SimulationSite(
            client, run, other, faster, answer.json()["id"], f"/runs/{run}/simulate"
        )


def validate_run(site: SimulationSite, **body: Any) -> Any:
    return site.client.post(f"/v1/runs/{site.run}:validate", json=body)


def test_over_a_recording_of_the_same_system_the_model_is_right_wherever_it_starts(
    site: SimulationSite,
) -> None:
    found = validate_run(site, dataset=site.other).json()
    assert found["rms"] < 1e-6
    assert found["fit_percent"] > 99.999
    assert found["starts"]["x(0)"] == pytest.approx(1, abs=1e-5)  # it was 0 where it was fitted
    [experiment] = found["experiments"]
    assert experiment["measured"][0]["values"][:3] == pytest.approx(
        experiment["simulated"][0]["values"][:3], abs=1e-5
    )


def test_the_start_of_each_record_is_searched_on_it_alone(
    site: SimulationSite, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = ["series,t,u,y"]
    rows += [f"{n},{0.1 * k:.1f},{(k // 9) % 2},{n * 0.9**k}" for n in range(5) for k in range(60)]
    stored = store_csv(site.client, "\n".join(rows).encode(), "five", ["series"])
    searched = []

    def note_and_refine(problem: Problem, *arguments: Any) -> Any:
        searched.append([one.name for one in problem.free_parameters])
        return refine_candidates(problem, *arguments)

    monkeypatch.setattr(refine, "refine_candidates", note_and_refine)
    found = validate_run(site, dataset=stored).json()
    assert searched == 5 * [["x(0)"]]
    assert list(found["starts"]) == ["x(0)", *(f"x(0)[{n}]" for n in range(2, 6))]
    starts = list(found["starts"].values())
    assert starts == sorted(starts)
    assert starts[4] - starts[0] > 1


def test_over_a_recording_of_another_system_it_is_not(site: SimulationSite) -> None:
    found = validate_run(site, dataset=site.faster).json()
    assert 20 < found["fit_percent"] < 95
    [one] = found["agreement"]
    assert (one["output"], one["samples"], one["rms"]) == ("y", 200, found["rms"])


def test_samples_that_are_skipped_are_not_judged(site: SimulationSite) -> None:
    found = validate_run(site, dataset=site.faster, skip=150).json()
    assert found["agreement"][0]["samples"] == 50


@pytest.mark.parametrize(
    ("body", "pointer", "words"),
    [
        ({"channels": {"u": "nothing"}}, "/channels/u", "has no channel 'nothing'"),
        ({"channels": {"w": "u"}}, "/channels/w", "has no signal 'w'"),
        ({"skip": 200}, "/dataset", "200"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_place(
    site: SimulationSite, body: dict[str, Any], pointer: str, words: str
) -> None:
    faults = read_faults(validate_run(site, dataset=site.other, **body), 422, "invalid")
    assert [one["pointer"] for one in faults] == [pointer]
    assert words in faults[0]["detail"]


def test_a_recording_without_the_output_is_refused(site: SimulationSite) -> None:
    faults = read_faults(validate_run(site, dataset=site.lonely), 422, "invalid")
    assert faults[0]["pointer"] == "/channels/y"


def test_the_form_is_shown_with_the_values_of_the_run(site: SimulationSite) -> None:
    answer = site.client.get(site.page)
    assert answer.status_code == 200
    assert 'name="duration" value="39.8"' in answer.text
    signal = site.client.get(f"{site.page}?kind=signal").text
    assert 'name="duration" value="19.9"' in signal
    assert 'name="sample_time" value="0.1"' in answer.text
    assert "figure-simulation" not in answer.text
    assert f'href="/runs/{site.run}/simulate"' in site.client.get(f"/runs/{site.run}").text


def test_of_an_irregular_recording_the_form_suggests_its_own_duration_and_density() -> None:
    oven = Dataset(n_samples=586, duration=3600.0, sample_time=None, channels=[])
    job = Job(spec={"model": "fopdt", "channels": {}, "hold": {}})
    stored = StoredRun.from_rows(job, Run(cell={}))
    found = _default_values(stored, oven)
    assert (found["duration"], found["sample_time"]) == ("3600", "6.2")
    single = Dataset(n_samples=1, duration=0.0, sample_time=None, channels=[])
    assert _default_values(stored, single)["sample_time"] == "0.01"


def test_the_form_suggests_a_step_within_what_was_measured(site: SimulationSite) -> None:
    result = site.client.get(f"/v1/runs/{site.run}").json()
    low, high = result["agreement"]["estimation"][0]["span"]
    form = site.client.get(site.page).text
    before, height = (
        float(re.search(rf'name="{name}" value="([^"]*)"', form)[1])  # type: ignore[index]
        for name in ("offset", "amplitude")
    )
    assert low < before < before + height < high
    asked = site.client.get(f"{site.page}?gain=0.5&duration=5&sample_time=0.1").text
    assert 'name="offset" value="0"' in asked  # what was simulated, not what is suggested
    assert 'name="amplitude" value="1"' in asked
    assert 'name="time" value="0"' in asked


def test_the_form_suggests_the_controller_of_a_rule_if_the_model_allows_one(
    site: SimulationSite,
) -> None:
    form = site.client.get(site.page).text
    assert '<option value="simc PI" selected>' in form
    gain, integral_time = (
        float(re.search(rf'name="{name}" value="([^"]*)"', form)[1])  # type: ignore[index]
        for name in ("gain", "integral_time")
    )
    assert (gain, integral_time) == pytest.approx((0.5, 1.0), rel=1e-3)
    assert suggest_controller(load_model("tube"), {**TRUE, "L": 0.0}, "u", "y") is None
    assert suggest_controller(load_model("narx"), {}, "u", "y") is None


def test_the_figure_begins_near_the_step_and_the_table_at_the_start(site: SimulationSite) -> None:
    query = "gain=0.5&time=20&duration=40&sample_time=0.1"
    text = site.client.get(f"{site.page}?{query}").text
    figure = re.search(r'id="figure-simulation">(.*?)</script>', text, re.DOTALL)
    assert figure is not None
    starts = [trace["x"][0] for trace in json.loads(figure.group(1))["data"]]
    assert starts == pytest.approx(len(starts) * [18])
    table = site.client.get(f"{site.page}?{query}&format=csv").text
    assert next(line for line in table.splitlines() if line.startswith("y,")).startswith("y,0.0,")


def test_the_suggested_step_comes_once_the_loop_rests(site: SimulationSite) -> None:
    form = site.client.get(site.page).text
    names = "offset|amplitude|time|duration|sample_time"
    query = dict(re.findall(rf'name="({names})" value="([^"]*)"', form), tuning="simc PI")
    shown = site.client.get(site.page, params=query).text
    assert "Overshoot" in shown
    assert "the step metrics include its settling" not in shown
    early = site.client.get(site.page, params={**query, "time": "0"}).text
    assert "the step metrics include its settling" in early


@pytest.mark.parametrize(
    ("above", "below", "unit"),
    [
        ("Pa", "Pa", ""),
        ("V", "m/s", "V/(m/s)"),
        ("1", "K", "1/K"),
        ("V", "1", "V"),
        ("1", "1", "1"),
    ],
)
def test_the_gain_has_the_unit_that_makes_an_input_of_an_output(
    above: str, below: str, unit: str
) -> None:
    known = SimpleNamespace(model=load_model("fopdt"), units={"u": above, "y": below})
    assert _FormContext.gain_unit.fget(known) == unit  # type: ignore[attr-defined]


def test_a_loop_of_small_gain_settles_and_the_page_says_by_how_much(site: SimulationSite) -> None:
    query = "?kind=loop&gain=0.5&amplitude=1&duration=30&sample_time=0.05"
    answer = site.client.get(site.page + query)
    assert answer.status_code == 200
    assert "✓" not in answer.text  # the sign comes with the sheet
    assert '<span class="verdict passed">settles</span>' in answer.text
    # K·g/(1 + K·g) = 1/2 of the reference is reached
    assert re.search(r"Final value</dt><dd>0\.5000", answer.text)
    assert "figure-simulation" in answer.text


def test_a_loop_of_large_gain_runs_away_and_the_page_says_so(site: SimulationSite) -> None:
    query = "?kind=loop&gain=5&amplitude=1&duration=40&sample_time=0.05"
    answer = site.client.get(site.page + query)
    assert '<span class="verdict failed">diverges</span>' in answer.text


def test_a_loop_that_is_cut_short_does_not_settle(site: SimulationSite) -> None:
    query = "?kind=loop&gain=1&amplitude=1&duration=2&sample_time=0.05"
    answer = site.client.get(site.page + query)
    assert '<span class="verdict apart">does not settle</span>' in answer.text


def test_the_page_of_a_free_run_tells_the_agreement_of_the_rest_interface(
    site: SimulationSite,
) -> None:
    answer = site.client.get(f"{site.page}?kind=recording&dataset={site.faster}")
    fit = validate_run(site, dataset=site.faster).json()["fit_percent"]
    assert f"{fit:.2f} %" in answer.text
    assert f'<option value="{site.faster}" selected>faster</option>' in answer.text


def test_a_signal_is_given_as_an_expression_and_its_numbers_come_as_csv(
    site: SimulationSite,
) -> None:
    query = "?kind=signal&input.u=1%2B0*t&duration=20&sample_time=0.1"
    assert "figure-simulation" in site.client.get(site.page + query).text
    table = site.client.get(f"{site.page}{query}&format=csv")
    assert table.headers["content-type"].startswith("text/csv")
    last = [line for line in table.text.splitlines() if line.startswith("y,")][-1].split(",")
    assert float(last[1]) == 20
    assert float(last[2]) == pytest.approx(2, rel=1e-3)  # K times the input


LOOP = "kind=loop&duration=20&sample_time=0.05&amplitude=1&offset=0"


def curl_of(text: str) -> dict[str, Any]:
    """The body that the page repeats for curl."""
    found = re.search(r"LAGID&#39;\n(.*?)\nLAGID", text, re.DOTALL)
    assert found is not None
    return dict(json.loads(html.unescape(found.group(1))))


def test_a_pi_controller_with_limits_is_simulated_as_by_rest(site: SimulationSite) -> None:
    query = "gain=0.6&integral_time=1.1&lower=0&upper=0.65&setpoint_weight=0.8&derivative_on=error"
    text = site.client.get(f"{site.page}?{LOOP}&{query}").text
    body = curl_of(text)
    assert body["control"] | {"reference": None} == {
        "input": "u",
        "output": "y",
        "gain": 0.6,
        "integral_time": 1.1,
        "lower": 0.0,
        "upper": 0.65,
        "setpoint_weight": 0.8,
        "derivative_on": "error",
        "reference": None,
    }
    told = site.client.post(f"/v1/runs/{site.run}:simulate", json=body).json()
    margins, used = told["margins"], told["controller"]
    shown = {
        "Gain margin": f"{margins['gain_margin']:.2f}",
        "Phase margin": f"{margins['phase_margin']:.1f}°",
        "Time at a limit": f"{used['saturated_percent']:.3g} %",
    }
    for label, value in shown.items():
        assert f"<dt>{label}</dt><dd>{value}" in text, label
    assert re.search(r'"y0":0\.65,"y1":0\.65', text)  # the limit in the figure


def test_a_decimal_comma_is_read(site: SimulationSite) -> None:
    query = "gain=0,6&integral_time=1,25e0&lower=-,5&upper=1000,5"
    control = curl_of(site.client.get(f"{site.page}?{LOOP}&{query}").text)["control"]
    names = "gain", "integral_time", "lower", "upper"
    assert [control[name] for name in names] == [0.6, 1.25, -0.5, 1000.5]


def test_a_rule_fills_in_the_numbers_that_it_chose(site: SimulationSite) -> None:
    text = site.client.get(f"{site.page}?{LOOP}&gain=7&tuning=simc+PI").text
    body = curl_of(text)
    assert body["control"]["tuning"] == {"rule": "simc", "controller": "PI"}
    assert "gain" not in body["control"]
    assert re.search(r'name="gain" value="0\.(5|49999|50000)', text)
    assert re.search(r'name="integral_time" value="(1|0\.9999|1\.000)', text)
    assert "Skogestad" in text
    assert "Controller by SIMC" in text
    slower = site.client.get(f"{site.page}?{LOOP}&tuning=simc+PID&closed_loop_time_constant=2").text
    assert curl_of(slower)["control"]["tuning"]["closed_loop_time_constant"] == 2.0
    assert "no second time constant" in slower


def test_a_limit_cycle_is_no_settling_time(site: SimulationSite) -> None:
    text = site.client.get(f"{site.page}?{LOOP}&gain=5&integral_time=2&limit=1.5").text
    assert "keeps oscillating" in text
    assert "oscillates and does not settle" in text
    assert "<dd>unstable</dd>" in text
    assert "a longer integral time, or another sign" in text
    assert "Gain margin" not in text


@pytest.mark.parametrize(
    ("query", "line"),
    [
        ("gain=1&integral_time=-1&duration=5&sample_time=0.1", "integral time: "),
        ("gain=1&derivative_filter=0&duration=5&sample_time=0.1", "derivative filter N: "),
        ("gain=1&lower=1&upper=0&duration=5&sample_time=0.1", "upper limit: found 0, and 1 as"),
        ("gain=1&derivative_on=x&duration=5&sample_time=0.1", "derivative on: "),
        ("tuning=magic&duration=5&sample_time=0.1", "tuning: found &#39;magic&#39;; need one of"),
        (
            "tuning=amigo+PI&closed_loop_time_constant=1&duration=5&sample_time=0.1",
            "closed-loop time constant: rule &#39;amigo&#39; has no such setting",
        ),
        ("gain=abc&duration=5&sample_time=0.1", "gain: found &#39;abc&#39;; need a number"),
        (
            "gain=1,000&duration=5&sample_time=0.1",
            "gain: found &#39;1,000&#39;; need a number with a decimal point",
        ),
        ("gain=nan&duration=5&sample_time=0.1", "gain: found &#39;nan&#39;; need a number"),
        ("gain=1&duration=5", "sampling period: it is missing"),
        ("gain=1&duration=1e9&sample_time=0.1", "duration: 1e+09 s with a period of 0.1 s are"),
        ("gain=1&duration=-1&sample_time=0.1", "duration: found -1; need a time above 0 s"),
        ("input=w&duration=5&sample_time=0.1", "controlled input: the model has no input"),
        ("limit=-2&duration=5&sample_time=0.1", "limit of the command:"),
        ("time=7&duration=5&sample_time=0.1", "time of the step: 7 s is outside the simulation"),
        ("transport_delay=9&duration=5&sample_time=0.1", "transport time lag: found 9 s"),
        ("gain=1e9&duration=60&sample_time=0.1", "gain: found 1e+09, with which the loop diverges"),
        ("kind=years", "kind: found &#39;years&#39;; need one of"),
        ("gian=1&duration=5&sample_time=0.1", "gian: there is no such field"),
        ("kind=recording&dataset=ds_x", "there is no dataset ds_x"),
        ("kind=recording&skip=1", "recording: it is missing"),
        ("kind=signal&duration=5&sample_time=0.1", "input u: it is missing"),
        ("kind=signal&input.u=sin(&duration=5&sample_time=0.1", "input u: "),
        ("kind=signal&input.u=w&duration=5&sample_time=0.1", "input u: "),
    ],
)
def test_a_wrong_input_is_answered_on_the_page_by_one_line(
    site: SimulationSite, query: str, line: str
) -> None:
    answer = site.client.get(f"{site.page}?{query}")
    assert answer.status_code == 422
    assert answer.headers["content-type"].startswith("text/html")
    [told] = re.findall(r'role="alert"><b>The simulation failed:</b>(.*?)</div>', answer.text)
    assert line in told
    assert "<li>" not in told
    assert "figure-simulation" not in answer.text


def test_several_wrong_inputs_are_told_together_each_at_its_field(site: SimulationSite) -> None:
    text = site.client.get(f"{site.page}?gain=a&limit=b&duration=5&sample_time=0.1").text
    assert text.count('aria-invalid="true"') == 2
    assert text.count("<li>") == 2


def test_what_is_typed_is_escaped(site: SimulationSite) -> None:
    text = site.client.get(f"{site.page}?gain=%22%3E%3Cscript%3E&duration=5&sample_time=1").text
    assert "<script>" not in text


def test_a_run_that_is_not_there_is_not_found(site: SimulationSite) -> None:
    assert site.client.get("/runs/run_x/simulate").status_code == 404


def test_a_run_without_estimates_says_so(tmp_path: Path) -> None:
    filled = copy_filled(tmp_path)
    with TestClient(create_app(settings_of(tmp_path))) as client:
        answer = client.get(f"/runs/{filled.running_run}/simulate")
    assert answer.status_code == 200
    assert "has no estimates" in answer.text
    assert "<form" not in answer.text


def test_while_too_many_simulate_the_others_are_asked_to_come_again_and_nothing_else_waits(
    site: SimulationSite,
) -> None:
    step = {"inputs": {"u": {"kind": "step"}}, "samples": 50, "sample_time": 0.1}
    query = {"kind": "loop", "gain": "1", "duration": "5", "sample_time": "0.1"}
    made = {**NOISELESS, "parameters": TRUE}
    with ExitStack() as others:
        for _ in range(MAX_OF_PROJECT):
            others.enter_context(simulation_places.hold(DEFAULT_PROJECT))
        for _ in range(MAX_WAITING):
            waits = simulation_places._ask(DEFAULT_PROJECT)  # no more may wait
            others.callback(simulation_places._give_back, DEFAULT_PROJECT, waits)
        for answer in (
            site.client.post(f"/v1/runs/{site.run}:simulate", json=step),
            site.client.post("/v1/datasets:simulate", json=made),
            validate_run(site, dataset=site.other),
        ):
            read_faults(answer, 503, "unavailable")
            assert answer.headers["retry-after"] == "2"
        page = site.client.get(site.page, params=query)
        assert (page.status_code, "ask again" in page.text) == (503, True)
        assert site.client.get(site.page).status_code == 200
    assert site.client.get(site.page, params=query).status_code == 200
