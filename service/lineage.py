"""Use case of lineage: what a dataset was made from, and what was made from it."""

from sqlalchemy.orm import Session

from service.schemas_datasets import Edge, LineageOut
from service.storage.datasets import DatasetRepository
from service.storage.lineage import LineageRepository


def of_dataset(session: Session, dataset_id: str) -> LineageOut:
    """Every edge on the ways to and from a dataset, from raw file to job."""
    row = DatasetRepository(session).get(dataset_id)
    repository = LineageRepository(session)
    edges = {*repository.ancestors(row.id), *repository.descendants(row.id)}
    told = [Edge(parent=e.parent, child=e.child, relation=e.relation) for e in sorted(edges)]
    return LineageOut(id=row.id, edges=told)
