"""Routes of datasets."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.api.content import (
    CROSS_ORIGIN,
    FILE_ANSWERS,
    CsvResponse,
    McapResponse,
    content_response,
    preflight_response,
    receive_upload,
)
from service.api.requests.bodies import JsonRoute
from service.api.requests.dependencies import (
    Cursor,
    Limit,
    MaxPoints,
    PartsDep,
    ReadSession,
    WriteSession,
)
from service.api.routes.item_queries import (
    Cascade,
    DatasetFilterDep,
    IfMatch,
    delete,
    edit,
    set_etag,
)
from service.core.root_path import to_address
from service.datasets import datasets, simulated
from service.datasets.dataset_schemas import (
    DatasetCheckOut,
    DatasetOut,
    DatasetPage,
    DeriveIn,
    JoinIn,
    LineageOut,
    SignalsOut,
    SimulateIn,
)
from service.datasets.stored_recordings import load_recording
from service.formats.limits import UploadLimits
from service.formats.read_options import Clock, build_options
from service.formats.tabular.csv_recordings import generate_csv
from service.items.item_schemas import DeletedOut, EditIn
from service.repositories.dataset_rows import DatasetRepository, StoredDataset

router = APIRouter(prefix="/v1", tags=["datasets"], route_class=JsonRoute)

UPLOAD_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "text/csv": {"schema": {"type": "string"}},
            "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "properties": {"file": {"type": "string", "format": "binary"}},
                    "required": ["file"],
                }
            },
        },
    }
}
EXISTING_DATASET: dict[int | str, dict[str, Any]] = {
    200: {"model": DatasetOut, "description": "The same data are stored already"}
}
Name = Annotated[
    str | None, Query(max_length=200, description="name of the dataset; by default the file's")
]
Segments = Annotated[
    str | None,
    Query(description="label columns, separated by commas; each combination is a segment"),
]
SampleTime = Annotated[
    float | None, Query(gt=0, description="sampling period in s, for a file without a time column")
]
Columns = Annotated[
    str | None,
    Query(
        description="names of the columns of a file without a header, `t,u,,y [V]`; a column with "
        "an empty name is left out"
    ),
]

Missing = Annotated[
    str | None,
    Query(
        description="words and numbers that mark bad data, `-9999,Offline`; if there are any, no "
        "other number is taken for one, and with `none` no number is"
    ),
]

Exclude = Annotated[
    str | None,
    Query(
        description="ranges of times (s) or values, and words of a column, separated by commas: "
        "`t=100:200,flow=90:,state=Bad`. Rows of times or words are cut out, values are missing"
    ),
]
McapClock = Annotated[
    Clock | None,
    Query(
        description="times of an MCAP file: when a message was logged (the default) or sent, or "
        "the stamp in its header"
    ),
]


@router.post("/datasets", status_code=201, openapi_extra=UPLOAD_BODY, responses=EXISTING_DATASET)
async def add_dataset(
    request: Request,
    response: Response,
    parts: PartsDep,
    name: Name = None,
    segments: Segments = None,
    sample_time: SampleTime = None,
    columns: Columns = None,
    missing: Missing = None,
    exclude: Exclude = None,
    clock: McapClock = None,
) -> DatasetOut:
    """Store a recording: CSV or other text, Excel, Parquet, NumPy, MATLAB or MCAP.

    The kind is recognised by the bytes. The same bytes again return the same dataset (200).
    """
    project, settings = parts.database.owner.project_id, parts.settings
    async with (
        receive_upload(request, settings, parts.upload_places, project) as upload,
        parts.readers.places.hold_awaiting(project),
    ):
        stored = await run_in_threadpool(
            datasets.add_upload,
            parts.database,
            parts.store,
            upload.path,
            sha256=upload.sha256,
            suffix=upload.suffix or Path(name or "").suffix,
            name=name or upload.name,
            options=build_options(
                sample_time=sample_time,
                segments=segments,
                columns=columns,
                missing=missing,
                exclude=exclude,
                clock=clock,
                limits=UploadLimits(
                    file_bytes=settings.max_upload_bytes, memory_bytes=parts.readers.memory_bytes
                ),
            ),
        )
    return _dataset_response(stored, response, name)


@router.post("/datasets:simulate", status_code=201, responses=EXISTING_DATASET)
def simulate_dataset(body: SimulateIn, parts: PartsDep, response: Response) -> DatasetOut:
    """Simulate a dataset from a model, its true parameters, inputs and noise."""
    return _dataset_response(
        simulated.simulate_dataset(parts.database, parts.store, parts.readers, body),
        response,
        body.name,
    )


@router.post("/datasets/{dataset_id}:derive", status_code=201, responses=EXISTING_DATASET)
def derive_dataset(
    dataset_id: str, body: DeriveIn, parts: PartsDep, response: Response
) -> DatasetOut:
    """Derive a dataset from another, by its id or name: add noise, resample, trim, select etc."""
    stored = datasets.derive_dataset(parts.database, parts.store, parts.readers, dataset_id, body)
    return _dataset_response(stored, response, body.name)


@router.post("/datasets:join", status_code=201, responses=EXISTING_DATASET)
def join_datasets(body: JoinIn, parts: PartsDep, response: Response) -> DatasetOut:
    """Join recordings of several loggers on one clock; nothing is resampled."""
    stored = datasets.join_datasets(parts.database, parts.store, body)
    return _dataset_response(stored, response, body.name)


@router.get("/datasets")
def list_datasets(
    session: ReadSession, chosen: DatasetFilterDep, cursor: Cursor = None, limit: Limit = 50
) -> DatasetPage:
    """List datasets, latest first; all conditions must hold."""
    return datasets.list_datasets(session, cursor, limit, chosen)


@router.get("/datasets/{dataset_id}")
def read_dataset(dataset_id: str, session: ReadSession, response: Response) -> DatasetOut:
    """Read one dataset: channels, sampling, segments, warnings."""
    row = DatasetRepository(session).get(dataset_id)
    set_etag(response, row)
    return datasets.to_out(row)


@router.patch("/datasets/{dataset_id}")
def edit_dataset(
    dataset_id: str,
    body: EditIn,
    session: WriteSession,
    response: Response,
    if_match: IfMatch = None,
) -> DatasetOut:
    """Change name, note or tags of a dataset; with `If-Match` only if they are as read."""
    edit(session, "dataset", dataset_id, body, if_match, response)
    return datasets.to_out(DatasetRepository(session).get(dataset_id))


@router.delete("/datasets/{dataset_id}")
def delete_dataset(
    dataset_id: str, session: WriteSession, cascade: Cascade = False, if_match: IfMatch = None
) -> DeletedOut:
    """Delete a dataset; 409 lists the datasets and jobs that were made from it."""
    return delete(session, "dataset", dataset_id, cascade, if_match)


@router.get("/datasets/{dataset_id}/signals")
def read_signals(
    dataset_id: str, session: ReadSession, parts: PartsDep, max_points: MaxPoints = 1000
) -> SignalsOut:
    """Read the samples, reduced so that extremes stay visible."""
    return datasets.read_signals(session, parts.store, dataset_id, max_points)


@router.get("/datasets/{dataset_id}/check")
def check_dataset(dataset_id: str, session: ReadSession, parts: PartsDep) -> DatasetCheckOut:
    """Check what happened to the recording, without a model: gaps, stamps, values, limits."""
    return datasets.check_dataset(session, parts.store, dataset_id)


@router.get("/datasets/{dataset_id}/lineage")
def read_lineage(dataset_id: str, session: ReadSession) -> LineageOut:
    """Read the lineage: the datasets it was derived from, and those derived from it."""
    return datasets.read_lineage(session, dataset_id)


@router.head("/datasets/{dataset_id}/content", include_in_schema=False)
@router.get("/datasets/{dataset_id}/content", response_class=McapResponse, responses=FILE_ANSWERS)
def read_content(
    dataset_id: str, request: Request, session: ReadSession, parts: PartsDep
) -> Response:
    """Download the recording as MCAP; ranges and ETags are honoured."""
    row = DatasetRepository(session).get(dataset_id)
    return content_response(request, parts.store, row.sha256, f"{row.id}.mcap")


@router.options("/datasets/{dataset_id}/content", include_in_schema=False)
def allow_cross_origin(dataset_id: str) -> Response:
    """Allow pages of other origins to read content."""
    return preflight_response()


@router.get("/datasets/{dataset_id}/content.csv", response_class=CsvResponse)
def read_content_csv(dataset_id: str, session: ReadSession, parts: PartsDep) -> CsvResponse:
    """Download the recording as CSV."""
    row = DatasetRepository(session).get(dataset_id)
    rows: Iterator[str] = generate_csv(load_recording(parts.store, row.sha256))
    headers = {**CROSS_ORIGIN, "Content-Disposition": f'attachment; filename="{row.id}.csv"'}
    return CsvResponse(rows, headers=headers)


def _dataset_response(
    stored: StoredDataset, response: Response, name: str | None = None
) -> DatasetOut:
    response.headers["Location"] = to_address(f"/v1/datasets/{stored.dataset.id}")
    if not stored.is_new:
        response.status_code = 200
    return datasets.to_stored_out(stored, name)
