"""The memory layout of a wide tree (a BVH with eight children a node), on which its kernels and their callers agree.

The kernels are in ``scripts/kernel_sources``; numbers below are compiled into them.

A tree is one buffer of 64-byte cache lines of 16 float32. A *node* has 4 lines: lower x, y, z and upper x, y, z of eight
children, eight codes, eight unused numbers. A *leaf* has 7 lines: nine components of eight triangles' corners, four numbers of
their planes, eight ids. A leaf with rectangles has 8 more lines: twelve components of eight rectangles' four corners, and
their planes. The leaves of a node follow it. Each of these is a vector of eight numbers, one for each child or primitive.

A *code* refers to a child of a node: it is ``4 line`` for a node that begins at a line, and ``~(4 line + kinds)`` for a leaf,
where ``kinds`` is 2 if it has rectangles, plus 1 if it has disks, spheres or quadrics. Where a leaf has fewer than eight
triangles, an unused place has NaN corners and id -1, and the place of a primitive that is not a triangle has NaN corners and
``-2 - id``.

An *entry* is the distance at which a ray enters a box. Hits in a leaf are clamped to at least ``FLOOR`` times the leaf's
entry, and a box is skipped only if its entry is beyond ``SLACK`` times the best hit. A child's box is never entered before its
parent's, rounding included, so the result depends neither on the order of traversal nor on the other rays of a packet.
Children are sorted by their entries with the child's number, 0 to 7, in place of the last three bits; ``FLOOR`` and ``SLACK``
allow for that change.
"""

from __future__ import annotations

import numpy as np

__all__ = [
    "CHILDREN",
    "FLOOR",
    "FOURTH",
    "IDS",
    "INSTANCE_MEMORY",
    "LEAF",
    "LINE",
    "MAY_PASS",
    "MORE",
    "NODE",
    "PACKET_MEMORY",
    "PLANES",
    "RAYS_IN_FLIGHT",
    "RECTANGLES",
    "RULED",
    "SLACK",
    "WIDTH",
    "instance_memory",
    "packet_memory",
    "stack_size",
]

#: Children a node, and primitives a leaf: one vector of boxes or triangles.
WIDTH = 8
#: Float32 in a cache line.
LINE = 16
#: Lines of a node, of a leaf, and the further ones of a leaf's rectangles.
NODE, LEAF, MORE = 4, 7, 8
#: Offset of the codes in a node; all offsets are in float32.
CHILDREN = 48
#: Offsets of planes and ids in a leaf.
PLANES, IDS = 72, 104
#: Offset of the rectangles in a leaf: three corners as for triangles. From there :data:`FOURTH` is the offset of the fourth
#: corners, :data:`RULED` that of the planes.
RECTANGLES = LEAF * LINE
FOURTH, RULED = 72, 96
#: Factors of the tests of entries, see above: 2^-17 is 64 ulps, many more than the 7 that sorting changes.
SLACK = np.float32(1.0 + 2.0**-16)
FLOOR = np.float32(1.0 - 2.0**-17)
#: Instead of an id: an any-hit ray has so far hit only surfaces that may let light pass.
MAY_PASS = np.int32(-2)

#: Single rays that a kernel traces in turn, each with a stack of its own.
RAYS_IN_FLIGHT = 16
#: Bytes of scratch memory of a search by packets and of one of instances, without the stacks.
PACKET_MEMORY, INSTANCE_MEMORY = 24_672, 96


def stack_size(depth: int) -> int:
    """Return the stack size of a ray for a tree of a depth.

    A visit of a node leaves up to seven children on the stack, and one write stores a vector of eight.
    """
    return depth * (WIDTH - 1) + 2 * WIDTH


def packet_memory(stack_length: int) -> int:
    """Return the bytes of scratch memory for a search of a tree: two stacks of 32 bits for each ray in flight, and rays."""
    return PACKET_MEMORY + 2 * 4 * RAYS_IN_FLIGHT * stack_length


def instance_memory(stack_length: int) -> int:
    """Return the bytes of scratch memory for a search of instances: two stacks of 32 bits, and eight hits."""
    return INSTANCE_MEMORY + 2 * 4 * stack_length
