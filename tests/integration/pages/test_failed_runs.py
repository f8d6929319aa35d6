"""A job of which some runs failed says so, and these can be resumed alone."""

from pathlib import Path

from fastapi.testclient import TestClient

from service.api.app import create_app
from service.cli.job_commands import _describe_outcome, _describe_state
from service.core.states import JobState
from service.queue.leases import LeaseQueue
from service.queue.run_writes import RunOutcome
from tests.support.service.web_app import parts_of, recording, settings_of, store_csv
from tests.support.storage.job_rows import claim, record_outcomes, runs_of
from tests.support.storage.run_results import write_result


def test_a_job_with_failed_runs_says_how_many_and_resumes_these(tmp_path: Path) -> None:
    with TestClient(create_app(settings_of(tmp_path))) as client:
        database = parts_of(client).database
        sweep = {"axes": [{"path": "/seed", "values": [1, 2, 3]}]}
        body = {"model": "fopdt", "datasets": [store_csv(client, recording())], "sweep": sweep}
        assert client.post("/v1/jobs", json=body).status_code == 202
        got = claim(database)
        assert got is not None
        first, *others = [run.id for run in runs_of(database, got.job.id)]
        record_outcomes(
            database,
            got.lease,
            RunOutcome(run_id=first, state=JobState.SUCCEEDED, best_rms=0.1, result=write_result()),
            *(RunOutcome(run_id=run, state=JobState.FAILED, error="it diverged") for run in others),
        )
        with database.write_session() as session:
            LeaseQueue(session).finish_job(got.lease, JobState.INCOMPLETE, "2 of 3 runs failed")
        job = client.get(f"/v1/jobs/{got.job.id}").json()
        assert (job["state"], job["progress"]["failed"]) == ("incomplete", 2)
        assert _describe_state(job) == "2 of 3 failed"
        told = {**job, "outcome": {"verdict": "trustworthy"}}
        assert _describe_outcome(told) == "2 of 3 failed; best run: trustworthy"
        for path in ("/", f"/jobs/{got.job.id}"):
            assert '<span class="chip failed">2 of 3 failed</span>' in client.get(path).text
        page = client.get(f"/jobs/{got.job.id}").text
        assert 'data-act="resume?failed=true">Resume failed runs</button>' in page
        resumed = client.post(f"/v1/jobs/{got.job.id}:resume?failed=true").json()
        assert (resumed["state"], resumed["progress"]["finished"]) == ("queued", 1)
