"""What a model declares and does not use; a check reports it."""

from collections.abc import Iterator, Mapping

from sysid.core.errors import Fault, join_pointer
from sysid.language.parser import tokenize_expression
from sysid.language.tree import PastValue, walk
from sysid.models.model import Model
from sysid.models.model_delays import find_unused_settings, list_past_values, list_trees
from sysid.models.ties import apply_ties, resolve_ties

_READING_FIELDS = ("equations", "outputs", "initial", "history", "lags", "terms")
"""Fields of a document whose expressions may have names of `let` and constants."""


def find_unused_names(model: Model) -> list[Fault]:
    """Find free parameters, inputs, constants and intermediate names that nothing uses.

    An intermediate name that only other unused ones use is unused, too.
    """
    tied = apply_ties(model, resolve_ties(model, model.parameters))
    read = {
        node.name for tree in list_trees(tied) for node in walk(tree) if isinstance(node, PastValue)
    }
    return [
        *find_unused_settings(tied, model.parameters, None),
        *_make_faults("inputs", [one.name for one in model.inputs if one.name not in read]),
        *_find_unread_histories(model),
        *_find_unused_definitions(model),
    ]


def _find_unread_histories(model: Model) -> Iterator[Fault]:
    delayed = {past.name for past in list_past_values(model) if past.delay is not None}
    for history in model.histories:
        if history.state not in delayed:
            detail = f"no lag reads {history.state!r} before the record; remove it, or use it"
            yield Fault(join_pointer("history", history.state), detail)


def _find_unused_definitions(model: Model) -> Iterator[Fault]:
    document = model.document
    sections: dict[str, Mapping[str, object]] = {
        section: document.get(section) or {} for section in ("constants", "let")
    }
    unused = {name: text for section in sections.values() for name, text in section.items()}
    texts = [text for field in _READING_FIELDS for text in _iterate_texts(document.get(field))]
    texts += [parameter.tied for parameter in model.parameters if parameter.tied is not None]
    while texts:
        words = {token.text for token in tokenize_expression(texts.pop())[0]}
        texts += [text for name in words if isinstance(text := unused.pop(name, None), str)]
    for section, declared in sections.items():
        yield from _make_faults(section, [name for name in declared if name in unused])


def _iterate_texts(value: object) -> Iterator[str]:
    """Iterate over the texts of a field, whatever its form."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping | list | tuple):
        for inner in value.values() if isinstance(value, Mapping) else value:
            yield from _iterate_texts(inner)


def _make_faults(section: str, names: list[str]) -> list[Fault]:
    return [
        Fault(join_pointer(section, name), f"nothing uses {name!r}; remove it, or use it")
        for name in names
    ]
