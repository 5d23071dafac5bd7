"""Choose the products and sums that become fused multiply-adds, in the graph instead of in LLVM.

LLVM's own choice would depend on its version, on the vector width and on the machine, and results with it.
"""

from __future__ import annotations

from collections import Counter

from torchpt.compiler.graph import FLOATS, Graph

__all__ = ["fused_products"]


def fused_products(graph: Graph, needed: list[int], roots: list[int]) -> dict[int, int]:
    """Find for each sum or difference the product to fuse with it: its first term that is a product which nothing else uses.

    Args:
        graph: the graph of a stage.
        needed: nodes that are computed.
        roots: nodes of the results; each mention counts as a use.

    Returns:
        The fused product of each sum, both as nodes.
    """
    uses = Counter(roots)
    for node in needed:
        _, _, terms, _ = graph.nodes[node]
        uses.update(terms)
    products: dict[int, int] = {}
    for node in needed:
        op, ty, terms, _ = graph.nodes[node]
        if op in ("add", "sub") and ty in FLOATS:
            product = next((x for x in terms if graph.nodes[x][0] == "mul" and uses[x] == 1), None)
            if product is not None:
                products[node] = product
    return products
