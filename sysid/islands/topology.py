"""Topologies: the directed connections between islands."""

from collections.abc import Callable, Mapping
from typing import TypeAlias

from sysid.core.settings import TopologyName

MigrationEdge: TypeAlias = tuple[int, int]
"""Source and destination."""


def list_edges(name: TopologyName, n: int) -> tuple[MigrationEdge, ...]:
    """List all connections of an archipelago of `n` islands, sorted by source and destination."""
    return tuple(sorted(edge for edge in CONNECTIONS[name](n) if edge[0] != edge[1]))


def _connect_next(n: int) -> set[MigrationEdge]:
    """Connect each island to the next."""
    return {(i, (i + 1) % n) for i in range(n)}


def _connect_neighbours(n: int) -> set[MigrationEdge]:
    """Connect each island to both neighbours."""
    return {(i, (i + step) % n) for i in range(n) for step in (1, -1)}


def _connect_all(n: int) -> set[MigrationEdge]:
    """Connect each island to all others."""
    return {(i, j) for i in range(n) for j in range(n)}


def _connect_centre(n: int) -> set[MigrationEdge]:
    """Connect island 0 to all others, and these to it."""
    return {edge for i in range(1, n) for edge in ((0, i), (i, 0))}


def _connect_none(n: int) -> set[MigrationEdge]:
    """Connect no islands: each searches alone."""
    return set()


CONNECTIONS: Mapping[TopologyName, Callable[[int], set[MigrationEdge]]] = {
    "one-way-ring": _connect_next,
    "ring": _connect_neighbours,
    "fully-connected": _connect_all,
    "star": _connect_centre,
    "unconnected": _connect_none,
}
"""The connections of `n` islands by the name of their topology."""
