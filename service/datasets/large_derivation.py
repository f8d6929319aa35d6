"""Derivations of recordings: short ones here, long ones in a child process with limits."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from service.core.errors import FieldError, InvalidRequest
from service.core.process import temporary_files
from service.core.process.concurrency import ReaderPlaces
from service.datasets.data_child import ask_child
from service.datasets.stored_recordings import load_recording
from service.formats.limits import DEFAULT_LIMITS
from service.formats.mcap.mcap_files import read_mcap
from service.storage.objects import ObjectStore
from service.storage.tables import Dataset
from sysid.data.records import Recording

LARGE_VALUES = 2_000_000
"""Values of all channels beyond which a child derives: some 200 MB, most for means of periods."""


def derive(
    store: ObjectStore,
    parent: Dataset,
    steps: Sequence[Mapping[str, Any]],
    readers: ReaderPlaces,
    project: str,
) -> tuple[Recording, list[dict[str, Any]]]:
    """Apply steps to a stored recording; also return the trends that were subtracted.

    Raises
    ------
    InvalidSettings, InvalidRecord, InvalidRequest
        If a step is not possible, or needs more memory or time than a child has.
    ServiceBusy
        If no place became free in time.
    """
    samples = count_samples(parent, steps)
    if samples > DEFAULT_LIMITS.messages:
        raise InvalidRequest.from_fault(
            "/steps",
            f"the recording would have {samples:.3g} samples; "
            f"at most {DEFAULT_LIMITS.messages} are stored",
        )
    if samples * parent.n_channels <= LARGE_VALUES:
        from sysid.data.derivations import apply_steps  # brings SciPy's signal processing

        recording, subtracted = apply_steps(load_recording(store, parent.sha256), steps)
        return recording, [trend._asdict() for trend in subtracted]
    with (
        readers.places.hold(project),
        TemporaryDirectory(prefix=temporary_files.make_temporary_prefix()) as folder,
    ):
        source, target = Path(folder) / "source.mcap", Path(folder) / "target.mcap"
        with source.open("wb") as file:
            file.writelines(store.get_stream(parent.sha256))
        task = {"source": str(source), "target": str(target), "steps": list(steps)}
        subtracted = ask_child(
            "service.datasets.derivation_child", task, readers.memory_bytes, _refuse
        )
        return read_mcap(target), subtracted


def count_samples(parent: Dataset, steps: Sequence[Mapping[str, Any]]) -> float:
    """Count the samples of a recording, or of the largest that its steps may make of it."""
    samples = float(parent.n_samples)
    for step in steps:
        arguments = step.get("resample") if isinstance(step, Mapping) else None
        period = arguments.get("sample_time") if isinstance(arguments, Mapping) else None
        if isinstance(period, int | float) and period > 0:
            samples = max(samples, parent.duration / period)
    return samples


def _refuse(limit: str) -> FieldError:
    return FieldError(
        "/steps", f"the derivation needs more than {limit}; derive fewer samples or channels"
    )
