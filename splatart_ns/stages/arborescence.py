"""The cheapest tree of a directed graph with a given root."""

from __future__ import annotations

from collections.abc import Collection, Mapping


def cheapest_parents(costs: Mapping[tuple[int, int], float], root: int) -> dict[int, int]:
    """Parents by child in the arborescence of least total cost over what `root` reaches, costs by (parent, child).

    Chu and Liu 1965, Edmonds 1967: everyone takes the cheapest parent; a circle becomes one node, and whoever enters
    it pays for what is then given up.
    """
    reached = reached_from(costs, root)
    costs = {(a, b): cost for (a, b), cost in costs.items() if a in reached and b != root}
    parents: dict[int, int] = {}
    for (a, b), cost in costs.items():
        if b not in parents or cost < costs[parents[b], b]:
            parents[b] = a
    circle = find_cycle(parents)
    if not circle:
        return parents
    node = max(reached) + 1
    contracted: dict[tuple[int, int], float] = {}
    original: dict[tuple[int, int], tuple[int, int]] = {}
    for (a, b), cost in costs.items():
        if a in circle and b in circle:
            continue
        edge = node if a in circle else a, node if b in circle else b
        more = cost - costs[parents[b], b] if b in circle else cost
        if edge not in contracted or more < contracted[edge]:
            contracted[edge], original[edge] = more, (a, b)
    outer = [original[a, b] for b, a in cheapest_parents(contracted, root).items()]
    return {b: parents[b] for b in circle} | {b: a for a, b in outer}


def find_cycle(parents: Mapping[int, int]) -> set[int]:
    """The parts of one circle of parents; empty if there is none."""
    for part in parents:
        path: list[int] = []
        while part in parents and part not in path:
            path.append(part)
            part = parents[part]
        if part in path:
            return set(path[path.index(part) :])
    return set()


def reached_from(edges: Collection[tuple[int, int]], start: int) -> set[int]:
    """Where edges (from, to) lead, `start` included."""
    reached, following = set(), {start}
    while following:
        reached |= following
        following = {b for a, b in edges if a in following} - reached
    return reached
