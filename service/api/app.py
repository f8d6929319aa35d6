"""Build the web application: lifespan, routes, middleware and error handlers."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version

from fastapi import Depends, FastAPI
from starlette.concurrency import run_in_threadpool
from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipMiddleware
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from service.api.content import MCAP_TYPE
from service.api.contract.openapi import DocumentedApp, get_route_name
from service.api.requests import problems
from service.api.requests.access_check import AccessCheck
from service.api.requests.dependencies import Parts
from service.api.requests.html_answers import PRIVATE_HEADERS, PROTECTIVE_HEADERS
from service.api.requests.middleware import BodyLimit, BodyPace, OriginCheck, ResponseHeaders
from service.api.requests.query_names import check_query_names
from service.api.requests.request_log import RequestLog
from service.api.requests.request_root_path import RootPath
from service.api.routes import (
    access_routes,
    dataset_routes,
    event_routes,
    figure_routes,
    health_routes,
    job_routes,
    model_routes,
    page_routes,
    recipe_routes,
    reference_routes,
    run_routes,
)
from service.core.settings import Settings
from service.queue.orphaned_jobs import Reaper
from service.storage.open_storage import open_storage
from service.upkeep.housekeeper import Housekeeper, KeptDays

DESCRIPTION = (
    "Identification of nonlinear time-lag systems. Upload a recording, name a model or write its "
    "equations, and submit a job. Then read the estimates with their standard errors. Errors are "
    "RFC 9457 problem documents."
)


def create_app(settings: Settings | None = None) -> FastAPI:
    """Build the application with these settings; the default is those of the environment.

    Its lifespan opens the database and the store and upgrades the tables to this version.
    `app.state.parts` holds both while the application runs.
    """
    chosen = settings or Settings()
    app = DocumentedApp(
        title="lagid",
        version=version("lagid"),
        description=DESCRIPTION,
        lifespan=_build_lifespan(chosen),
        dependencies=[Depends(check_query_names)],
        generate_unique_id_function=get_route_name,
        separate_input_output_schemas=False,
        docs_url=None,  # FastAPI's own page loads its scripts from elsewhere; ours is at /docs
        redoc_url=None,
        redirect_slashes=False,  # its address has the scheme that a proxy may have changed
    )
    problems.install_handlers(app)
    app.add_middleware(BodyLimit, limit=chosen.max_body_bytes)
    app.add_middleware(BodyPace)
    if chosen.auth_mode != "off":
        app.add_middleware(ResponseHeaders, headers=PRIVATE_HEADERS)
    app.add_middleware(ProxyHeadersMiddleware, trusted_hosts=list(chosen.proxy_addresses))
    app.add_middleware(AccessCheck, settings=chosen)  # it sees the address of the peer itself
    app.add_middleware(OriginCheck, settings=chosen)
    app.add_middleware(ResponseHeaders, headers=PROTECTIVE_HEADERS)
    app.add_middleware(
        GZipMiddleware,
        minimum_size=1000,
        compresslevel=4,
        exclude_content_types=(*DEFAULT_EXCLUDED_CONTENT_TYPES, MCAP_TYPE),
    )
    app.add_middleware(RootPath, default=chosen.root_path)
    app.add_middleware(RequestLog)  # the last one is outermost
    # Exact REST paths come first: a page's path may have parameters.
    for router in (
        health_routes.router,
        dataset_routes.router,
        model_routes.router,
        model_routes.edit_router,
        job_routes.router,
        recipe_routes.recipe_router,
        reference_routes.reference_router,
        event_routes.router,
        run_routes.comparison_router,
        run_routes.router,
        figure_routes.router,
        access_routes.router,
        page_routes.router,
    ):
        app.include_router(router)
    return app


def open_parts(settings: Settings) -> Parts:
    """Open the database and the object store; create the data folder and the tables if needed.

    Raises
    ------
    Misconfigured
        If the data folder is not writable.
    """
    return Parts.build(settings, *open_storage(settings))


def _build_lifespan(settings: Settings):  # type: ignore[no-untyped-def]
    @asynccontextmanager
    async def run(app: FastAPI) -> AsyncIterator[None]:
        app.state.parts = parts = await run_in_threadpool(open_parts, settings)
        reaper = Reaper(parts.database, parts.stopping)
        keep = KeptDays(jobs=settings.keep_days, audit=settings.keep_audit_days)
        housekeeper = Housekeeper(parts.database, parts.store, keep, parts.stopping, parts.scrubber)
        reaper.start()
        housekeeper.start()
        try:
            yield
        finally:
            parts.stopping.set()
            reaper.join()
            housekeeper.join()
            parts.database.dispose()

    return run
