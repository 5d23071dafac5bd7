"""Fuse products with sums, rounded once: the graph decides which, so that no compiler does.

A compiler that may fuse as it likes fuses otherwise at another width, in another version and on another machine.
"""

from __future__ import annotations

from collections import Counter

from torchpt.compiler.graph import FLOATS, Graph

__all__ = ["fused_products"]


def fused_products(graph: Graph, needed: list[int], roots: list[int]) -> dict[int, int]:
    """Return the product that is rounded with each sum or difference: the first of its terms that nothing else asks for.

    Args:
        graph: of a stage.
        needed: the nodes that are computed.
        roots: results among them; one that is named twice is asked for twice.

    Returns:
        Products by the sums that they are a term of.
    """
    uses = Counter(roots)
    for node in needed:
        uses.update(graph.nodes[node][2])
    found: dict[int, int] = {}
    for node in needed:
        op, ty, terms, _ = graph.nodes[node]
        if op in ("add", "sub") and ty in FLOATS:
            product = next((x for x in terms if graph.nodes[x][0] == "mul" and uses[x] == 1), None)
            if product is not None:
                found[node] = product
    return found
