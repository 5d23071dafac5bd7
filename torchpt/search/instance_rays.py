"""The search of a scene with instances for one ray, as functions inside kernels: two levels of trees in one traversal.

The hits have the bits of the CPU's search (:class:`torchpt.search.tree_instances.InstancedWideBvh`), whose trees it reads. A
ray first traverses the tree of the primitives that belong to no instance, then the *upper* tree, whose leaves hold instances.
For each of these it is transformed to the space of the instance's mesh, by the operations of
``scripts/kernel_sources/tree_instances.py``, and goes on at the root of the mesh's tree, in the *lower* part of the buffer.
Both levels share one stack, and the code that tests boxes and primitives.

The transform is one more turn of the warp (:mod:`torchpt.search.tree_rays`): it waits until as many threads need it as need
anything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchpt.compiler.form import Form
from torchpt.compiler.values import Value, Variable
from torchpt.physics.shapes.geometry import KINDS
from torchpt.search.tree_instances import InstancedWideBvh
from torchpt.search.tree_layout import IDS, LINE, WIDTH
from torchpt.search.tree_rays import Traversal, TreeSearch, tree_tables

__all__ = ["InstanceSearch", "instance_search", "instance_tables"]


@dataclass(frozen=True)
class InstanceSearch(TreeSearch):
    """As :class:`TreeSearch`, for a scene with instances; the words are those of :func:`instance_tables`.

    Attributes:
        kinds: see there; meshes of instances have triangles.
        depth: nodes on the longest path from a root through both levels.
    """

    def _traversal(self, any_hit: bool, form: Form, names: int = 0) -> Traversal:
        return _InstanceTraversal(self, any_hit, form, names)


def instance_search(accel: InstancedWideBvh) -> InstanceSearch:
    """Return the functions that search a scene with instances."""
    kinds = (kind for kind, count in zip(KINDS, accel.base.counts, strict=True) if count or kind == "triangle")
    return InstanceSearch(tuple(kinds), max(accel.base.depth, accel.depth))


def instance_tables(accel: InstancedWideBvh) -> tuple[Sequence[np.ndarray], np.ndarray]:
    """Return what kernels read of a scene with instances: tables, and the int64 words behind their addresses.

    Returns:
        The tables: one buffer with the tree of the primitives that belong to no instance, the upper tree, and the trees of the
        meshes; their corners, affine rows and quadrics; transforms ``(I, 12)`` float64 from the world to the meshes; and
        ``(I, 2)`` int32, the offset of the mesh's root in the buffer, and what is added to a triangle's number in its mesh to
        get its id. The words: ids of the first rectangle, disk, sphere and quadric; offsets, in float32, of the upper tree and
        of those of the meshes.
    """
    upper, lower, inverse, shift, roots = accel.tables
    (tree, *others), (*first_ids, _) = tree_tables(accel.base)
    at_upper, at_lower = len(tree), len(tree) + len(upper)
    # A code counts quarters of lines.
    copies = np.stack([at_lower + roots * (LINE // 4), shift], 1).astype(np.int32)
    tables = [np.concatenate([tree, upper, lower]), *others, inverse, copies]
    return tables, np.array([*first_ids, at_upper, at_lower], np.int64)


class _InstanceTraversal(Traversal):
    """See the module; a *copy* is an instance, by index."""

    table_names = (*Traversal.table_names, "inverse", "copies")

    def _declare(self) -> None:
        super()._declare()
        self.upper, self.lower = self._word(4), self._word(5)
        # Offset of the tree that is traversed, and what is added to the ids of its triangles.
        self.start, self.shift = Variable(self, "i"), Variable(self, "i")
        # The stack's size below the traversal of an instance; 0 in the other trees.
        self.bottom = Variable(self, "i")
        # The leaf of the upper tree whose instances are traversed, the place of the next one, and the one to go to; -1: none.
        self.group, self.place, self.goal = (Variable(self, "i") for _ in range(3))
        # The ray in the world: what its transforms and the upper tree need.
        self.world = {name: [Variable(self, "f") for _ in range(3)] for name in ("o", "d", "inverse")}
        for variable in (self.start, self.shift, self.bottom, self.place):
            variable.value = 0
        self.group.value = self.goal.value = -1

    def _begin(self, ox: Value, oy: Value, oz: Value, dx: Value, dy: Value, dz: Value, t_max: Value) -> None:
        super()._begin(ox, oy, oz, dx, dy, dz, t_max)
        for name, variables in self.world.items():
            for variable, component in zip(variables, self._ray(name), strict=True):
                variable.value = component
        valid = self.node.value.ge(0)
        self.start.value = valid.select(self.number("i", 0), self.upper)
        self.shift.value = self.bottom.value = 0
        self.group.value = self.goal.value = -1

    def _is_over(self) -> Value:
        return super()._is_over() & self.goal.value.lt(0)

    def _end(self) -> None:
        super()._end()
        self.start.value, self.bottom.value, self.group.value = self.upper, 0, -1

    def _needs(self) -> tuple[Value, ...]:
        return *super()._needs(), self.goal.value.ge(0)

    def _turn(self, *ballots: Value) -> None:
        nodes, leaves, moves = ballots
        waiting, *others = (threads.call("llvm.ctpop") for threads in (moves, nodes, leaves))
        most = others[0].call("llvm.umax", others[1])
        with self.either(waiting.ge(most)) as otherwise:
            with self.when(self.goal.value.ge(0).name):
                self._transform()
            otherwise()
            self._visit_or_test(nodes, leaves)
        with self.loop() as leave:
            leave(~self._is_over())
            ended = self.open.value.eq(self.none_open) & self.top.value.eq(self.bottom.value)
            leave(ended & self.group.value.lt(0) & self.start.value.eq(self.upper))
            with self.either(ended) as otherwise:
                self._next_tree()
                otherwise()
                self._next_box()

    def _next_tree(self) -> None:
        """Go on to the next instance of the leaf, back to the upper tree, or from the first tree to the upper one."""
        group = self.group.value
        with self.either(group.lt(0)) as otherwise:
            self.start.value = self.node.value = self.upper
            otherwise()
            place = self.place.value
            last = self.number("i", WIDTH - 1)
            id_ = self.read("i", self.tables["tree"], group + IDS + place.call("llvm.smin", last))
            found = place.lt(WIDTH) & id_.lt(-1)  # an instance is -2 - copy, an unused place -1
            self.goal.value = found.select(self.number("i", -2) - id_, -1)
            self.place.value = place + 1
            with self.when((~found).name):
                self.start.value, self.bottom.value, self.group.value = self.upper, 0, -1
                world = {name: [x.value for x in self.world[name]] for name in ("o", "inverse")}
                for name, components in {**world, "near": self._near(world["inverse"])}.items():
                    for variable, component in zip(self.ray[name], components, strict=True):
                        variable.value = component

    def _transform(self) -> None:
        """Transform the ray to the space of an instance's mesh, and go on at the root of its tree."""
        copy = self.goal.value
        self.goal.value = -1
        o, d = (self._doubled([x.value for x in self.world[name]]) for name in ("o", "d"))
        rows = [copy * 12 + 4 * k for k in range(3)]
        at = [self._row("inverse", row, o) + self.read("d", self.tables["inverse"], row + 3) for row in rows]
        along = [self._row("inverse", row, d) for row in rows]
        self._set_ray(*([x.to("fptrunc", "f") for x in vector] for vector in (at, along)))
        self.node.value = self.read("i", self.tables["copies"], copy * 2)
        self.shift.value = self.read("i", self.tables["copies"], copy * 2 + 1)
        self.start.value = self.lower

    def _placed(self, offset: Value) -> Value:
        return self.start.value + offset

    def _enter_leaf(self, leaf: Value, entry: Value) -> None:
        with self.either(self.start.value.eq(self.upper)) as otherwise:
            with self.when(self.open.value.ne(self.none_open).name):
                self._push()
            self.open.value = self.none_open
            self.group.value, self.place.value, self.bottom.value = leaf, 0, self.top.value
            otherwise()
            super()._enter_leaf(leaf, entry)

    def _triangle_id(self, id_: Value) -> Value:
        return id_ + self.shift.value
