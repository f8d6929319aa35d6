"""Routes of the pages, of the figures that they show, and of the files that they load."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, PlainTextResponse, Response

from service.api.dependencies import Cursor, PartsDep, ReadSession
from service.api.html import Page
from service.api.jobs import Filter
from service.core.errors import NotFound
from service.figures import plotly as figures
from service.pages import figures as results
from service.pages import pages, report
from service.pages import pages as recipe_pages
from service.pages import render as assets
from service.pages.figures import FigureChoice, FigureName
from service.pages.simulate import simulate_page as simulate
from service.storage.tables import State

router = APIRouter()

FOREVER = "public, max-age=31536000, immutable"


Hidden: dict[str, Any] = {"include_in_schema": False, "response_class": HTMLResponse}
StateFilter = Annotated[State | None, Query()]
Choice = Annotated[FigureChoice, Query()]
ComparedRuns = Annotated[list[str], Query(min_length=2, max_length=50)]


@router.get("/docs", **Hidden)
def reference_page(request: Request) -> Response:
    """The REST interface for people."""
    return Page(pages.reference_page(request.app.openapi()))


@router.get("/", **Hidden)
def jobs_page(session: ReadSession, state: StateFilter = None, cursor: Cursor = None) -> Response:
    """The list of jobs, and the form of a new identification."""
    return Page(pages.jobs_page(session, state, cursor))


@router.get("/new/noise-sweep", **Hidden)
def noise_sweep_page(session: ReadSession) -> Response:
    """The form of a noise sweep."""
    return Page(recipe_pages.noise_sweep_page(session))


@router.get("/new/reidentify", **Hidden)
def reidentify_page(session: ReadSession) -> Response:
    """The form of a batch re-identification."""
    return Page(recipe_pages.reidentify_page(session))


@router.get("/jobs/{job_id}", **Hidden)
def job_page(
    job_id: str, request: Request, session: ReadSession, cursor: Cursor = None,
    cell: Filter = None,
) -> Response:  # fmt: skip
    """One job with its runs, or the grid of its cells and the runs of the chosen one."""
    url = str(request.base_url)
    return Page(pages.job_page(session, job_id, url, cursor=cursor, cell=cell or []))


@router.get("/runs/{run_id}", **Hidden)
def run_page(run_id: str, request: Request, session: ReadSession) -> Response:
    """The job of one run, with this run in full."""
    return Page(pages.run_page(session, run_id, str(request.base_url)))


@router.get("/runs/{run_id}/simulate", **Hidden)
def simulate_page(run_id: str, request: Request, parts: PartsDep) -> Response:
    """The model of a run in a closed loop, over a recording, or on a signal; or its form."""
    query = dict(request.query_params)
    found = simulate(parts.database, parts.store, run_id, query, str(request.base_url))
    if found.is_csv:
        return _as_csv(found.text, "simulation")
    return Page(found.text, found.status)


@router.get("/compare", **Hidden)
def compare_page(session: ReadSession, run: ComparedRuns) -> Response:
    """Runs of several models on the same data side by side."""
    return Page(pages.compare_page(session, run))


@router.get("/datasets", **Hidden)
def datasets_page(session: ReadSession, cursor: Cursor = None) -> Response:
    """The stored recordings."""
    return Page(pages.datasets_page(session, cursor))


@router.get("/datasets/{dataset_id}", **Hidden)
def dataset_page(dataset_id: str, session: ReadSession) -> Response:
    """One dataset: signals, channels, lineage."""
    return Page(pages.dataset_page(session, dataset_id))


@router.get("/pages/models/{name}.yaml", **Hidden)
def model_text(name: str, session: ReadSession) -> Response:
    """A model as the text that the form shows."""
    return PlainTextResponse(pages.model_text(session, name))


@router.get("/pages/jobs/{job_id}/model.yaml", **Hidden)
def job_model_text(job_id: str, session: ReadSession) -> Response:
    """The model of a job as the text that the form shows for its clone."""
    return PlainTextResponse(pages.job_model_text(session, job_id))


@router.get("/static/{name}", **Hidden)
def static(name: str, request: Request) -> Response:
    """Our own files, and Plotly out of its installed wheel."""
    if name == assets.plotly_name():
        return _plotly(request)
    found = assets.asset(name)
    if found is None:
        raise NotFound("file", name)
    headers = {"ETag": found.etag, "Cache-Control": "no-cache", "X-Content-Type-Options": "nosniff"}
    if found.etag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    return Response(found.content, media_type=found.media_type, headers=headers)


@router.get("/v1/runs/{run_id}/figures/{name}", tags=["runs"], response_class=JSONResponse)
def run_figure(
    run_id: str, name: FigureName, parts: PartsDep, session: ReadSession, choice: Choice
) -> Response:
    """A figure of a run as Plotly JSON, or the numbers it draws as CSV."""
    return _figure(results.run_figure(session, parts.store, run_id, name, choice), name, choice)


@router.get("/v1/jobs/{job_id}/figures/summary", tags=["jobs"], response_class=JSONResponse)
def job_figure(job_id: str, session: ReadSession, choice: Choice) -> Response:
    """Errors against the noise (Figure 15) as Plotly JSON, or the numbers drawn as CSV."""
    return _figure(results.job_figure(session, job_id, choice), "summary", choice)


@router.get("/v1/jobs/{job_id}/figures/trend", tags=["jobs"], response_class=JSONResponse)
def trend_figure(job_id: str, session: ReadSession, choice: Choice) -> Response:
    """Estimates over the label of a batch as Plotly JSON, or the numbers drawn as CSV."""
    return _figure(results.trend_of_job(session, job_id, choice), "trend", choice)


@router.get("/v1/datasets/{dataset_id}/figures/signals", tags=["datasets"],
            response_class=JSONResponse)  # fmt: skip
def dataset_figure(
    dataset_id: str, parts: PartsDep, session: ReadSession, choice: Choice
) -> Response:
    """The signals of a dataset as Plotly JSON, or the numbers drawn as CSV."""
    found = results.dataset_figure(session, parts.store, dataset_id, choice)
    return _figure(found, "signals", choice)


@router.get("/v1/jobs/{job_id}/report", tags=["jobs"], response_class=HTMLResponse)
def job_report(job_id: str, request: Request, parts: PartsDep, session: ReadSession) -> Response:
    """The job as one HTML file that needs no server: tables, figures, the exact request."""
    made = report.job_report(session, parts.store, job_id, str(request.base_url))
    policy = {"Content-Security-Policy": report.policy(), "X-Content-Type-Options": "nosniff"}
    return HTMLResponse(made, headers=policy)


def _figure(figure: figures.Figure, name: str, choice: FigureChoice) -> Response:
    if choice.format == "csv":
        return _as_csv(figures.as_csv(figure), name)
    return JSONResponse(figures.in_theme(figure, choice.theme))


def _as_csv(text: str, name: str) -> Response:
    disposition = {"Content-Disposition": f'attachment; filename="{name}.csv"'}
    return Response(text, media_type="text/csv", headers=disposition)


def _plotly(request: Request) -> Response:
    headers = {"Cache-Control": FOREVER, "Vary": "Accept-Encoding"}
    if "gzip" not in request.headers.get("accept-encoding", ""):
        return FileResponse(assets.plotly_file(), media_type="text/javascript", headers=headers)
    headers["Content-Encoding"] = "gzip"
    return Response(assets.plotly_compressed(), media_type="text/javascript", headers=headers)
