"""Use cases of datasets: store an upload, derive, tell, and read the samples back.

Datasets by what requests call them: an identifier, or a name that only one has.

Use case of lineage: what a dataset was made from, and what was made from it.
"""

import hashlib
import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from sqlalchemy.orm import Session

from service.core import temporary_files as temporary
from service.core.errors import NoSuchDataset, TooLarge
from service.core.settings import Settings
from service.core.wire import Page
from service.datasets.recordings import recording_of
from service.datasets.schemas import (
    DatasetOut,
    DeriveIn,
    Edge,
    LineageOut,
    Series,
    SignalsOut,
)
from service.formats.decimate import decimate
from service.formats.mcap import write_recording
from service.formats.sandbox import read_untrusted
from service.repositories.datasets import DatasetRepository, NewDataset, Stored
from service.repositories.lineage import LineageRepository, Relation, dataset_names, datasets_named
from service.storage.errors import NotFound
from service.storage.objects import ObjectStore, StoredObject
from service.storage.sessions import Database
from service.storage.tables import Dataset
from sysid.core.errors import nearest
from sysid.data.records import Channel, Recording
from sysid.models.units import unknown_units


def of_dataset(session: Session, dataset_id: str) -> LineageOut:
    """Every edge on the ways to and from a dataset, from raw file to job."""
    row = DatasetRepository(session).get(dataset_id)
    repository = LineageRepository(session)
    edges = {*repository.ancestors(row.id), *repository.descendants(row.id)}
    return LineageOut(id=row.id, edges=[Edge.from_source(edge) for edge in sorted(edges)])


def dataset_of(session: Session, reference: str) -> Dataset | str:
    """The dataset of that identifier or name, or why there is none."""
    try:
        return DatasetRepository(session).get(reference)
    except NotFound:
        named = datasets_named(session, reference)
    if len(named) == 1:
        return named[0]
    if named:
        ids = ", ".join(one.id for one in named)
        return f"{len(named)} datasets are named {reference!r}; give one of the ids {ids}"
    hint = nearest(reference, set(dataset_names(session)))
    if "/" in reference or reference.endswith((".csv", ".mcap")):
        hint = "; a path of a file is not read here, add the file first: `lagid dataset add`"
    return f"there is no dataset {reference!r}{hint}"


Kind = Literal["upload", "simulate", "derive"]
Format = Literal["csv", "mcap"]


def add_upload(
    database: Database,
    store: ObjectStore,
    path: Path,
    form: Format,
    *,
    sha256: str,
    name: str | None = None,
    segments: Sequence[str] = (),
    sample_time: float | None = None,
) -> Stored:
    """Store an uploaded file, or give the dataset that the same bytes made before.

    Raises
    ------
    InvalidUpload
        If the file cannot be used, with the place.
    """
    read_as = {"sha256": sha256, "format": form, "segments": list(segments),
               "sample_time": sample_time}  # fmt: skip
    key = key_of(read_as)
    with database.read() as session:
        known = DatasetRepository(session).by_source(key)
    if known is not None:
        return Stored(known, is_new=False)
    # Reading takes time: no transaction is open meanwhile, which on SQLite would hold up all.
    read = read_untrusted(path, form, segments=segments, sample_time=sample_time)
    details = {"source": read_as, "warnings": list(read.notes)}
    return add_recording(
        database, store, read.recording, name=name or "recording", kind="upload", key=key,
        details=details,
    )  # fmt: skip


def derive(database: Database, store: ObjectStore, parent_id: str, body: DeriveIn) -> Stored:
    """Make a dataset from another by steps; the same steps again give the same dataset.

    Raises
    ------
    NoSuchDataset
        If none has that identifier or name, or several have the name.
    InvalidRecord, InvalidSettings
        If a step cannot be done.
    """
    with database.read() as session:
        parent = dataset_of(session, parent_id)
        if isinstance(parent, str):
            raise NoSuchDataset(parent)
        known = DatasetRepository(session).by_source(_derivation_key(parent, body))
    if known is not None:
        return Stored(known, is_new=False)
    from sysid.data.derivations import derive as derived  # brings SciPy's signal processing

    recording = derived(recording_of(store, parent.sha256), body.steps)
    steps = ", ".join(next(iter(step), "?") for step in body.steps)
    return add_recording(
        database, store, recording, name=body.name or f"{parent.name} ({steps})", kind="derive",
        key=_derivation_key(parent, body),
        details={"steps": body.steps, "warnings": [], "known_before": _known_before(recording)},
        parents=[parent.id],
    )  # fmt: skip


def add_recording(
    database: Database,
    store: ObjectStore,
    recording: Recording,
    *,
    name: str,
    kind: Kind,
    key: str,
    details: Mapping[str, Any],
    parents: Sequence[str] = (),
    relation: Relation = "derived",
) -> Stored:
    """Store a recording: its object first, then the row that names it."""
    metadata = {"source": key, "parents": " ".join(parents), "name": name}
    content = _written(store, recording, metadata)
    new = described(recording, name=name, kind=kind, key=key, details=details, content=content)
    with database.write() as session:
        return DatasetRepository(session).add(new, parents=parents, relation=relation)


def described(
    recording: Recording, *, name: str, kind: Kind, key: str, details: Mapping[str, Any],
    content: StoredObject,
) -> NewDataset:  # fmt: skip
    """What the row of a recording says."""
    return NewDataset(
        name=name, kind=kind, sha256=content.sha256, source_key=key, size_bytes=content.size,
        n_samples=recording.samples, duration=recording.duration,
        sample_time=_common_period(recording) if recording.sampling.is_regular else None,
        channels=[_summary(channel) for channel in recording.channels],
        details={
            **details,
            "warnings": [*details["warnings"], *unknown_units(recording.channels)],
            "segments": [
                {"start": s.start, "stop": s.stop, "origin": s.origin, "labels": dict(s.labels)}
                for s in recording.segments
            ],
        },
    )  # fmt: skip


def told(row: Dataset) -> DatasetOut:
    """A dataset as it is told."""
    details = dict(row.details)
    return DatasetOut.from_source(
        row,
        samples=row.n_samples,
        segments=details.pop("segments"),
        warnings=details.pop("warnings"),
        details=details,
    )


def told_again(stored: Stored, name: str | None) -> DatasetOut:
    """A dataset that was just sent; warned of if it is there already under another name."""
    answer, row = told(stored.dataset), stored.dataset
    if stored.is_new:
        return answer
    if name in (None, row.name):
        return answer
    warning = f"the same data were stored before, as {row.name!r}; that name stays"
    return answer.model_copy(update={"warnings": [*answer.warnings, warning]})


def _known_before(recording: Recording) -> float:
    """For how long (s) before the start something is known."""
    return recording.start - min(float(one.whole.times[0]) for one in recording.channels)


def page(session: Session, cursor: str | None, limit: int) -> Page[DatasetOut]:
    """Datasets, latest first."""
    found = DatasetRepository(session).page(cursor=cursor, limit=limit)
    return Page(items=[told(row) for row in found.items], next=found.next)


def signals(session: Session, store: ObjectStore, dataset_id: str, max_points: int) -> SignalsOut:
    """Channels of a dataset, reduced so that extremes stay visible."""
    row = DatasetRepository(session).get(dataset_id)
    channels = recording_of(store, row.sha256).channels
    before = [Channel(c.name, *c.history, c.unit) for c in channels if c.history is not None]
    return SignalsOut(
        id=row.id,
        channels=[series(channel, max_points) for channel in channels],
        history=[series(channel, max_points) for channel in before],
    )


def series(channel: Channel, max_points: int) -> Series:
    """A channel as one line of a plot."""
    times, values = decimate(channel.times, channel.values, max_points)
    return Series(
        name=channel.name,
        unit=channel.unit,
        times=times.tolist(),
        values=[value if np.isfinite(value) else None for value in values.tolist()],
        samples=channel.times.size,
    )


def key_of(source: Mapping[str, Any]) -> str:
    """Hash of what a dataset is made from."""
    return hashlib.sha256(json.dumps(source, sort_keys=True).encode()).hexdigest()


def check_size(size: int, settings: Settings) -> None:
    """Refuse a body that is larger than the limit.

    Raises
    ------
    TooLarge
    """
    if size > settings.max_upload_bytes:
        raise TooLarge(
            f"the upload has {size} bytes or more; at most {settings.max_upload_bytes} "
            "(LAGID_MAX_UPLOAD_BYTES)"
        )


def _derivation_key(parent: Dataset, body: DeriveIn) -> str:
    return key_of({"parent": parent.id, "steps": body.steps})


def _written(store: ObjectStore, recording: Recording, metadata: Mapping[str, str]) -> StoredObject:
    with tempfile.TemporaryDirectory(prefix=temporary.prefix()) as folder:
        path = Path(folder) / "recording.mcap"
        write_recording(recording, path, metadata=metadata)
        return store.put_file(path)


def _summary(channel: Channel) -> dict[str, Any]:
    sampling, history = channel.sampling, channel.history
    return {
        "name": channel.name, "unit": channel.unit, "hold": channel.hold,
        "samples": channel.times.size, "start": float(channel.times[0]),
        "stop": float(channel.times[-1]),
        "sample_time": sampling.period if sampling.is_regular else None,
        "missing": int(np.count_nonzero(~np.isfinite(channel.values))),
        "history_samples": 0 if history is None else history.times.size,
        "history_start": None if history is None else float(history.times[0]),
    }  # fmt: skip


def _common_period(recording: Recording) -> float | None:
    periods = [channel.sampling for channel in recording.channels]
    if not all(one.is_regular for one in periods):
        return None
    first = periods[0].period
    return first if all(abs(p.period - first) <= 1e-6 * first for p in periods) else None
