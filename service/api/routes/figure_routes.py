"""Routes of figures, as Plotly JSON or as CSV, and of the report of a job."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response

from service.api.requests.dependencies import PartsDep, ReadSession
from service.core.bodies.wire import FigureOut
from service.figures.csv import to_csv
from service.pages import render as assets
from service.pages.reports import job_report
from service.pages.run_figures import (
    FigureChoice,
    TrendChoice,
    load_dataset_figure,
    load_noise_figure,
    load_run_figure,
    load_trend_figure,
)
from sysid.figures.plotly import Figure, apply_theme
from sysid.results.figures import FigureName

router = APIRouter()

FIGURE: dict[str, Any] = {
    "response_class": JSONResponse,
    "response_model": FigureOut,
    "responses": {200: {"content": {"text/csv": {"schema": {"type": "string"}}}}},
}
FigureQuery = Annotated[FigureChoice, Query()]


@router.get("/v1/runs/{run_id}/figures/{name}", tags=["runs"], **FIGURE)
def draw_run_figure(
    run_id: str, name: FigureName, parts: PartsDep, session: ReadSession, choice: FigureQuery
) -> Response:
    """Draw a figure of a run as Plotly JSON, or export its numbers as CSV."""
    return figure_response(
        load_run_figure(session, parts.store, run_id, name, choice), name, choice
    )


@router.get("/v1/jobs/{job_id}/figures/summary", tags=["jobs"], **FIGURE)
def draw_summary_figure(job_id: str, session: ReadSession, choice: FigureQuery) -> Response:
    """Draw errors against the noise (Figure 15) as Plotly JSON, or export the numbers as CSV."""
    return figure_response(load_noise_figure(session, job_id, choice), "summary", choice)


@router.get("/v1/jobs/{job_id}/figures/trend", tags=["jobs"], **FIGURE)
def draw_trend_figure(
    job_id: str, session: ReadSession, choice: Annotated[TrendChoice, Query()]
) -> Response:
    """Draw estimates over a batch's label as Plotly JSON, or export the numbers as CSV."""
    return figure_response(load_trend_figure(session, job_id, choice), "trend", choice)


@router.get("/v1/datasets/{dataset_id}/figures/signals", tags=["datasets"], **FIGURE)
def draw_dataset_figure(
    dataset_id: str, parts: PartsDep, session: ReadSession, choice: FigureQuery
) -> Response:
    """Draw the signals of a dataset as Plotly JSON, or export the numbers as CSV."""
    figure = load_dataset_figure(session, parts.store, dataset_id, choice)
    return figure_response(figure, "signals", choice)


@router.get("/v1/jobs/{job_id}/report", tags=["jobs"], response_class=HTMLResponse)
def export_report(job_id: str, request: Request, parts: PartsDep, session: ReadSession) -> Response:
    """Export the job as one HTML file that needs no server: tables, figures, the exact request."""
    text = job_report.render_job_report(session, parts.store, job_id, str(request.base_url))
    # A file cannot say who may frame it: this directive works in a header only.
    policy = f"{assets.security_policy()}; frame-ancestors 'none'"
    return HTMLResponse(text, headers={"Content-Security-Policy": policy})


def figure_response(figure: Figure, name: str, choice: FigureChoice) -> Response:
    """Answer with a figure as Plotly JSON, or with its numbers as CSV."""
    if choice.format == "csv":
        return csv_response(to_csv(figure), name)
    return JSONResponse(apply_theme(figure, choice.theme))


def csv_response(text: str, name: str) -> Response:
    """Answer with a table as a file of this name."""
    disposition = {"Content-Disposition": f'attachment; filename="{name}.csv"'}
    return Response(text, media_type="text/csv", headers=disposition)
