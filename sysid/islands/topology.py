"""Topologies: which island sends its migrants to which."""

from typing import TypeAlias

from sysid.core.settings import TopologyName

Edge: TypeAlias = tuple[int, int]
"""Source and destination."""


def edges(name: TopologyName, n: int) -> tuple[Edge, ...]:
    """All connections of an archipelago of `n` islands, by source and destination.

    ``one-way-ring``: each to the next. ``ring``: to both neighbours. ``star``: island 0 is the
    centre. ``fully-connected``: each to all others. ``unconnected``: none.
    """
    match name:
        case "one-way-ring":
            found = {(i, (i + 1) % n) for i in range(n)}
        case "ring":
            found = {(i, (i + step) % n) for i in range(n) for step in (1, -1)}
        case "star":
            found = {edge for i in range(1, n) for edge in ((0, i), (i, 0))}
        case "fully-connected":
            found = {(i, j) for i in range(n) for j in range(n)}
        case "unconnected":
            found = set()
    return tuple(sorted(edge for edge in found if edge[0] != edge[1]))
