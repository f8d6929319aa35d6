"""Routes of runs, including their comparison."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from service.api.content import (
    FILE_ANSWERS,
    CsvResponse,
    McapResponse,
    MemoryContent,
    content_response,
)
from service.api.requests.bodies import JsonRoute
from service.api.requests.dependencies import MaxPoints, PartsDep, ReadSession, WriteSession
from service.api.routes.item_queries import Cascade, IfMatch, delete, edit, set_etag
from service.control import run_simulation
from service.control.control_schemas import RunSimulationIn, RunSimulationOut
from service.core.bodies.wire import FigureOut
from service.figures.profile_figure import plot_profiles as profile_figure
from service.items.item_schemas import DeletedOut, EditIn
from service.repositories.run_rows import RunRepository
from service.runs import (
    bands,
    comparison,
    disturbances,
    exports,
    fitted,
    profiles,
    residuals,
    run_file,
    runs,
    validation_run,
)
from service.runs.run_schemas import (
    BandsOut,
    CompareIn,
    ComparisonOut,
    DisturbancesOut,
    ExportedModelOut,
    FreeRunIn,
    FreeRunOut,
    HistoryOut,
    MigrationsOut,
    ProfileIn,
    ProfilesOut,
    ResidualsOut,
    ResponseOut,
    RunOut,
)
from sysid.export.export import MAX_PADE_ORDER, ExportFormat
from sysid.figures.plotly import apply_theme
from sysid.figures.theme import Theme

router = APIRouter(prefix="/v1/runs", tags=["runs"], route_class=JsonRoute)


@router.get("/{run_id}")
def read_run(run_id: str, session: ReadSession, parts: PartsDep, response: Response) -> RunOut:
    """Read one run: its state, and its result as soon as it exists.

    The residuals of a sweep's run are explained when it is read here.
    """
    set_etag(response, RunRepository(session).get(run_id))
    return runs.get_run(session, run_id, parts.store)


@router.patch("/{run_id}")
def edit_run(
    run_id: str,
    body: EditIn,
    session: WriteSession,
    response: Response,
    if_match: IfMatch = None,
) -> RunOut:
    """Change note or tags of a run; with `If-Match` only if they are as they were read."""
    edit(session, "run", run_id, body, if_match, response)
    return runs.get_run(session, run_id)


@router.delete("/{run_id}")
def delete_run(
    run_id: str, session: WriteSession, cascade: Cascade = False, if_match: IfMatch = None
) -> DeletedOut:
    """Delete a run of an ended job; 409 lists what was made from it."""
    return delete(session, "run", run_id, cascade, if_match)


@router.get("/{run_id}/history")
def read_history(run_id: str, session: ReadSession) -> HistoryOut:
    """Read all improvements of every island's champion."""
    return runs.get_history(session, run_id)


@router.get("/{run_id}/migrations")
def read_migrations(run_id: str, session: ReadSession) -> MigrationsOut:
    """Read the migrations: individual, epoch, source island, target island."""
    return runs.get_migrations(session, run_id)


@router.get("/{run_id}/response")
def read_response(
    run_id: str, session: ReadSession, parts: PartsDep, max_points: MaxPoints = 1000
) -> ResponseOut:
    """Read measured and simulated outputs, reduced so that extremes stay visible."""
    return fitted.build_response(session, parts.store, run_id, max_points)


@router.get("/{run_id}/bands")
def read_bands(
    run_id: str, session: ReadSession, parts: PartsDep, max_points: MaxPoints = 1000
) -> BandsOut:
    """Read the 95 % confidence and prediction bands of the outputs, computed from the estimates."""
    return bands.build_bands(session, parts.store, run_id, max_points)


@router.get("/{run_id}/disturbances")
def read_disturbances(
    run_id: str, session: ReadSession, parts: PartsDep, max_points: MaxPoints = 1000
) -> DisturbancesOut:
    """Read the estimated disturbances with their 95 % bands, if noise acts inside the plant."""
    return disturbances.build_disturbances(session, parts.store, run_id, max_points)


@router.get("/{run_id}/residuals")
def read_residual_tests(run_id: str, session: ReadSession, parts: PartsDep) -> ResidualsOut:
    """Read the residual tests: auto- and cross-correlation with 95 and 99 % bands."""
    return residuals.get_residuals(session, parts.store, run_id)


Format = Annotated[ExportFormat, Query(description="format of the file")]
PadeOrder = Annotated[
    int,
    Query(ge=1, le=MAX_PADE_ORDER, description="order of the Padé approximation, for `control`"),
]
FigureTheme = Annotated[Theme, Query(description="light or dark colours of the figure")]
EXPORT_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {
        "model": ExportedModelOut,
        "description": "The model as a file",
        "content": {kind: {"schema": {"type": "string"}} for kind in exports.TEXT_TYPES},
    }
}


@router.get("/{run_id}/export", response_class=Response, responses=EXPORT_ANSWERS)
def export_model(
    run_id: str,
    session: ReadSession,
    format: Format = "json",
    pade_order: PadeOrder = 3,
) -> Response:
    """Export the identified model as text: json, python, c (C99), or control (python-control)."""
    model = exports.export_run(session, run_id, format, pade_order)
    headers = {"Content-Disposition": f'attachment; filename="{model.name}"'}
    return Response(model.text, media_type=model.media_type, headers=headers)


@router.get("/{run_id}/estimates.csv", response_class=CsvResponse)
def export_estimates_csv(run_id: str, session: ReadSession) -> CsvResponse:
    """Export the estimates as CSV: a row per parameter, with error, interval, unit and status."""
    disposition = {"Content-Disposition": f'attachment; filename="{run_id}.csv"'}
    return CsvResponse([exports.write_estimates(session, run_id)], headers=disposition)


@router.post("/{run_id}:simulate")
def simulate_run(
    run_id: str, body: RunSimulationIn, parts: PartsDep, max_points: MaxPoints = 1000
) -> RunSimulationOut:
    """Simulate the identified model on new inputs or under P, PI or PID control."""
    return run_simulation.simulate_run(
        parts.database, parts.store, parts.readers, run_id, body, max_points
    )


@router.post("/{run_id}:validate")
def validate_run(
    run_id: str, body: FreeRunIn, parts: PartsDep, max_points: MaxPoints = 1000
) -> FreeRunOut:
    """Simulate the identified model (free run) on another recording: RMS and fit."""
    return validation_run.validate_run(parts.database, parts.store, run_id, body, max_points)


@router.post("/{run_id}:profile")
def profile_run(
    run_id: str, body: ProfileIn, parts: PartsDep, theme: FigureTheme = "light"
) -> ProfilesOut:
    """Compute profile likelihoods of free parameters; the others are re-estimated at each value."""
    answer = profiles.compute_profiles(parts.database, parts.store, run_id, body)
    figure = apply_theme(profile_figure(answer.profiles, answer.threshold), theme)
    return ProfilesOut(**dict(answer), figure=FigureOut.model_validate(figure))


@router.head("/{run_id}/signals.mcap", include_in_schema=False)
@router.get("/{run_id}/signals.mcap", response_class=McapResponse, responses=FILE_ANSWERS)
def read_run_signals(
    run_id: str, request: Request, session: ReadSession, parts: PartsDep
) -> Response:
    """Download the run as MCAP: inputs, measured and simulated outputs, residuals, and its origin.

    Its topics are `/fit` and `/inputs`, those of every run. Ranges and ETags are honoured.
    """
    content = MemoryContent(run_file.load_run_file(session, parts.store, run_id))
    return content_response(request, content, content.sha256, f"{run_id}.mcap")


comparison_router = APIRouter(prefix="/v1", tags=["runs"], route_class=JsonRoute)


@comparison_router.post("/runs:compare")
def compare_runs(body: CompareIn, session: ReadSession) -> ComparisonOut:
    """Compare runs of several models on the same data, best first."""
    return comparison.compare_runs(session, body.runs)
