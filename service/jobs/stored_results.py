"""Result documents: written from a result, and read back."""

from collections.abc import Mapping
from typing import Any

from sysid.core.value_documents import decode, encode, list_fields
from sysid.results.result import FullResult, Result

_NAMES = tuple(field.name for field in list_fields(Result))


def write_result_document(result: FullResult, seconds: float) -> dict[str, Any]:
    """Write the document of a result that took some time to compute (s)."""
    return {**encode(result, Result), "seconds": seconds}


def read_result_document(document: Mapping[str, Any]) -> Result:
    """Read a result from its document, which may say more of the run.

    Raises
    ------
    Misfit
        If the document is not one of a result.
    """
    return decode(Result, {name: document[name] for name in _NAMES if name in document})
