"""Routes of the pages, and of the files that they load."""

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import (
    FileResponse,
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
)

from service.api.requests.dependencies import CallerDep, Cursor, PartsDep, ReadSession
from service.api.requests.html_answers import HtmlPage
from service.api.routes.figure_routes import csv_response, figure_response
from service.api.routes.health_routes import collect_failures
from service.api.routes.item_queries import (
    DatasetFormDep,
    FormText,
    JobFormDep,
    parse_form,
    parse_order,
    parse_states,
)
from service.api.routes.job_routes import CellFilter
from service.core.errors import NotFound
from service.core.root_path import to_address
from service.pages import health_pages, job_pages, model_pages, reference_pages, result_pages
from service.pages import render as assets
from service.pages.documentation import guides
from service.pages.forms.proposed_bounds import propose_bounds
from service.pages.result_pages import ResultChoice
from service.pages.run_figures import ComparisonChoice, load_comparison_figure
from service.pages.simulation_page import simulate_page as simulate
from sysid.figures.plotly import apply_theme
from sysid.figures.theme import Theme
from sysid.trends.trend import OutlierRule

router = APIRouter()

CACHE_FOREVER = "public, max-age=31536000, immutable"


HIDDEN: dict[str, Any] = {"include_in_schema": False, "response_class": HTMLResponse}
ComparedRuns = Annotated[list[str] | None, Query(max_length=50)]


@router.get("/docs", **HIDDEN)
def reference_page() -> Response:
    """Show the documentation of the REST interface, with a form to try each request."""
    return HtmlPage(job_pages.reference_page())


@router.get("/guides", **HIDDEN)
def guides_page() -> Response:
    """Lead to the contents of the documentation; its links are relative."""
    return RedirectResponse(to_address("/guides/"))


@router.get("/guides/{path:path}", **HIDDEN)
def guide_page(path: str) -> Response:
    """Show a page of the documentation, one of its files, or a page as a notebook."""
    if file := guides.find_file(path):
        return FileResponse(file, headers={"Cache-Control": "no-cache"})
    if notebook := guides.make_notebook(path):
        return Response(notebook, media_type="application/x-ipynb+json")
    if guides.is_folder(path):  # its links are relative
        return RedirectResponse(to_address(f"/guides/{path}/"))
    return HtmlPage(job_pages.guide_page(path or guides.INDEX))


@router.get("/", **HIDDEN)
def jobs_page(
    session: ReadSession,
    request: Request,
    form: JobFormDep,
    cursor: Cursor = None,
) -> Response:
    """Show the list of jobs, and the form of a new identification."""
    selection = job_pages.JobSelection(
        parse_form(session, form), parse_states(form), parse_order(form), form
    )
    return HtmlPage(job_pages.jobs_page(session, selection, cursor, str(request.base_url)))


@router.get("/new/noise-sweep", **HIDDEN)
def noise_sweep_page(session: ReadSession) -> Response:
    """Show the form of a noise sweep."""
    return HtmlPage(job_pages.noise_sweep_page(session))


@router.get("/new/reidentify", **HIDDEN)
def reidentify_page(session: ReadSession) -> Response:
    """Show the form of a batch re-identification."""
    return HtmlPage(job_pages.reidentify_page(session))


@router.get("/jobs/{job_id}", **HIDDEN)
def job_page(
    job_id: str,
    request: Request,
    session: ReadSession,
    parts: PartsDep,
    cursor: Cursor = None,
    cell: CellFilter = None,
    outliers: OutlierRule = "exclude",
) -> Response:
    """Show a job with its runs, or the grid of its cells and the runs of the chosen cell."""
    url, store = str(request.base_url), parts.store
    return HtmlPage(
        job_pages.job_page(
            session, store, job_id, url, cursor=cursor, cell=cell or [], outliers=outliers
        )
    )


@router.get("/runs/{run_id}", **HIDDEN)
def run_page(run_id: str, request: Request, session: ReadSession, parts: PartsDep) -> Response:
    """Show the job of a run, with this run in full."""
    return HtmlPage(job_pages.run_page(session, parts.store, run_id, str(request.base_url)))


@router.get("/runs/{run_id}/simulate", **HIDDEN)
def simulate_page(run_id: str, request: Request, parts: PartsDep) -> Response:
    """Show the form to simulate the model of a run; with a full query, the simulation."""
    query = dict(request.query_params)
    answer = simulate(
        parts.database, parts.store, parts.readers, run_id, query, str(request.base_url)
    )
    if answer.is_csv:
        return csv_response(answer.text, "simulation")
    return HtmlPage(answer.text, answer.status)


@router.get("/compare", **HIDDEN)
def compare_page(session: ReadSession, run: ComparedRuns = None) -> Response:
    """Compare runs of any jobs, on the same data or on others."""
    return HtmlPage(job_pages.compare_page(session, run or []))


@router.get("/pages/compare/response", **HIDDEN)
def comparison_figure(
    parts: PartsDep, session: ReadSession, choice: Annotated[ComparisonChoice, Query()]
) -> Response:
    """Draw the identified outputs of several runs over the measured ones."""
    figure = load_comparison_figure(session, parts.store, choice)
    return figure_response(figure, "comparison", choice)


def read_result_choice(
    session: ReadSession,
    form: JobFormDep,
    parameter: FormText = "",
    over: FormText = "",
    runs: FormText = "",
    cursor: Cursor = None,
) -> ResultChoice:
    """Read which results are shown, and of which runs; a form sends empty fields too."""
    more = {"parameter": parameter.strip(), "over": over.strip(), "runs": runs.strip()}
    filled = {**form, **{name: text for name, text in more.items() if text}}
    return ResultChoice(
        chosen=parse_form(session, form),
        parameter=more["parameter"],
        over=more["over"] or result_pages.ORDER,
        only_best=more["runs"] == "best",
        form=filled,
        cursor=cursor,
    )


ResultChoiceDep = Annotated[ResultChoice, Depends(read_result_choice)]


@router.get("/results", **HIDDEN)
def results_page(session: ReadSession, choice: ResultChoiceDep) -> Response:
    """Show one parameter over the runs of any jobs."""
    return HtmlPage(result_pages.results_page(session, choice))


@router.get("/pages/results/figure", **HIDDEN)
def results_figure(
    session: ReadSession, choice: ResultChoiceDep, theme: Theme = "light"
) -> Response:
    """Draw one parameter over the runs of any jobs."""
    return JSONResponse(apply_theme(result_pages.load_results_figure(session, choice), theme))


@router.get("/pages/results.csv", **HIDDEN)
def results_csv(session: ReadSession, choice: ResultChoiceDep) -> Response:
    """Export one parameter over the runs of any jobs."""
    return csv_response(result_pages.write_results_csv(session, choice), "results")


@router.get("/models", **HIDDEN)
def models_page(session: ReadSession, name: FormText = "", cursor: Cursor = None) -> Response:
    """Show the gallery of models."""
    form = {"name": name.strip()} if name.strip() else {}
    return HtmlPage(model_pages.models_page(session, form, cursor))


@router.get("/models/{name}", **HIDDEN)
def model_page(name: str, session: ReadSession) -> Response:
    """Show one model: equations, parameters, jobs that used it."""
    return HtmlPage(model_pages.model_page(session, name))


@router.get("/references", **HIDDEN)
def references_page(session: ReadSession, form: DatasetFormDep, cursor: Cursor = None) -> Response:
    """List the references in use."""
    chosen = parse_form(session, form)
    return HtmlPage(reference_pages.references_page(session, cursor, chosen, form))


@router.get("/references/{name}", **HIDDEN)
def show_reference_page(name: str, session: ReadSession) -> Response:
    """Show one reference, and what is compared with it."""
    return HtmlPage(reference_pages.reference_page(session, name))


@router.get("/health", **HIDDEN)
def health_page(parts: PartsDep, caller: CallerDep) -> Response:
    """Show which parts of the service work, its queue and its dispatchers."""
    failures = {fault.pointer: fault.detail for fault in collect_failures(parts)}
    is_admin = "admin" in caller.scopes
    return HtmlPage(
        health_pages.health_page(
            parts.database,
            parts.settings,
            failures,
            parts.scrubber.describe(),
            is_admin=is_admin,
        )
    )


@router.get("/settings", **HIDDEN)
def settings_page(parts: PartsDep) -> Response:
    """Show the settings in effect, to who may administrate."""
    return HtmlPage(health_pages.settings_page(parts.settings))


@router.get("/datasets", **HIDDEN)
def datasets_page(session: ReadSession, form: DatasetFormDep, cursor: Cursor = None) -> Response:
    """List the stored recordings."""
    return HtmlPage(job_pages.datasets_page(session, cursor, parse_form(session, form), form))


@router.get("/datasets/{dataset_id}", **HIDDEN)
def dataset_page(dataset_id: str, session: ReadSession) -> Response:
    """Show one dataset: signals, channels, lineage."""
    return HtmlPage(job_pages.dataset_page(session, dataset_id))


@router.get("/pages/datasets/{dataset_id}/bounds", **HIDDEN)
def show_bounds(
    dataset_id: str,
    parts: PartsDep,
    session: ReadSession,
    model: str = "fopdt",
    channel: Annotated[list[str] | None, Query(max_length=100)] = None,
) -> Response:
    """Propose the bounds that follow the data; channels are pairs such as ``u=heater``."""
    pairs = (text.partition("=") for text in channel or ())
    channels = {signal: name for signal, _, name in pairs}
    return JSONResponse(propose_bounds(session, parts.store, dataset_id, model, channels))


@router.get("/pages/models/{name}.yaml", **HIDDEN)
def model_text(name: str, session: ReadSession) -> Response:
    """Return a model as the text that the form shows."""
    return PlainTextResponse(model_pages.model_text(session, name))


@router.get("/pages/jobs/{job_id}/model.yaml", **HIDDEN)
def job_model_text(job_id: str, session: ReadSession) -> Response:
    """Return the model of a job as the text that the form shows for a clone."""
    return PlainTextResponse(model_pages.job_model_text(session, job_id))


@router.get("/static/{name}", **HIDDEN)
def static_file(name: str, request: Request) -> Response:
    """Serve the package's static files, and bundles from installed wheels."""
    if bundle := assets.find_bundle(name):
        return _answer_bundle(bundle, request)
    asset = assets.load_asset(name)
    if asset is None:
        raise NotFound("file", name)
    headers = {"ETag": asset.etag, "Cache-Control": "no-cache"}
    if asset.etag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    return Response(asset.content, media_type=asset.media_type, headers=headers)


def _answer_bundle(bundle: assets.Bundle, request: Request) -> Response:
    headers = {"Cache-Control": CACHE_FOREVER, "Vary": "Accept-Encoding"}
    if "gzip" not in request.headers.get("accept-encoding", ""):
        return FileResponse(bundle.file, media_type=bundle.media_type, headers=headers)
    headers["Content-Encoding"] = "gzip"
    content = assets.compress_bundle(bundle)
    return Response(content, media_type=bundle.media_type, headers=headers)
