"""MATLAB files: arrays, nested structures, tables, timetables and `iddata`.

SciPy reads versions 4 to 7. Files of version 7.3, which are HDF5, and objects are read by `mat-io`,
which is loaded for them alone. A content becomes a tree of mappings, arrays and texts. A record is
a branch of it with signals; signals that share the times of a branch above belong to one record.
"""

import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.formats.file_kinds import is_hdf5
from service.formats.read_options import ReadOptions
from service.formats.tabular.column_files import (
    DAMAGES,
    PERIOD_NAMES,
    RATE_NAMES,
    build_array_table,
    build_damage_error,
    is_signal,
)
from service.formats.tabular.table_columns import Table
from sysid.core.errors import UnreadableFile
from sysid.data.table_rules import find_unit_seconds, is_temperature_name, is_time_name

_CLASS: Final = "__class__"
_MAX_NESTING: Final = 8
_MAX_LISTED: Final = 8
_NO_LIBRARY: Final = (
    "MATLAB 7.3 files and objects need mat-io, not installed here: pip install 'lagid[matlab]'. "
    "Or save arrays in MATLAB: save('file.mat', 't', 'u', 'y', '-v7')"
)

Tree = Mapping[str, Any]


class _Branch(NamedTuple):
    """A record in a tree: its path, its arrays and scalars by name, and whether it has times."""

    path: str
    fields: dict[str, Any]
    has_times: bool


def read_matlab(path: Path, options: ReadOptions, notes: list[str]) -> Table:
    """Read the record of a MATLAB file.

    Raises
    ------
    UnreadableFile
        If the file is damaged, holds no record or several, or needs a library that is missing.
    """
    tree = _read_tree(path)
    branches = _find_branches(tree, "", notes, _MAX_NESTING)
    if len(branches) != 1:
        names = [branch.path for branch in branches] or list(tree) or ["nothing"]
        listed = ", ".join(names[:_MAX_LISTED]) + (", …" if len(names) > _MAX_LISTED else "")
        raise UnreadableFile(
            f"the file holds {listed}; need arrays such as t, u and y, or one structure with them. "
            "In MATLAB: save('file.mat', '-struct', 'name') for one of them"
        )
    (branch,) = branches
    if branch.path:
        notes.append(f"the fields of {branch.path!r} were read")
    return build_array_table(branch.fields, options, notes)


def _read_tree(path: Path) -> Tree:
    """Read the content of a file as a tree."""
    from scipy.io import loadmat, matlab

    if is_hdf5(path):
        return _read_objects(path)
    try:
        content = loadmat(path, simplify_cells=True)
    except (matlab.MatReadError, *DAMAGES) as error:
        raise build_damage_error("MATLAB", error) from None
    kinds = (matlab.MatlabOpaque, matlab.MatlabFunction)
    if any(isinstance(value, kinds) for value in content.values()):
        return _read_objects(path)
    return {str(name): value for name, value in content.items() if not name.startswith("__")}


def _read_objects(path: Path) -> Tree:
    """Read a file of version 7.3, or one with objects."""
    os.environ["HDF5_PLUGIN_PRELOAD"] = "::"  # loads no filters of the machine
    try:
        with warnings.catch_warnings(action="ignore"):  # it sets an option of pandas
            from matio import load_from_mat
    except ModuleNotFoundError:
        raise UnreadableFile(_NO_LIBRARY) from None
    if is_hdf5(path):
        with _refuse_damages():
            _check_links(path)
    with _refuse_damages(), warnings.catch_warnings(action="ignore"):
        content = load_from_mat(str(path), add_table_attrs=True)
        return {
            str(name): _simplify(value, _MAX_NESTING)
            for name, value in content.items()
            if not str(name).startswith("__")
        }


@contextmanager
def _refuse_damages() -> Iterator[None]:
    """Refuse a file on which a library of binary files fails."""
    try:
        yield
    except UnreadableFile:
        raise
    except (*DAMAGES, RuntimeError, ArithmeticError, AssertionError) as error:
        raise build_damage_error("MATLAB", error) from None
    except Exception as error:
        if type(error).__module__.partition(".")[0] != "matio":
            raise
        raise build_damage_error("MATLAB", error) from None


def _check_links(path: Path) -> None:
    """Refuse an HDF5 file whose values are in other files: the reader could see those of a server.

    Everything is visited that has a name, or that a reference points to.
    """
    import h5py

    with h5py.File(path, "r") as file:
        seen, waiting = set[int](), [file["/"]]
        while waiting:
            item = waiting.pop()
            address = h5py.h5o.get_info(item.id).addr
            if address in seen:
                continue
            seen.add(address)
            if isinstance(item, h5py.Group):
                waiting += _list_members(item)
            elif isinstance(item, h5py.Dataset):
                waiting += _list_references(item)


def _list_members(group: Any) -> list[Any]:
    """List the members of a group of HDF5, none of them in another file."""
    import h5py

    for name in group:
        if isinstance(group.get(name, getlink=True), h5py.ExternalLink):
            raise UnreadableFile(f"{name!r} is a link to another file; save its values")
    return [group[name] for name in group]


def _list_references(dataset: Any) -> list[Any]:
    """List what the references of a dataset of HDF5 point to; its values are in no other file."""
    import h5py

    if dataset.external or dataset.is_virtual:
        raise UnreadableFile(f"the values of {dataset.name!r} are in another file; save them")
    if h5py.check_ref_dtype(dataset.dtype) is None:
        return []
    return [dataset.file[one] for one in np.asarray(dataset[()]).flat if one]


def _simplify(value: Any, depth: int) -> Any:
    """Convert a value of `mat-io` to mappings, lists, arrays and texts."""
    if depth == 0:
        return None
    if hasattr(value, "columns") and hasattr(value, "index"):
        return _open_table(value)
    properties = getattr(value, "properties", None)
    if isinstance(properties, Mapping):
        fields = {str(n).strip("_"): _simplify(v, depth - 1) for n, v in properties.items()}
        return {_CLASS: str(value.classname), **fields}
    if isinstance(value, Mapping):
        return {str(name): _simplify(one, depth - 1) for name, one in value.items()}
    array = np.asarray(value)
    if array.dtype.names:
        kind = getattr(value, "classname", None)
        named = {_CLASS: kind} if kind else {}
        return _single(
            [
                {**named, **{name: _simplify(one[name], depth - 1) for name in array.dtype.names}}
                for one in array.ravel()
            ]
        )
    if array.dtype.kind == "O":
        return _single([_simplify(item, depth - 1) for item in array.ravel()])
    return _simplify_values(array)


def _single(items: list[Any]) -> Any:
    return items[0] if len(items) == 1 else items


def _simplify_values(array: NDArray[Any]) -> Any:
    """Convert an array of values: time spans become s, and a single text is one."""
    if array.dtype.kind == "m":
        return array.astype("timedelta64[ns]").astype(np.int64).squeeze() / 1e9
    if array.dtype.kind in "UT":
        texts = array.astype(np.str_)
        return str(texts.item()) if texts.size == 1 else texts.squeeze()
    return array.squeeze()


def _open_table(table: Any) -> dict[str, Any]:
    """Return the columns of a table or timetable, with their units, and its times."""
    units = table.attrs.get("varUnits") or table.attrs.get("VariableUnits") or []
    fields: dict[str, Any] = {}
    kind = str(table.index.dtype)
    if kind.startswith("datetime64"):
        fields["time"] = table.index.to_numpy().astype("datetime64[ns]")
    elif kind.startswith("timedelta64"):
        fields["time"] = table.index.to_numpy().astype("timedelta64[ns]").astype(np.int64) / 1e9
    for place, name in enumerate(map(str, table.columns)):
        unit = units[place] if place < len(units) else ""
        values = table.iloc[:, place].to_numpy()
        is_text = values.dtype.kind in "OT"
        fields[f"{name} [{unit}]" if unit else name] = values.astype(np.str_) if is_text else values
    return fields


def _find_branches(tree: Tree, path: str, notes: list[str], depth: int) -> list[_Branch]:
    """Find the records of a tree."""
    if depth == 0:
        return []
    opened = next((read(tree) for is_one, read in _SHAPES if is_one(tree)), None)
    if opened is not None:
        return [_Branch(path, opened, True)]
    inner = {name: value for name, value in tree.items() if isinstance(value, Mapping)}
    plain = {name: v for name, v in tree.items() if name not in inner and name != _CLASS}
    signals = [name for name, value in plain.items() if is_signal(np.asarray(value))]
    has_times = any(map(_gives_times, plain))
    if any(not _is_times(name) for name in signals):
        if inner:
            notes.append(f"the structures {', '.join(inner)} were left out")
        return [_Branch(path, plain, has_times)]
    found = [
        branch
        for name, value in inner.items()
        for branch in _find_branches(value, f"{path}.{name}".strip("."), notes, depth - 1)
    ]
    if any(branch.has_times for branch in found) or not found:
        return found
    if len(found) == 1 and not has_times:
        return found
    return [_Branch(path, {**plain, **_merge(found)}, has_times)]


def _merge(branches: list[_Branch]) -> dict[str, Any]:
    """Merge the fields of branches; one whose name occurs twice has its path too."""
    names = [name for branch in branches for name in branch.fields]
    return {
        name if names.count(name) == 1 else f"{branch.path.rpartition('.')[2]}.{name}": value
        for branch in branches
        for name, value in branch.fields.items()
    }


def _gives_times(name: str) -> bool:
    return _is_times(name) or name.lower() in (*PERIOD_NAMES, *RATE_NAMES)


def _is_times(name: str) -> bool:
    return is_time_name(name) and not is_temperature_name(name)


def _open_simulink(fields: Tree) -> dict[str, Any]:
    """Return the signals of Simulink's "structure with time", by their labels."""
    signals = fields["signals"]
    arrays = {"time": fields.get("time")}
    for number, signal in enumerate([signals] if isinstance(signals, Mapping) else signals, 1):
        label = signal.get("label") if isinstance(signal, Mapping) else None
        name = label if isinstance(label, str) and label else f"signal{number}"
        arrays[name] = signal.get("values") if isinstance(signal, Mapping) else signal
    return arrays


def _is_iddata(fields: Tree) -> bool:
    return str(fields.get(_CLASS)) == "iddata"


def _open_iddata(fields: Tree) -> dict[str, Any]:
    """Return outputs and inputs of an `iddata` by their names, and its times in s."""
    known = {name.lower(): value for name, value in fields.items()}
    arrays: dict[str, Any] = {}
    for kind, letter in (("input", "u"), ("output", "y")):
        data = known.get(f"{kind}data", known.get(letter))
        if isinstance(data, list):
            raise UnreadableFile(
                f"the iddata holds {len(data)} experiments; save one: z = getexp(z, 1)"
            )
        matrix = np.asarray(data if data is not None else [], dtype=np.float64)
        matrix = matrix.reshape(matrix.shape[0], -1) if matrix.size else matrix.reshape(0, 0)
        names, units = (_list_texts(known.get(f"{kind}{what}")) for what in ("name", "unit"))
        for i in range(matrix.shape[1]):
            name = names[i] if i < len(names) and names[i] else f"{letter}{i + 1}"
            unit = units[i] if i < len(units) else ""
            arrays[f"{name} [{unit}]" if unit else name] = matrix[:, i]
    size = find_unit_seconds(str(known.get("timeunit") or "s")) or 1.0
    instants = np.asarray(known.get("samplinginstants", []), dtype=np.float64)
    length = max((values.size for values in arrays.values()), default=0)
    period = np.asarray(known.get("ts", []), dtype=np.float64)
    if instants.size == length > 1:
        return {"time": instants * size, **arrays}
    if period.size != 1:
        raise UnreadableFile("the iddata has neither Ts nor SamplingInstants in the time domain")
    start = np.asarray(known.get("tstart", []), dtype=np.float64)
    first = float(start.item()) if start.size == 1 and np.isfinite(start).all() else 0.0
    return {"time": (first + float(period.item()) * np.arange(length)) * size, **arrays}


def _list_texts(value: Any) -> list[str]:
    if isinstance(value, str):
        return [value]
    return [str(one) for one in np.asarray([] if value is None else value, dtype=object).ravel()]


_SHAPES: Final[tuple[tuple[Callable[[Tree], bool], Callable[[Tree], dict[str, Any]]], ...]] = (
    (_is_iddata, _open_iddata),
    (lambda fields: "signals" in fields, _open_simulink),
)
