"""Catalogue of built-in models; loading of models by name, document or file."""

from collections.abc import Mapping
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

from sysid.core.errors import Fault, InvalidModel, UnknownModel
from sysid.models.document_reader import MAX_DOCUMENT_CHARACTERS, parse_yaml
from sysid.models.model import Model
from sysid.models.parse import parse_model

MODEL_SUFFIXES = (".yaml", ".yml", ".json")
_LISTED_SUFFIXES = ", ".join(MODEL_SUFFIXES)
_CATALOGUE_FOLDER = Path(__file__).parent


@cache
def catalogue() -> tuple[str, ...]:
    """List the names of the built-in models, in alphabetical order.

    Examples
    --------
    >>> "fopdt" in catalogue()
    True
    """
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

    Examples
    --------
    >>> [parameter.name for parameter in load_model("fopdt").parameters]
    ['K', 'T', 'L', 'y0']
    """
    if isinstance(source, Path):
        return parse_model(read_document(source))
    if isinstance(source, str):
        return _load_catalogue_model(source)
    return parse_model(source)


ModelSource: TypeAlias = Model | str | Path | Mapping[str, Any]
"""A model, its name in the catalogue, its file, or its document."""


def resolve_model(source: ModelSource) -> Model:
    """Load a model as `load_model` does, and also from a text that names a file.

    A text that ends in ``.yaml``, ``.yml`` or ``.json`` is a file. It must come from the user of
    this process, not from a request.

    Raises
    ------
    UnknownModel
        If the catalogue has no such name.
    InvalidModel
        If the file or the document has faults, or the object is nothing of these.
    """
    if isinstance(source, Model):
        return source
    given: object = source
    if not isinstance(given, str | Path | Mapping):
        kind = type(given).__name__
        raise InvalidModel(
            [
                Fault(
                    "",
                    f"found an object of type {kind}; need a model, a name, a file or a document",
                )
            ]
        )
    is_file = isinstance(source, str) and source.lower().endswith(MODEL_SUFFIXES)
    if isinstance(source, str) and not is_file and source not in catalogue():
        _refuse_other_path(Path(source))
    return load_model(Path(source) if is_file else source)  # type: ignore[arg-type]


def _refuse_other_path(path: Path) -> None:
    """Refuse a folder, or a file that is no model, such as a recording."""
    if path.is_dir():
        found = "is a folder"
    elif path.is_file():
        found = f"is no model file; it may be a recording. Model files end in {_LISTED_SUFFIXES}"
    else:
        return
    raise InvalidModel([Fault("", f"{path} {found}. Need a built-in model or a model file")])


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
        document = parse_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidModel([Fault("", f"{path} cannot be read: {error.strerror}")]) from None
    except UnicodeDecodeError as error:
        detail = f"{path} is not UTF-8 text: byte {error.start} does not fit"
        raise InvalidModel([Fault("", detail)]) from None
    if document is None:
        raise InvalidModel([Fault("", f"{path} is empty; need the document of a model")])
    return document


@cache
def _load_catalogue_model(name: str) -> Model:
    return parse_model(_load_catalogue_document(name))


@cache
def _load_catalogue_document(name: str) -> dict[str, Any]:
    if name not in catalogue():
        raise UnknownModel(name, catalogue())
    document: dict[str, Any] = read_document(_CATALOGUE_FOLDER / f"{name}.yaml")
    return document
