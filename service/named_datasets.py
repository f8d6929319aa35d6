"""Datasets by what requests call them: an identifier, or a name that only one has."""

from sqlalchemy.orm import Session

from service.storage.datasets import DatasetRepository
from service.storage.errors import NotFound
from service.storage.lookups import dataset_names, datasets_named
from service.storage.tables import Dataset
from sysid.core.errors import nearest


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
