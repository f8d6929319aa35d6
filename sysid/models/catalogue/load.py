"""Catalogue of built-in models; loading of models by name, document or file."""

from collections.abc import Mapping
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

from sysid.core.errors import Fault, InvalidModel, UnknownModel
from sysid.models.documents import MAX_DOCUMENT_CHARACTERS, parse_yaml
from sysid.models.model import Model
from sysid.models.parse import parse_model

_CATALOGUE_FOLDER = Path(__file__).parent


@cache
def catalogue() -> tuple[str, ...]:
    """List the names of the built-in models, in alphabetical order."""
    return tuple(sorted(path.stem for path in _CATALOGUE_FOLDER.glob("*.yaml")))


def copy_catalogue_document(name: str) -> dict[str, Any]:
    """Return a copy of a built-in model's document.

    Raises
    ------
    UnknownModel
        If there is none; the message suggests the nearest name.
    """
    return deepcopy(_load_catalogue_document(name))


def load_model(source: str | Mapping[str, Any] | Path) -> Model:
    """Load a model: by its name in the catalogue, from a document, or from a YAML or JSON file.

    A text is always a name. Only a `Path` reads a file, so that a name from a network request
    cannot open one.

    Raises
    ------
    UnknownModel
        If the catalogue has no such name.
    InvalidModel
        If the file or the document has faults.
    """
    if isinstance(source, Path):
        return parse_model(read_document(source))
    if isinstance(source, str):
        return _load_catalogue_model(source)
    return parse_model(source)


def read_document(path: Path) -> Any:
    """Read the data of a YAML or JSON file.

    Raises
    ------
    InvalidModel
        If the file cannot be read as such.
    """
    try:
        if path.stat().st_size > 4 * MAX_DOCUMENT_CHARACTERS:
            raise InvalidModel(
                [Fault("", f"{path} is larger than {4 * MAX_DOCUMENT_CHARACTERS} bytes")]
            )
        return parse_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidModel([Fault("", f"{path} cannot be read: {error.strerror}")]) from None
    except UnicodeDecodeError as error:
        detail = f"{path} is not UTF-8 text: byte {error.start} does not fit"
        raise InvalidModel([Fault("", detail)]) from None


@cache
def _load_catalogue_model(name: str) -> Model:
    return parse_model(_load_catalogue_document(name))


@cache
def _load_catalogue_document(name: str) -> dict[str, Any]:
    if name not in catalogue():
        raise UnknownModel(name, catalogue())
    document: dict[str, Any] = read_document(_CATALOGUE_FOLDER / f"{name}.yaml")
    return document
