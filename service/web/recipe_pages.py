"""The pages on which a noise sweep and a batch re-identification are submitted."""

from collections.abc import Sequence
from typing import get_args

from sqlalchemy.orm import Session

from service import models
from service.schemas_models import ModelOut
from service.schemas_noise import Method, NoiseSweepIn
from service.storage.datasets import DatasetRepository
from service.storage.references import ReferenceRepository
from service.storage.tables import Dataset
from service.web.rendering import render

LISTED = 200


def noise_sweep_page(session: Session) -> str:
    """The form of a noise sweep."""
    chosen = NoiseSweepIn.model_fields["methods"].default
    methods = [(one, one in chosen) for one in get_args(Method)]
    return render(
        "noise_sweep.html", models=_models(session), datasets=_datasets(session), methods=methods
    )


def reidentify_page(session: Session) -> str:
    """The form of a batch re-identification."""
    return render(
        "reidentify.html", models=_models(session), datasets=_datasets(session),
        references=ReferenceRepository(session).names(),
    )  # fmt: skip


def _models(session: Session) -> Sequence[ModelOut]:
    """Every model once, under the name that means its latest version."""
    found = models.page(session, None, LISTED).items
    return list({one.name: one for one in reversed(found)}.values())[::-1]


def _datasets(session: Session) -> Sequence[Dataset]:
    return DatasetRepository(session).page(limit=LISTED).items
