"""Save a result as JSON and read it again, with every number the same.

The document has the fields of the result, by their names, as `sysid.core.value_documents` writes
them exactly. A model is its document.
"""

import json
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

from sysid.core.errors import InvalidModel, InvalidRecord, UnreadableResult, UnwritableFile
from sysid.core.files import write_whole
from sysid.core.value_documents import Misfit, decode_exactly, encode_exactly
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.results.result import FullResult

SavedResult = TypeVar("SavedResult", bound=FullResult)

FORMAT = "lagid-identification/2"
_OTHER_FORMATS = {
    "lagid-model/1": "it is an exported model; read it with load_identified",
    "lagid-identification/1": "a build before 0.1.0 saved it; identify and save anew",
}


def write_result(result: FullResult, path: str | PathLike[str]) -> None:
    """Write a result to a JSON file.

    Raises
    ------
    UnwritableFile
        If the file cannot be written; what was there before is whole.
    """
    document = {"format": FORMAT, **_encode(result)}
    text = json.dumps(document, ensure_ascii=False, allow_nan=False) + "\n"
    try:
        write_whole(Path(path), text)
    except OSError as error:
        raise UnwritableFile(path, error.strerror or str(error)) from None


def read_result(path: str | PathLike[str], kind: type[SavedResult]) -> SavedResult:
    """Read a result of a class from a file that `write_result` wrote.

    Raises
    ------
    UnreadableResult
        If the file cannot be read, or is something else; the message names the field.
    """
    document = read_json(path)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise UnreadableResult(path, _describe_other_document(document))
    fields = {name: value for name, value in document.items() if name != "format"}
    try:
        return decode_exactly(kind, fields, {Model: parse_model})
    except (Misfit, InvalidModel, InvalidRecord) as error:
        raise UnreadableResult(path, str(error)) from None


def have_same_content(first: FullResult, second: FullResult) -> bool:
    """Test whether two results would be saved as the same document."""
    return bool(_encode(first) == _encode(second))


def read_json(path: str | PathLike[str]) -> Any:
    """Read a JSON file.

    Raises
    ------
    UnreadableResult
        If it cannot be read, or is not JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise UnreadableResult(path, f"it cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise UnreadableResult(path, f"it is not JSON: {error}") from None


def _describe_other_document(document: Any) -> str:
    if not isinstance(document, dict):
        return f"found no object; need a document of format {FORMAT!r}"
    name = document.get("format")
    if name is None and "parameters" in document and "fit_percent" in document:
        return "it is the document of a run, which has no signals. Save the result itself"
    hint = _OTHER_FORMATS.get(str(name), f"need {FORMAT!r}, which Identification.save writes")
    return f"its format is {name!r}; {hint}"


def _encode(result: FullResult) -> Any:
    return encode_exactly(result, {Model: lambda model: dict(model.document)})
