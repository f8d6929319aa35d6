"""Lineage of a recording or a job as a drawing: from what it came, and what was made from it.

A few levels and the latest items are drawn. The boxes are links, so that a keyboard reaches them.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Literal
from urllib.parse import quote

from sqlalchemy.orm import Session

from service.core.root_path import to_address
from service.jobs.outcomes import read_outcomes
from service.repositories.job_rows import JobRepository
from service.repositories.lineage_rows import LineageLink, LineageRepository, describe_items
from service.repositories.reference_rows import ReferenceRepository
from service.storage.tables import Dataset, Job
from service.trends.batch_trend import has_trend

NodeKind = Literal["recording", "job", "run", "model", "reference", "trend"]
KINDS: Mapping[str, NodeKind] = {"ds": "recording", "job": "job", "run": "run", "mdl": "model"}
FOLDERS: Mapping[NodeKind, str] = {
    "recording": "datasets",
    "job": "jobs",
    "run": "runs",
    "model": "models",
}
TREND_PREFIX, REFERENCE_PREFIX = "trend:", "reference:"
LEVELS_UP, LEVELS_DOWN = 3, 3
MAX_NEIGHBOURS = 16
"""Most edges that are followed from the items of one level."""
MAX_CHARACTERS = 26
BOX_WIDTH, BOX_HEIGHT, COLUMN_GAP, ROW_GAP, EDGE = 200, 42, 48, 12, 3


@dataclass(frozen=True, slots=True)
class Node:
    """A box of the drawing; `x` and `y` (px) are its upper left corner."""

    id: str
    kind: NodeKind
    title: str
    href: str
    is_shown: bool = False
    is_deleted: bool = False
    x: int = 0
    y: int = 0

    @property
    def short_title(self) -> str:
        """The title as it fits into the box."""
        if len(self.title) <= MAX_CHARACTERS:
            return self.title
        return f"{self.title[: MAX_CHARACTERS - 1]}…"


@dataclass(frozen=True, slots=True)
class Arrow:
    """A line from a box to what was made from it, as the path of an SVG."""

    path: str
    relation: str


@dataclass(frozen=True, slots=True)
class LineageDrawing:
    """What a template draws; sizes in px. `is_cut` if more was made than is drawn."""

    nodes: tuple[Node, ...]
    arrows: tuple[Arrow, ...]
    width: int
    height: int
    is_cut: bool
    box_width: int = BOX_WIDTH
    box_height: int = BOX_HEIGHT


def draw_lineage(session: Session, shown: Dataset | Job) -> LineageDrawing:
    """Draw from what a recording or a job came, and what was made from it."""
    links, is_cut = _collect_links(LineageRepository(session), shown.id)
    ids = {shown.id, *(link.child for link in links), *(link.parent for link in links)}
    jobs = JobRepository(session).list_some([one for one in ids if one.startswith("job_")])
    results = [*_link_runs(session, jobs), *_link_trends(jobs), *_link_references(session, jobs)]
    ids |= {link.child for link in results} | {link.parent for link in results}
    nodes = {node.id: node for node in _describe_nodes(session, ids)}
    nodes[shown.id] = replace(nodes[shown.id], is_shown=True)
    pairs = {(link.parent, link.child): link for link in (*results, *links)}
    arrows = [one for one in pairs.values() if one.parent in nodes and one.child in nodes]
    return _arrange(nodes, arrows, is_cut=is_cut)


def _collect_links(lineage: LineageRepository, start: str) -> tuple[list[LineageLink], bool]:
    """Walk a few levels to both sides; also whether there is more than was followed."""
    links: list[LineageLink] = []
    is_cut = False
    for list_links, levels, end in (
        (lineage.list_links_to_parents, LEVELS_UP, attrgetter("parent")),
        (lineage.list_links_to_children, LEVELS_DOWN, attrgetter("child")),
    ):
        level, seen = {start}, {start}
        for _ in range(levels):
            found = list_links(level, MAX_NEIGHBOURS + 1)
            is_cut = is_cut or len(found) > MAX_NEIGHBOURS
            links += found[:MAX_NEIGHBOURS]
            level = set(map(end, found[:MAX_NEIGHBOURS])) - seen
            seen |= level
    return links, is_cut


def _link_runs(session: Session, jobs: Sequence[Job]) -> Iterator[LineageLink]:
    """Link each job to the run that stands for it."""
    for job, outcome in read_outcomes(session, jobs).items():
        yield LineageLink(outcome.run, job, "result")


def _link_trends(jobs: Sequence[Job]) -> Iterator[LineageLink]:
    for job in jobs:
        if has_trend(job):
            yield LineageLink(f"{TREND_PREFIX}{job.id}", job.id, "trend")


def _link_references(session: Session, jobs: Sequence[Job]) -> Iterator[LineageLink]:
    """Link accepted runs of the jobs to the names under which they were accepted."""
    ids = [job.id for job in jobs]
    for one in ReferenceRepository(session).list_of_jobs(ids)[:MAX_NEIGHBOURS]:
        yield LineageLink(one.accepted.run_id, one.job_id, "result")
        name = f"{REFERENCE_PREFIX}{one.accepted.name}"
        yield LineageLink(name, one.accepted.run_id, "accepted")


def _describe_nodes(session: Session, ids: Collection[str]) -> Iterator[Node]:
    for item in describe_items(session, ids):
        kind = KINDS[item.id.partition("_")[0]]
        href = item.name if kind == "model" else item.id
        address = to_address(f"/{FOLDERS[kind]}/{quote(href)}")
        is_deleted = item.deleted_at is not None
        yield Node(item.id, kind, item.name, address, is_deleted=is_deleted)
    for name in sorted(ids):
        if name.startswith(TREND_PREFIX):
            job = name.removeprefix(TREND_PREFIX)
            yield Node(name, "trend", "estimates over a label", to_address(f"/jobs/{job}"))
        elif name.startswith(REFERENCE_PREFIX):
            title = name.removeprefix(REFERENCE_PREFIX)
            yield Node(name, "reference", title, to_address(f"/references/{quote(title, safe='')}"))


def _arrange(
    nodes: Mapping[str, Node], links: Sequence[LineageLink], *, is_cut: bool
) -> LineageDrawing:
    """Place each box to the right of all from which it was made, near the middle of them."""
    columns = _choose_columns(nodes, links)
    parents: dict[str, list[str]] = {}
    for link in links:
        parents.setdefault(link.child, []).append(link.parent)
    tallest = max(map(len, columns))
    places: dict[str, tuple[int, float]] = {}
    for number, column in enumerate(columns):
        column.sort(key=lambda name: (_find_middle(parents.get(name, ()), places), name))
        above = (tallest - len(column)) / 2
        places |= {name: (number, above + row) for row, name in enumerate(column)}
    placed = {
        name: replace(
            nodes[name],
            x=EDGE + column * (BOX_WIDTH + COLUMN_GAP),
            y=EDGE + round(row * (BOX_HEIGHT + ROW_GAP)),
        )
        for name, (column, row) in places.items()
    }
    return LineageDrawing(
        nodes=tuple(placed.values()),
        arrows=tuple(_draw_arrow(placed[one.parent], placed[one.child], one) for one in links),
        width=2 * EDGE + len(columns) * (BOX_WIDTH + COLUMN_GAP) - COLUMN_GAP,
        height=2 * EDGE + tallest * (BOX_HEIGHT + ROW_GAP) - ROW_GAP,
        is_cut=is_cut,
    )


def _choose_columns(names: Collection[str], links: Sequence[LineageLink]) -> list[list[str]]:
    numbers = dict.fromkeys(names, 0)
    for _ in names:  # no way is longer; a cycle, which nothing writes, would end here too
        for link in links:
            numbers[link.child] = max(numbers[link.child], numbers[link.parent] + 1)
    used = sorted(set(numbers.values()))
    return [[name for name in names if numbers[name] == number] for number in used]


def _find_middle(names: Sequence[str], places: Mapping[str, tuple[int, float]]) -> float:
    rows = [places[name][1] for name in names if name in places]
    return sum(rows) / len(rows) if rows else 0.0


def _draw_arrow(parent: Node, child: Node, link: LineageLink) -> Arrow:
    x, y = parent.x + BOX_WIDTH, parent.y + BOX_HEIGHT // 2
    end_x, end_y = child.x, child.y + BOX_HEIGHT // 2
    middle = (x + end_x) // 2
    return Arrow(f"M{x} {y} C{middle} {y} {middle} {end_y} {end_x} {end_y}", link.relation)
