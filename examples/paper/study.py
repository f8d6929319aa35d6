"""The whole study: which parts there are, and how a user names them."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial

from examples.paper import actuator, noise, oscillators, series, tube
from examples.paper.bench import StudyBench
from examples.paper.document import Section

StudyPart = Callable[[StudyBench], list[Section]]
PARTS: Mapping[str, StudyPart] = {
    "series": series.build_sections,
    "table1": partial(oscillators.build_sections, example=oscillators.EXAMPLE_1),
    "table2": partial(oscillators.build_sections, example=oscillators.EXAMPLE_2),
    "noise": noise.build_sections,
    "table3": tube.build_sections,
    "table4": actuator.build_sections,
}
_FIGURES: Mapping[str, Iterable[int]] = {
    "series": (2, 3),
    "table1": range(7, 11),
    "table2": range(11, 15),
    "noise": (15,),
    "table3": (17, 18),
    "table4": (20, 21),
}
_PART_BY_FIGURE = {f"figure{number}": part for part, all_ in _FIGURES.items() for number in all_}


class UnknownPart(Exception):
    """A part was asked for that the study does not have."""

    def __init__(self, name: str) -> None:
        numbers = ", ".join(name.removeprefix("figure") for name in _PART_BY_FIGURE)
        super().__init__(
            f"the study has no part {name!r}; need some of {', '.join(PARTS)}, "
            f"or figureN with N of {numbers}"
        )


def choose_parts(only: str | None) -> list[str]:
    """Names of the parts that ``table1,figure15`` asks for, in the study's order; all if None.

    Raises
    ------
    UnknownPart
        If there is no such part.
    """
    if only is None:
        return list(PARTS)
    asked = [word.strip().lower() for word in only.split(",") if word.strip()]
    if not asked:
        raise UnknownPart(only)
    for name in asked:
        if name not in PARTS and name not in _PART_BY_FIGURE:
            raise UnknownPart(name)
    wanted = {_PART_BY_FIGURE.get(name, name) for name in asked}
    return [name for name in PARTS if name in wanted]


def conduct_study(bench: StudyBench, names: Iterable[str]) -> Iterable[Section]:
    """The sections of the named parts, one after the other as they are done."""
    for name in names:
        yield from PARTS[name](bench)
