"""A posterior over REST: asked for with the job, in the result, as a figure, left out of lists."""

from collections.abc import Iterator

import pytest

from tests.identified import ServedRun, identified, serve_run
from tests.rest import parts_of, refused

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedRun]:
    changes = {"parameters": {"y0": {"fixed": 0.0}}, "posterior": True}
    with serve_run(tmp_path_factory.mktemp("posterior"), **changes) as run:
        yield run


def test_a_run_has_the_posterior_of_its_free_parameters(served: ServedRun) -> None:
    result = served.server.get(f"/v1/runs/{served.run}").json()
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


def test_a_list_of_runs_leaves_out_the_samples(served: ServedRun) -> None:
    (run,) = served.server.get(f"/v1/jobs/{served.job}/runs").json()["items"]
    assert run["posterior"]["converged"]
    assert "samples" not in run["posterior"]


def test_the_corner_plot_comes_as_plotly_json_and_as_csv(served: ServedRun) -> None:
    path = f"/v1/runs/{served.run}/figures/posterior"
    kinds = [trace["type"] for trace in served.server.get(path).json()["data"]]
    assert kinds.count("contour") == 6  # pairs of K, T, L and the initial state
    assert kinds.count("bar") == 4
    lines = served.server.get(path, params={"format": "csv"}).text.splitlines()
    assert lines[0] == "series,x,y"
    assert sum(line.startswith("samples,") for line in lines) == 6 * 500


def test_the_page_of_its_job_has_a_table_and_a_place_for_the_plot(served: ServedRun) -> None:
    page = served.server.get(f"/jobs/{served.job}").text
    assert '<table class="posterior ' in page
    assert 'data-figure="posterior"' in page


def test_a_job_without_the_field_has_none_and_is_another_job(served: ServedRun) -> None:
    _, (run,) = identified(parts_of(served.server), {**served.body, "posterior": False})
    result = served.server.get(f"/v1/runs/{run}").json()
    assert result["posterior"] is None
    assert result["reused_from"] is None
    assert served.server.get(f"/v1/runs/{run}/figures/posterior").json()["data"] == []
    assert 'data-figure="posterior"' not in served.server.get(f"/runs/{run}").text
    first = served.server.get(f"/v1/runs/{served.run}").json()
    assert result["parameters"] == first["parameters"]  # nothing else depends on it
    assert first["evaluations"] - result["evaluations"] == first["posterior"]["evaluations"]


def test_a_wrong_value_is_refused_with_its_place(served: ServedRun) -> None:
    answer = served.server.post("/v1/jobs", json={**served.body, "posterior": "rough"})
    (fault,) = refused(answer, 422, "invalid")
    assert fault["pointer"] == "/posterior"
