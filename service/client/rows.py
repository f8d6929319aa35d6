"""Lists of answers, which become tables."""

from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

Item = TypeVar("Item")


class Rows(list[Item]):
    """A list of answers, such as the runs of a job."""

    def to_pandas(self) -> Any:
        """Return the list as a table of pandas, one row for each item.

        A nested field has a column with a dot, such as ``fit_percent.estimation``. The estimates of
        a run have the columns ``L``, ``L stderr`` and ``L status`` of the parameter L.

        Raises
        ------
        MissingLibrary
            If pandas is not installed.

        Examples
        --------
        >>> runs = Rows([{"number": 0, "cell": {"/seed": 1}, "parameters": []}])
        >>> list(runs.to_pandas().columns)
        ['number', 'cell./seed']
        """
        from sysid.core.lazy_names import load_library  # a client loads no library of its own

        pandas = load_library("pandas", "to_pandas()")
        return pandas.DataFrame([dict(_list_columns(item)) for item in self])


def _list_columns(item: Any) -> Iterator[tuple[str, Any]]:
    for name, value in item.items():
        if name == "parameters" and isinstance(value, list):
            yield from _list_estimates(value)
        elif isinstance(value, Mapping):
            yield from ((f"{name}.{inner}", entry) for inner, entry in value.items())
        else:
            yield name, value


def _list_estimates(estimates: list[Mapping[str, Any]]) -> Iterator[tuple[str, Any]]:
    for estimate in estimates:
        name = estimate["name"]
        yield name, estimate["value"]
        yield f"{name} stderr", estimate["stderr"]
        yield f"{name} status", estimate["status"]
