"""Use cases of datasets: store an upload, derive, describe, and read samples and lineage.

Requests name a dataset by its identifier, or by a name that is unique.
"""

import hashlib
import json
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import DatasetNotFound, TooLarge
from service.core.process import temporary_files
from service.core.process.concurrency import ReaderPlaces
from service.core.settings import Settings
from service.datasets.dataset_schemas import (
    DatasetCheckOut,
    DatasetOut,
    DatasetPage,
    DeriveIn,
    JoinIn,
    LineageEdgeOut,
    LineageOut,
    SeriesOut,
    SignalsOut,
    TombstoneOut,
)
from service.datasets.large_derivation import derive
from service.datasets.stored_recordings import load_recording
from service.formats.file_kinds import SUFFIXES, detect_kind
from service.formats.mcap.mcap_files import write_recording
from service.formats.read_options import DEFAULT_OPTIONS, ReadOptions
from service.formats.sandbox import read_untrusted
from service.repositories.dataset_rows import DatasetRepository, NewDataset, StoredDataset
from service.repositories.lineage_rows import (
    LineageRepository,
    Relation,
    find_datasets_by_name,
    find_tombstones,
    list_dataset_names,
)
from service.repositories.project_rows import check_room
from service.repositories.search_conditions import NO_FILTER, ListFilter
from service.storage.objects import ObjectStore, StoredObject
from service.storage.sessions import Database, release_connection
from service.storage.storage_errors import ObjectDamaged, ObjectMissing, RowNotFound
from service.storage.tables import Dataset
from sysid.core.errors import suggest_name
from sysid.core.value_documents import encode
from sysid.data.outages import list_unseen
from sysid.data.records import Channel, Recording
from sysid.figures.decimate import decimate
from sysid.inspection.inspect import inspect_recording
from sysid.models.unit_checks import list_unknown_unit_warnings


def read_lineage(session: Session, dataset_id: str) -> LineageOut:
    """Read every edge on the paths to and from a dataset, from raw file to job."""
    row = DatasetRepository(session).get(dataset_id)
    repository = LineageRepository(session)
    edges = {*repository.list_ancestors(row.id), *repository.list_descendants(row.id)}
    identities = {name for edge in edges for name in (edge.child, edge.parent)}
    return LineageOut(
        id=row.id,
        edges=[LineageEdgeOut.from_source(edge) for edge in sorted(edges)],
        deleted=[
            TombstoneOut.from_source(one) for one in find_tombstones(session, sorted(identities))
        ],
    )


def resolve_dataset(session: Session, reference: str) -> Dataset | str:
    """Return the dataset of an identifier or name, or a message why there is none."""
    try:
        return DatasetRepository(session).get(reference)
    except RowNotFound:
        matches = find_datasets_by_name(session, reference)
    if len(matches) == 1:
        return matches[0]
    if matches:
        ids = ", ".join(dataset.id for dataset in matches)
        return f"{len(matches)} datasets are named {reference!r}; use one of the ids {ids}"
    hint = suggest_name(reference, set(list_dataset_names(session)))
    if "/" in reference or reference.endswith(SUFFIXES):
        hint = "; file paths are not read here: add the file first with `lagid dataset add`"
    return f"there is no dataset {reference!r}{hint}"


DatasetKind = Literal["upload", "simulate", "derive"]


def find_existing(session: Session, store: ObjectStore, key: str) -> Dataset | None:
    """Find the dataset of a source; None if its object is missing or damaged: then it is healed."""
    existing = DatasetRepository(session).find_by_source(key)
    if existing is not None:
        release_connection(session)
        try:
            store.check_object(existing.sha256)
        except (ObjectMissing, ObjectDamaged):
            return None
    return existing


def _heal_object(database: Database, store: ObjectStore, path: Path, sha256: str) -> None:
    """Store a file as it is if a dataset has it as its object, which is perhaps damaged."""
    with database.read_session() as session:
        is_object = DatasetRepository(session).has_object(sha256)
    if is_object:
        store.put_file(path)


def add_upload(
    database: Database,
    store: ObjectStore,
    path: Path,
    *,
    sha256: str,
    suffix: str = "",
    name: str | None = None,
    options: ReadOptions = DEFAULT_OPTIONS,
) -> StoredDataset:
    """Store an uploaded file, or return the existing dataset of the same bytes.

    Parameters
    ----------
    suffix : str
        Suffix of the name that the user gave the file.

    Raises
    ------
    UnreadableFile
        If the file cannot be used, with the position of the fault.
    """
    read_as = {"sha256": sha256, "format": detect_kind(path, suffix), **options.list_given()}
    key = hash_source(read_as)
    _heal_object(database, store, path, sha256)
    with database.read_session() as session:
        existing = find_existing(session, store, key)
    if existing is not None:
        return StoredDataset(existing, is_new=False)
    # Reading takes time. An open transaction would block all others on SQLite.
    read = read_untrusted(path, options, suffix=suffix)
    details = {"source": read_as, "warnings": list(read.notes)}
    return add_recording(
        database,
        store,
        read.recording,
        name=name or "recording",
        kind="upload",
        key=key,
        details=details,
    )


def derive_dataset(
    database: Database, store: ObjectStore, readers: ReaderPlaces, parent_id: str, body: DeriveIn
) -> StoredDataset:
    """Derive a dataset from another by steps; the same steps again return the same dataset.

    Raises
    ------
    DatasetNotFound
        If no dataset has that identifier or name, or several share the name.
    InvalidRecord, InvalidSettings, InvalidRequest
        If a step is not possible, or needs too much memory or time.
    ServiceBusy
        If it is long, and no place became free in time.
    """
    with database.read_session() as session:
        parent = _find_parent(session, parent_id)
        existing = find_existing(session, store, _hash_derivation(parent, body))
    if existing is not None:
        return StoredDataset(existing, is_new=False)
    project = database.owner.project_id
    recording, subtracted = derive(store, parent, body.steps, readers, project)
    steps = ", ".join(next(iter(step), "?") for step in body.steps)
    return add_recording(
        database,
        store,
        recording,
        name=body.name or f"{parent.name} ({steps})",
        kind="derive",
        key=_hash_derivation(parent, body),
        details={
            "steps": body.steps,
            "subtracted": subtracted,
            "warnings": [],
            "known_before": _measure_history(recording),
        },
        parents=[parent.id],
    )


def join_datasets(database: Database, store: ObjectStore, body: JoinIn) -> StoredDataset:
    """Join recordings on one clock; the same ones again return the same dataset.

    Raises
    ------
    DatasetNotFound
        If no dataset has that identifier or name, or several share the name.
    InvalidRecord
        If they cannot be joined.
    """
    from sysid.data.joining import join_recordings

    with database.read_session() as session:
        parents = [_find_parent(session, name) for name in body.datasets]
        key = hash_source({"join": [parent.id for parent in parents]})
        existing = find_existing(session, store, key)
    if existing is not None:
        return StoredDataset(existing, is_new=False)
    shared = Counter(parent.name for parent in parents)
    names = [one.name if shared[one.name] == 1 else one.id for one in parents]
    recordings = [load_recording(store, parent.sha256) for parent in parents]
    recording, notes = join_recordings(dict(zip(names, recordings, strict=True)))
    return add_recording(
        database,
        store,
        recording,
        name=body.name or " + ".join(names)[:200],
        kind="derive",
        key=key,
        details={"steps": [{"join": [parent.id for parent in parents]}], "warnings": list(notes)},
        parents=[parent.id for parent in parents],
    )


def _find_parent(session: Session, name: str) -> Dataset:
    parent = resolve_dataset(session, name)
    if isinstance(parent, str):
        raise DatasetNotFound(parent)
    return parent


def add_recording(
    database: Database,
    store: ObjectStore,
    recording: Recording,
    *,
    name: str,
    kind: DatasetKind,
    key: str,
    details: Mapping[str, Any],
    parents: Sequence[str] = (),
    relation: Relation = "derived",
) -> StoredDataset:
    """Store a recording: first its object, then the row that refers to it.

    If there is a row of the same source, its object is written once more, and so healed.
    """
    with database.read_session() as session:
        existing = DatasetRepository(session).find_by_source(key)
    name = name if existing is None else existing.name  # which the file holds too
    # The source of an upload is its file; that of others follows from parents and request.
    file = (details.get("source") or {}).get("sha256", "") if kind == "upload" else ""
    metadata = {"source": file, "source_key": key, "parents": " ".join(parents), "name": name}
    content = _store_file(database, store, recording, metadata, is_new=existing is None)
    new = describe_recording(
        recording, name=name, kind=kind, key=key, details=details, content=content
    )
    with database.write_session() as session:
        return DatasetRepository(session).add(new, parents=parents, relation=relation)


def describe_recording(
    recording: Recording,
    *,
    name: str,
    kind: DatasetKind,
    key: str,
    details: Mapping[str, Any],
    content: StoredObject,
) -> NewDataset:
    """Build the description of a recording for its row."""
    start = recording.started_at
    return NewDataset(
        name=name,
        kind=kind,
        sha256=content.sha256,
        source_key=key,
        size_bytes=content.size,
        n_samples=recording.samples,
        duration=recording.duration,
        sample_time=_find_common_period(recording) if recording.sampling.is_regular else None,
        channels=[_describe_channel(channel) for channel in recording.channels],
        details={
            **details,
            "started_at": None if start is None else start.isoformat(),
            "warnings": [*details["warnings"], *list_unknown_unit_warnings(recording.channels)],
            "outages": list_unseen(recording),
            "segments": [
                {"start": s.start, "stop": s.stop, "origin": s.origin, "labels": dict(s.labels)}
                for s in recording.segments
            ],
        },
    )


def to_out(row: Dataset) -> DatasetOut:
    """Convert a dataset to its response."""
    details = dict(row.details)
    return DatasetOut.from_source(
        row,
        samples=row.n_samples,
        segments=details.pop("segments"),
        started_at=details.pop("started_at"),
        warnings=details.pop("warnings"),
        tags=row.tags or [],
        details=details,
    )


def to_stored_out(stored: StoredDataset, name: str | None) -> DatasetOut:
    """Convert a stored dataset to its response; warn if it exists under another name."""
    response, row = to_out(stored.dataset), stored.dataset
    if stored.is_new:
        return response
    if name in (None, row.name):
        return response
    warning = f"the same data are already stored as {row.name!r}; that name stays"
    return response.model_copy(update={"warnings": [*response.warnings, warning]})


def _measure_history(recording: Recording) -> float:
    """Return the length (s) of the history before the start of the recording."""
    return recording.start - min(
        float(channel.history_and_samples.times[0]) for channel in recording.channels
    )


def list_datasets(
    session: Session, cursor: str | None, limit: int, chosen: ListFilter = NO_FILTER
) -> DatasetPage:
    """List the datasets that meet a filter, latest first."""
    page = DatasetRepository(session).list_page(cursor=cursor, limit=limit, chosen=chosen)
    return DatasetPage(items=[to_out(row) for row in page.items], next=page.next)


def read_signals(
    session: Session, store: ObjectStore, dataset_id: str, max_points: int
) -> SignalsOut:
    """Read the channels of a dataset, reduced so that extremes stay visible."""
    row = DatasetRepository(session).get(dataset_id)
    channels = load_recording(store, row.sha256).channels
    histories = [Channel(c.name, *c.history, c.unit) for c in channels if c.history is not None]
    return SignalsOut(
        id=row.id,
        channels=[to_series(channel, max_points) for channel in channels],
        history=[to_series(channel, max_points) for channel in histories],
    )


def check_dataset(session: Session, store: ObjectStore, dataset_id: str) -> DatasetCheckOut:
    """Check what happened to the recording of a dataset."""
    row = DatasetRepository(session).get(dataset_id)
    findings = inspect_recording(load_recording(store, row.sha256))
    return DatasetCheckOut(id=row.id, findings=[encode(one) for one in findings])


def to_series(channel: Channel, max_points: int) -> SeriesOut:
    """Convert a channel to one line of a plot."""
    times, values = decimate(channel.times, channel.values, max_points)
    return SeriesOut(
        name=channel.name,
        unit=channel.unit,
        times=times.tolist(),
        values=[value if np.isfinite(value) else None for value in values.tolist()],
        samples=channel.times.size,
    )


def hash_source(source: Mapping[str, Any]) -> str:
    """Return the hash of the source of a dataset."""
    return hashlib.sha256(json.dumps(source, sort_keys=True).encode()).hexdigest()


def check_upload_size(size: int, settings: Settings) -> None:
    """Refuse an upload that exceeds the limit.

    Raises
    ------
    TooLarge
        If the upload is larger than the limit.
    """
    if size > settings.max_upload_bytes:
        raise TooLarge(
            f"the upload has {size} bytes or more; at most {settings.max_upload_bytes} "
            "are allowed (LAGID_MAX_UPLOAD_BYTES)"
        )


def _hash_derivation(parent: Dataset, body: DeriveIn) -> str:
    return hash_source({"parent": parent.id, "steps": body.steps})


def _store_file(
    database: Database,
    store: ObjectStore,
    recording: Recording,
    metadata: Mapping[str, str],
    *,
    is_new: bool,
) -> StoredObject:
    with tempfile.TemporaryDirectory(prefix=temporary_files.make_temporary_prefix()) as folder:
        path = Path(folder) / "recording.mcap"
        write_recording(recording, path, metadata=metadata)
        if is_new:  # what is refused leaves no object behind
            with database.read_session() as session:
                check_room(session, path.stat().st_size)
        return store.put_file(path)


def _describe_channel(channel: Channel) -> dict[str, Any]:
    sampling, history = channel.sampling, channel.history
    return {
        "name": channel.name,
        "unit": channel.unit,
        "hold": channel.hold,
        "samples": channel.times.size,
        "start": float(channel.times[0]),
        "stop": float(channel.times[-1]),
        "sample_time": sampling.period if sampling.is_regular else None,
        "missing": int(np.count_nonzero(~np.isfinite(channel.values))),
        "history_samples": 0 if history is None else history.times.size,
        "history_start": None if history is None else float(history.times[0]),
    }


def _find_common_period(recording: Recording) -> float | None:
    samplings = [channel.sampling for channel in recording.channels]
    if not all(sampling.is_regular for sampling in samplings):
        return None
    first = samplings[0].period
    return first if all(abs(p.period - first) <= 1e-6 * first for p in samplings) else None
