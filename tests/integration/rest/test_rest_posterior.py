"""A posterior over REST: asked for with the job, in the result, as a figure, left out of lists."""

from collections.abc import Iterator

import pytest

from tests.support.service.local_runs import ServedRun, identify_job, serve_run
from tests.support.service.web_app import parts_of, read_faults

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def served_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedRun]:
    changes = {"parameters": {"y0": {"fixed": 0.0}}, "posterior": True}
    with serve_run(tmp_path_factory.mktemp("posterior"), **changes) as run:
        yield run


def test_a_run_has_the_posterior_of_its_free_parameters(served_run: ServedRun) -> None:
    result = served_run.server.get(f"/v1/runs/{served_run.run}").json()
    posterior = result["posterior"]
    assert posterior["converged"], posterior["reason"]
    names = [one["name"] for one in result["parameters"] if one["status"] != "fixed"]
    assert [one["name"] for one in posterior["parameters"]] == names
    assert posterior["correlation"]["names"] == names
    assert len(posterior["samples"]) == 1000
    assert {len(row) for row in posterior["samples"]} == {len(names)}
    stored = {one["name"]: one for one in result["parameters"]}
    for one in posterior["parameters"]:
        low, high = one["interval95"]
        assert low < one["median"] < high
        assert one["unit"] == stored[one["name"]]["unit"]
        assert one["effective_samples"] > 1000
    assert result["evaluations"] > posterior["evaluations"] > 10_000


def test_a_list_of_runs_leaves_out_the_samples(served_run: ServedRun) -> None:
    (run,) = served_run.server.get(f"/v1/jobs/{served_run.job}/runs").json()["items"]
    assert run["posterior"]["converged"]
    assert "samples" not in run["posterior"]


def test_the_corner_plot_comes_as_plotly_json_and_as_csv(served_run: ServedRun) -> None:
    path = f"/v1/runs/{served_run.run}/figures/posterior"
    kinds = [trace["type"] for trace in served_run.server.get(path).json()["data"]]
    posterior = served_run.server.get(f"/v1/runs/{served_run.run}").json()["posterior"]
    n = len(posterior["parameters"])
    n_pairs = n * (n - 1) // 2
    assert n >= 3  # K, T and L
    assert kinds.count("contour") == n_pairs
    assert kinds.count("bar") == n
    lines = served_run.server.get(path, params={"format": "csv"}).text.splitlines()
    assert lines[0] == "series,x,y"
    assert sum(line.startswith("samples,") for line in lines) == 500 * n_pairs


def test_the_page_of_its_job_has_a_table_and_a_place_for_the_plot(served_run: ServedRun) -> None:
    page = served_run.server.get(f"/jobs/{served_run.job}").text
    assert '<table class="posterior ' in page
    assert 'data-figure="posterior"' in page


def test_a_job_without_the_field_has_none_and_is_another_job(served_run: ServedRun) -> None:
    _, (run,) = identify_job(parts_of(served_run.server), {**served_run.body, "posterior": False})
    result = served_run.server.get(f"/v1/runs/{run}").json()
    assert result["posterior"] is None
    assert result["reused_from"] is None
    assert served_run.server.get(f"/v1/runs/{run}/figures/posterior").json()["data"] == []
    assert 'data-figure="posterior"' not in served_run.server.get(f"/runs/{run}").text
    first = served_run.server.get(f"/v1/runs/{served_run.run}").json()
    assert result["parameters"] == first["parameters"]  # nothing else depends on it
    assert first["evaluations"] - result["evaluations"] == first["posterior"]["evaluations"]


def test_a_wrong_value_is_refused_with_its_place(served_run: ServedRun) -> None:
    answer = served_run.server.post("/v1/jobs", json={**served_run.body, "posterior": "rough"})
    (fault,) = read_faults(answer, 422, "invalid")
    assert fault["pointer"] == "/posterior"
