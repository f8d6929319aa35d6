"""Routes of the pages, of their figures, and of the files that they load."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, PlainTextResponse, Response

from service.api.dependencies import Cursor, PartsDep, ReadSession
from service.api.html import HtmlPage
from service.api.items import DatasetFormDep, JobFormDep, parse_form
from service.api.jobs import CellFilter
from service.core.errors import NotFound
from service.core.states import JobState
from service.figures.csv import to_csv
from service.pages import figures as results
from service.pages import pages, report
from service.pages import render as assets
from service.pages.figures import FigureChoice
from service.pages.simulate import simulate_page as simulate
from sysid.figures.plotly import Figure, apply_theme
from sysid.identification.figures import FigureName

router = APIRouter()

CACHE_FOREVER = "public, max-age=31536000, immutable"


HIDDEN: dict[str, Any] = {"include_in_schema": False, "response_class": HTMLResponse}
StateFilter = Annotated[JobState | None, Query()]
FigureQuery = Annotated[FigureChoice, Query()]
ComparedRuns = Annotated[list[str], Query(min_length=2, max_length=50)]


@router.get("/docs", **HIDDEN)
def reference_page(request: Request) -> Response:
    """Show the documentation of the REST interface."""
    return HtmlPage(pages.reference_page(request.app.openapi()))


@router.get("/", **HIDDEN)
def jobs_page(
    session: ReadSession, form: JobFormDep, state: StateFilter = None, cursor: Cursor = None
) -> Response:
    """Show the list of jobs, and the form of a new identification."""
    chosen = parse_form(session, form)
    return HtmlPage(pages.jobs_page(session, state, cursor, chosen, form))


@router.get("/new/noise-sweep", **HIDDEN)
def noise_sweep_page(session: ReadSession) -> Response:
    """Show the form of a noise sweep."""
    return HtmlPage(pages.noise_sweep_page(session))


@router.get("/new/reidentify", **HIDDEN)
def reidentify_page(session: ReadSession) -> Response:
    """Show the form of a batch re-identification."""
    return HtmlPage(pages.reidentify_page(session))


@router.get("/jobs/{job_id}", **HIDDEN)
def job_page(
    job_id: str,
    request: Request,
    session: ReadSession,
    cursor: Cursor = None,
    cell: CellFilter = None,
) -> Response:
    """Show a job with its runs, or the grid of its cells and the runs of the chosen cell."""
    url = str(request.base_url)
    return HtmlPage(pages.job_page(session, job_id, url, cursor=cursor, cell=cell or []))


@router.get("/runs/{run_id}", **HIDDEN)
def run_page(run_id: str, request: Request, session: ReadSession) -> Response:
    """Show the job of a run, with this run in full."""
    return HtmlPage(pages.run_page(session, run_id, str(request.base_url)))


@router.get("/runs/{run_id}/simulate", **HIDDEN)
def simulate_page(run_id: str, request: Request, parts: PartsDep) -> Response:
    """Show the form to simulate the model of a run; with a full query, the simulation."""
    query = dict(request.query_params)
    answer = simulate(parts.database, parts.store, run_id, query, str(request.base_url))
    if answer.is_csv:
        return _csv_response(answer.text, "simulation")
    return HtmlPage(answer.text, answer.status)


@router.get("/compare", **HIDDEN)
def compare_page(session: ReadSession, run: ComparedRuns) -> Response:
    """Compare runs of several models on the same data."""
    return HtmlPage(pages.compare_page(session, run))


@router.get("/datasets", **HIDDEN)
def datasets_page(session: ReadSession, form: DatasetFormDep, cursor: Cursor = None) -> Response:
    """List the stored recordings."""
    return HtmlPage(pages.datasets_page(session, cursor, parse_form(session, form), form))


@router.get("/datasets/{dataset_id}", **HIDDEN)
def dataset_page(dataset_id: str, session: ReadSession) -> Response:
    """Show one dataset: signals, channels, lineage."""
    return HtmlPage(pages.dataset_page(session, dataset_id))


@router.get("/pages/models/{name}.yaml", **HIDDEN)
def model_text(name: str, session: ReadSession) -> Response:
    """Return a model as the text that the form shows."""
    return PlainTextResponse(pages.model_text(session, name))


@router.get("/pages/jobs/{job_id}/model.yaml", **HIDDEN)
def job_model_text(job_id: str, session: ReadSession) -> Response:
    """Return the model of a job as the text that the form shows for a clone."""
    return PlainTextResponse(pages.job_model_text(session, job_id))


@router.get("/static/{name}", **HIDDEN)
def static_file(name: str, request: Request) -> Response:
    """Serve the package's static files, and Plotly from its installed wheel."""
    if name == assets.plotly_file_name():
        return _plotly_response(request)
    asset = assets.load_asset(name)
    if asset is None:
        raise NotFound("file", name)
    headers = {"ETag": asset.etag, "Cache-Control": "no-cache"}
    if asset.etag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    return Response(asset.content, media_type=asset.media_type, headers=headers)


@router.get("/v1/runs/{run_id}/figures/{name}", tags=["runs"], response_class=JSONResponse)
def run_figure(
    run_id: str, name: FigureName, parts: PartsDep, session: ReadSession, choice: FigureQuery
) -> Response:
    """Draw a figure of a run as Plotly JSON, or export its numbers as CSV."""
    return _figure_response(
        results.load_run_figure(session, parts.store, run_id, name, choice), name, choice
    )


@router.get("/v1/jobs/{job_id}/figures/summary", tags=["jobs"], response_class=JSONResponse)
def job_figure(job_id: str, session: ReadSession, choice: FigureQuery) -> Response:
    """Draw errors against the noise (Figure 15) as Plotly JSON, or export the numbers as CSV."""
    return _figure_response(results.load_noise_figure(session, job_id, choice), "summary", choice)


@router.get("/v1/jobs/{job_id}/figures/trend", tags=["jobs"], response_class=JSONResponse)
def trend_figure(job_id: str, session: ReadSession, choice: FigureQuery) -> Response:
    """Draw estimates over a batch's label as Plotly JSON, or export the numbers as CSV."""
    return _figure_response(results.load_trend_figure(session, job_id, choice), "trend", choice)


@router.get(
    "/v1/datasets/{dataset_id}/figures/signals", tags=["datasets"], response_class=JSONResponse
)
def dataset_figure(
    dataset_id: str, parts: PartsDep, session: ReadSession, choice: FigureQuery
) -> Response:
    """Draw the signals of a dataset as Plotly JSON, or export the numbers as CSV."""
    figure = results.load_dataset_figure(session, parts.store, dataset_id, choice)
    return _figure_response(figure, "signals", choice)


@router.get("/v1/jobs/{job_id}/report", tags=["jobs"], response_class=HTMLResponse)
def job_report(job_id: str, request: Request, parts: PartsDep, session: ReadSession) -> Response:
    """Export the job as one HTML file that needs no server: tables, figures, the exact request."""
    text = report.render_job_report(session, parts.store, job_id, str(request.base_url))
    # A file cannot say who may frame it: this directive works in a header only.
    policy = f"{assets.security_policy()}; frame-ancestors 'none'"
    return HTMLResponse(text, headers={"Content-Security-Policy": policy})


def _figure_response(figure: Figure, name: str, choice: FigureChoice) -> Response:
    if choice.format == "csv":
        return _csv_response(to_csv(figure), name)
    return JSONResponse(apply_theme(figure, choice.theme))


def _csv_response(text: str, name: str) -> Response:
    disposition = {"Content-Disposition": f'attachment; filename="{name}.csv"'}
    return Response(text, media_type="text/csv", headers=disposition)


def _plotly_response(request: Request) -> Response:
    headers = {"Cache-Control": CACHE_FOREVER, "Vary": "Accept-Encoding"}
    if "gzip" not in request.headers.get("accept-encoding", ""):
        return FileResponse(assets.plotly_path(), media_type="text/javascript", headers=headers)
    headers["Content-Encoding"] = "gzip"
    return Response(assets.compress_plotly(), media_type="text/javascript", headers=headers)
