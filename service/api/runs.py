"""Routes of runs.

The route that compares runs.
"""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from service.api.content import ByteRange, content_of
from service.api.dependencies import MaxPoints, PartsDep, ReadSession
from service.control import simulate as run_simulations
from service.control.schemas import RunSimulateIn, RunSimulationOut
from service.core.errors import NotFound
from service.figures.plotly import in_theme
from service.figures.profiles import profile as profile_figure
from service.figures.theme import Theme
from service.repositories.runs import RunRepository
from service.runs import comparison, exports, profiles, residuals, runs
from service.runs import fitted as responses
from service.runs import free_run as free_runs
from service.runs.schemas import (
    CompareIn,
    ComparisonOut,
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
from sysid.export.export import MOST_PADE, Format

router = APIRouter(prefix="/v1/runs", tags=["runs"])


@router.get("/{run_id}")
def read(run_id: str, session: ReadSession) -> RunOut:
    """One run: its state, and its result once there is one."""
    return runs.one(session, run_id)


@router.get("/{run_id}/history")
def history(run_id: str, session: ReadSession) -> HistoryOut:
    """Improvements of every island's champion; nothing is thinned out."""
    return runs.history(session, run_id)


@router.get("/{run_id}/migrations")
def migrations(run_id: str, session: ReadSession) -> MigrationsOut:
    """Who migrated when, from where, to where."""
    return runs.migrations(session, run_id)


@router.get("/{run_id}/response")
def response(
    run_id: str, session: ReadSession, parts: PartsDep, max_points: MaxPoints = 1000
) -> ResponseOut:
    """Measured and simulated outputs, reduced so that extremes stay visible."""
    return responses.response(session, parts.store, run_id, max_points)


@router.get("/{run_id}/residuals")
def residual_tests(run_id: str, session: ReadSession, parts: PartsDep) -> ResidualsOut:
    """Auto- and cross-correlation of the residuals with 95 and 99 % bands, and their tests."""
    return residuals.residuals(session, parts.store, run_id)


@router.get("/{run_id}/export", response_class=Response)
def export(
    run_id: str,
    session: ReadSession,
    format: Format = "json",
    pade_order: Annotated[int, Query(ge=1, le=MOST_PADE)] = 3,
) -> Response:
    """The identified model as text: json, python, c (C99), or control (python-control)."""
    found = exports.exported(session, run_id, format, pade_order)
    headers = {"Content-Disposition": f'attachment; filename="{found.name}"'}
    return Response(found.text, media_type=found.media_type, headers=headers)


@router.post("/{run_id}:simulate")
def simulate(
    run_id: str, body: RunSimulateIn, parts: PartsDep, max_points: MaxPoints = 1000
) -> RunSimulationOut:
    """Simulate the identified model on new inputs or under P, PI or PID control."""
    return run_simulations.simulate(parts.database, parts.store, run_id, body, max_points)


@router.post("/{run_id}:validate")
def validate(
    run_id: str, body: FreeRunIn, parts: PartsDep, max_points: MaxPoints = 1000
) -> FreeRunOut:
    """Run the identified model freely over another recording: RMS and fit there."""
    return free_runs.free_run(parts.database, parts.store, run_id, body, max_points)


@router.post("/{run_id}:profile")
def profile(run_id: str, body: ProfileIn, parts: PartsDep, theme: Theme = "light") -> ProfilesOut:
    """Profile likelihood of some free parameters, the others estimated anew at every value."""
    found = profiles.profiles(parts.database, parts.store, run_id, body)
    figure = in_theme(profile_figure(found.profiles, found.threshold), theme)
    return ProfilesOut(**dict(found), figure=figure)


@router.head("/{run_id}/signals.mcap", include_in_schema=False)
@router.get("/{run_id}/signals.mcap")
def signals(run_id: str, request: Request, session: ReadSession, parts: PartsDep) -> Response:
    """Measured and simulated outputs and residuals as MCAP; ranges and ETags are honoured."""
    run = RunRepository(session).get(run_id)
    if run.signals_sha256 is None:
        raise NotFound("signals file of run", run_id, f"; the run is {run.state.value}")
    part = None
    if run.signals_start is not None and run.signals_size is not None:
        part = ByteRange(run.signals_start, run.signals_start + run.signals_size)
    return content_of(request, parts.store, run.signals_sha256, f"{run_id}.mcap", part)


comparison_router = APIRouter(prefix="/v1", tags=["runs"])


@comparison_router.post("/runs:compare")
def compare(body: CompareIn, session: ReadSession) -> ComparisonOut:
    """Runs of several models on the same data side by side, the best first."""
    return comparison.compare(session, body.runs)
