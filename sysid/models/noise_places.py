"""Places of noise in a document: ``noise: {plant: {x: estimate}, load: {u: estimate}}``.

Noise in the plant diffuses a state, or is added to each sample of a recursion. A load is a slow
disturbance at an input, or the drift of an output's sensor. Their sizes are always estimated, so
`estimate` is the one value.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from sysid.core.errors import join_pointer, suggest_name
from sysid.language.delays import collect_past_values
from sysid.language.tree import Expression
from sysid.models.document_reader import DocumentReader, quote_value
from sysid.models.model import NoisePlaces, Output

ESTIMATE = "estimate"
_SECTIONS = ("plant", "load")


def read_noise(
    reader: DocumentReader,
    value: object,
    equations: Mapping[str, Expression],
    inputs: Sequence[str],
    outputs: Sequence[Output],
) -> NoisePlaces:
    """Read the places of noise; `equations` are given by state."""
    fields = reader.read_section(value, "/noise", _SECTIONS)
    names = [output.name for output in outputs]
    plant = _read_names(reader, fields.get("plant"), "plant", list(equations), "state")
    load = _read_names(reader, fields.get("load"), "load", [*inputs, *names], "input or output")
    seen = _find_seen_states(equations, outputs)
    for state in plant:
        if state not in seen:
            detail = f"no output depends on {state}, so its noise has no effect; leave it out"
            reader.add_fault(join_pointer("noise", "plant", state), detail)
    used = {p.name for s in seen for p in collect_past_values(equations[s]) if p.kind == "input"}
    for name in load:
        if name in inputs and name not in used:
            detail = f"no output depends on {name}, so its load has no effect; leave it out"
            reader.add_fault(join_pointer("noise", "load", name), detail)
    return NoisePlaces(plant, load)


def write_noise(places: NoisePlaces) -> dict[str, Any]:
    """Write the section again; nothing without a place."""
    found = {
        section: dict.fromkeys(names, ESTIMATE)
        for section, names in (("plant", places.plant), ("load", places.load))
        if names
    }
    return {"noise": found} if found else {}


def _read_names(
    reader: DocumentReader, value: object, section: str, known: Sequence[str], what: str
) -> tuple[str, ...]:
    fields = reader.read_section(value, join_pointer("noise", section))
    found = []
    for name, size in fields.items():
        pointer = join_pointer("noise", section, name)
        if name not in known:
            reader.add_fault(pointer, f"there is no such {what}{suggest_name(name, known)}")
        elif size != ESTIMATE:
            detail = f"found {quote_value(size)}; need {ESTIMATE}, the size follows from the data"
            reader.add_fault(pointer, detail)
        else:
            found.append(name)
    return tuple(name for name in known if name in found)


def _find_seen_states(
    equations: Mapping[str, Expression], outputs: Sequence[Output]
) -> dict[str, None]:
    """Find the states that outputs depend on, now or in the past, directly or not."""
    trees = [output.expression for output in outputs]
    seen: dict[str, None] = {}
    while trees:
        for past in collect_past_values(trees.pop()):
            if past.kind == "state" and past.name not in seen:
                seen[past.name] = None
                trees.append(equations[past.name])
    return seen
