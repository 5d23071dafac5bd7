"""The search of a wide tree for one ray, as functions inside kernels: on a GPU each thread traverses the tree for its own ray.

The hits have the bits of the CPU's search by packets (:class:`torchpt.search.tree.WideBvh`), whose tree it reads: all
operations on boxes and primitives are the same, and hits do not depend on the order of visits
(:mod:`torchpt.search.tree_layout`).

The threads of a warp take turns together. In a turn the warp either tests the boxes of nodes or two primitives of leaves,
whichever more of its threads have to do next; the others wait. So threads do not wait for a whole leaf, or a whole descent, of
their neighbours. In kernels that only search, threads whose ray is finished take new ones (Aila and Laine, "Understanding the
Efficiency of Ray Traversal on GPUs", HPG 2009).

The stack has one entry for each node with children left to visit: for nearest hits their numbers in the order of their entries,
for any hits a mask.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_

import numpy as np

from torchpt.compiler.block import Block
from torchpt.compiler.form import WARP, Form
from torchpt.compiler.searching import SearchLoop
from torchpt.compiler.values import LaneBlock, Value, Variable
from torchpt.physics.shapes.geometry import KINDS
from torchpt.search.tree import WideBvh
from torchpt.search.tree_layout import CHILDREN, FLOOR, IDS, LINE, PLANES, RECTANGLES, RULED, SLACK, WIDTH

__all__ = ["Traversal", "TreeSearch", "tree_search", "tree_tables"]

_RAY = ("ox", "oy", "oz", "dx", "dy", "dz", "t_max")
_HIT = "{float, i32, float, float}"
#: Threads of a warp without a ray at which they take new ones, and the weight of a thread that waits for a turn of nodes beside
#: that of one that waits for a turn of leaves: of the values tried, those that issue the fewest instructions for bounced rays.
_REFILL, _NODES_FIRST = 8, 2
#: Primitives of a leaf that a thread tests in a turn: more save votes, but make the code longer.
_PRIMITIVES = 2
#: Kinds whose first ids are the words behind the addresses.
_FIRST_IDS = ("rectangle", "disk", "sphere", "quadric")
#: The bits of an entry in a key; the sign bit is cleared, as entries are not negative but may be -0.
_ENTRY_BITS = 0x7FFFFFF8
#: Batcher's odd-even merge sort of eight.
_COMPARATORS = (
    (0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (1, 2), (5, 6),
    (0, 4), (1, 5), (2, 6), (3, 7), (2, 4), (3, 5), (1, 2), (3, 4), (5, 6),
)  # fmt: skip


@dataclass(frozen=True)
class TreeSearch:
    """The functions ``nearest`` and ``occluded`` inside kernels, which take a ray and the address of the scene's words.

    The words are those of :func:`torchpt.search.tree.scene_words`.

    Attributes:
        kinds: kinds of primitives that the scene has, of :data:`torchpt.physics.shapes.geometry.KINDS`.
        depth: nodes on the longest path from the root.
    """

    kinds: tuple[str, ...]
    depth: int

    def __call__(self, form: Form) -> Block:
        """Generate the functions; a value of ``form`` has one lane."""
        assert form.width == 1
        whole = Block(form)
        for any_hit in (False, True):
            block = self._traversal(any_hit, form)
            block.write()
            whole.lines += block.lines
            whole.declarations |= block.declarations
        return whole

    def lane_loop(self, loop: SearchLoop) -> Block:
        """See :class:`torchpt.compiler.searching.LoopingSearch`."""
        block = self._traversal(loop.any_hit, loop.form, loop.names)
        block.write_loop(loop)
        return block

    def _traversal(self, any_hit: bool, form: Form, names: int = 0) -> Traversal:
        """Return a builder of one of the functions; ``names`` as in :class:`SearchLoop`."""
        return Traversal(self, any_hit, form, names)


def tree_search(tree: WideBvh) -> TreeSearch:
    """Return the functions that search a tree; its words are :attr:`WideBvh.words`."""
    kinds = tuple(kind for kind, count in zip(KINDS, tree.counts, strict=True) if count)
    return TreeSearch(kinds, tree.depth)


def tree_tables(tree: WideBvh) -> tuple[Sequence[np.ndarray], np.ndarray]:
    """Return the tables whose addresses are the first words of the scene, and the words behind them."""
    return tree.tables, tree.words[len(tree.tables) :]


def _lesser(a: Value, b: Value) -> Value:
    """Return the smaller number; ``b`` if either is NaN."""
    return a.lt(b).select(a, b)


def _greater(a: Value, b: Value) -> Value:
    """Return the larger number; ``b`` if either is NaN."""
    return a.gt(b).select(a, b)


def _dot(a: Sequence[Value], b: Sequence[Value]) -> Value:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


class Traversal(LaneBlock):
    """The builder of one function: state of the traversal of a ray, and the turns that change it.

    Args:
        search: what the scene has.
        any_hit: True: the function is ``occluded``, else ``nearest``.
        form: of the kernel.
        names: see :class:`torchpt.compiler.searching.SearchLoop`.
    """

    #: Tables whose addresses are the first words of the scene.
    table_names: tuple[str, ...] = ("tree", "corner", "rows", "quadrics")

    def __init__(self, search: TreeSearch, any_hit: bool, form: Form, names: int = 0) -> None:
        super().__init__(form, names)
        self.search, self.any_hit = search, any_hit

    def write(self) -> None:
        """Write the function."""
        given = ", ".join(f"float %{name}" for name in _RAY)
        name, result = ("occluded", "i1") if self.any_hit else ("nearest", _HIT)
        attributes = "alwaysinline" if self.form.threads else "noinline"
        self.lines.append(f"define internal {result} @{name}({given}, ptr %search) {attributes} #0 {{\nentry:")
        self._declare()
        self._begin(*(self.given("f", f"%{name}") for name in _RAY))
        with self.loop() as leave:
            ballots = self._ballots()
            leave(reduce(or_, ballots).eq(0))
            self._turn(*ballots)
        self.do(f"ret {result} {self._result()}")
        self.lines.append("}")

    def write_loop(self, loop: SearchLoop) -> None:
        """Write a loop over lanes, in which threads take new rays once :data:`_REFILL` of their warp have none.

        A warp takes the lanes of its threads' numbers plus multiples of the number of all threads, in this order.
        """
        self._declare()
        self.node.value = self.leaf.value = -1
        self._end()
        lane, taken = Variable(self, "L"), Variable(self, "L")  # -1: no lane; lanes that the warp took
        more = Variable(self, "b")  # there are lanes behind them
        lane.value, taken.value, more.value = -1, 0, True
        n, threads = self.given("L", "%n"), self.given("L", "%threads")
        first_of_warp = self.given("L", "%thread") & -WARP
        self.declarations.add("declare i32 @llvm.nvvm.read.ptx.sreg.lanemask.lt()")
        below = self.given("i", self.op("call i32 @llvm.nvvm.read.ptx.sreg.lanemask.lt()"))

        def lane_at(place: Value) -> Value:
            return (place >> (WARP.bit_length() - 1)) * threads + first_of_warp + (place & WARP - 1)

        with self.loop() as leave:
            ballots = self._ballots()
            idle = ~reduce(or_, ballots)
            waiting = idle.call("llvm.ctpop")
            with self.either(waiting.eq(WARP) | (waiting.ge(_REFILL) & more.value)) as otherwise:
                mine = self._is_over()
                with self.when((mine & lane.value.ge(0)).name):
                    self._add(loop.store, i=lane.value.name, mask="true", found=self._result())
                lane.value = mine.select(self.number("L", -1), lane.value)
                next_lane = lane_at(taken.value + (idle & below).call("llvm.ctpop").to("zext", "L"))
                with self.when((mine & next_lane.lt(n)).name):
                    lane.value = next_lane
                    self._add(loop.load, i=next_lane.name, mask="true")
                    self._begin(*(self.given("f", name) for name in loop.ray))
                taken.value = taken.value + waiting.to("zext", "L")
                more.value = lane_at(taken.value).lt(n)
                leave(self._ballot(lane.value.ge(0)).eq(0))
                otherwise()
                self._turn(*ballots)

    def _add(self, lines: Sequence[str], **values: str) -> None:
        """Append lines, with values in place of some of their names."""
        names = re.compile(rf"%({'|'.join(values)})\b")
        self.lines += [names.sub(lambda found: values[found[1]], line) for line in lines]

    # -- state

    def _declare(self) -> None:
        """Declare the state of a traversal, and load the words of the scene."""
        # Offsets in the buffer of the node or leaf to test next; below 0: none. Both below 0: the traversal is over.
        self.node, self.leaf = Variable(self, "i"), Variable(self, "i")
        # Number of the leaf's next primitive, its id as the leaf has it, and the least distance of a hit there.
        self.slot, self.id, self.floor = Variable(self, "i"), Variable(self, "i"), Variable(self, "f")
        # The last visited node, and its children left to visit. Nearest hits: three bits each, the next child in the lowest
        # ones, below a bit that marks the end. Any hits: a bit for each child.
        self.parent, self.open, self.top = Variable(self, "i"), Variable(self, "i"), Variable(self, "i")
        self.none_open = 0 if self.any_hit else 1
        self.stack = self.op(f"alloca [{2 * self.search.depth} x i32], align 8")
        # The ray: origin, direction, origin and shear by turned axes, reciprocals of the direction; offsets of near planes in a
        # node, and of corners' components by turned axes in a leaf.
        floats, offsets = ("o", "d", "origin", "shear", "inverse"), ("near", "along")
        self.ray = {
            name: [Variable(self, "f" if name in floats else "i") for _ in range(3)] for name in (*floats, *offsets)
        }
        self.best, self.prim = Variable(self, "f"), Variable(self, "i")
        # u and v are quotients, divided once at the end.
        self.u, self.v, self.over_u, self.over_v = (Variable(self, "f") for _ in range(4))
        self.tables = {
            name: self.load_pointer(self.at("%search", "i64", k), invariant=True)
            for k, name in enumerate(self.table_names)
        }
        self.first_id = {name: self._word(k) for k, name in enumerate(_FIRST_IDS)}

    def _word(self, k: int) -> Value:
        """Load word ``k`` of those behind the addresses of tables, to an int32."""
        return self.read("L", "%search", len(self.table_names) + k).to("trunc", "i")

    def _begin(self, ox: Value, oy: Value, oz: Value, dx: Value, dy: Value, dz: Value, t_max: Value) -> None:
        """Begin the traversal of a ray at the root; a ray that is not finite, or ends before it begins, is over at once."""
        zero = ox * 0.0 + oy * 0.0 + oz * 0.0 + dx * 0.0 + dy * 0.0 + dz * 0.0
        valid = t_max.gt(0.0) & zero.eq(0.0)
        self._set_ray((ox, oy, oz), (dx, dy, dz))
        self.node.value = valid.select(self.number("i", 0), -1)
        self.leaf.value = self.prim.value = -1
        self.open.value = self.none_open
        self.parent.value = self.top.value = 0
        self.best.value = t_max
        self.u.value = self.v.value = 0.0
        self.over_u.value = self.over_v.value = 1.0

    def _set_ray(self, o: Sequence[Value], d: Sequence[Value]) -> None:
        """Set the ray, and what tests of boxes and primitives use of it."""
        # Axes in the order of Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection" (2013): the longest one last.
        x, y, z = map(abs, d)
        on_x, on_y = x.ge(y) & x.ge(z), y.ge(z)

        def turned(of: Sequence[Value]) -> tuple[Value, ...]:
            """Return the components of a vector in this order."""
            return tuple(on_x.select(of[k - 2], on_y.select(of[k - 1], of[k])) for k in range(3))

        d0, d1, d2 = turned(d)
        starts = turned((self.number("i", 0), self.number("i", WIDTH), self.number("i", 2 * WIDTH)))
        # Reciprocals that are never infinite.
        least = _greater(abs(d2) * 1e-20, self.number("f", 1e-37))
        inverse = [
            self.number("f", 1.0) / size.ge(least).select(c, least.call("llvm.copysign", c))
            for size, c in zip((x, y, z), d, strict=True)
        ]
        near = self._near(inverse)
        shear = (d0 / d2, d1 / d2, self.number("f", 1.0) / d2)
        given = {"o": o, "d": d, "origin": turned(o), "shear": shear, "inverse": inverse, "near": near, "along": starts}
        for name, components in given.items():
            for variable, component in zip(self.ray[name], components, strict=True):
                variable.value = component

    def _near(self, inverse: Sequence[Value]) -> list[Value]:
        """Return the offsets of near planes in a node, from the reciprocals of the direction."""
        return [x.gt(0.0).select(self.number("i", k * WIDTH), (k + 3) * WIDTH) for k, x in enumerate(inverse)]

    def _is_over(self) -> Value:
        """Return whether the traversal is over, or has not begun."""
        return self.node.value.lt(0) & self.leaf.value.lt(0)

    def _end(self) -> None:
        """End a traversal whose node and leaf are done."""
        self.open.value, self.top.value = self.none_open, 0

    def _ray(self, name: str) -> list[Value]:
        """Return three components of the ray, see :meth:`_declare`."""
        return [variable.value for variable in self.ray[name]]

    def _result(self) -> str:
        """Return the result: whether anything is hit, or ``t, prim, u, v``."""
        hit = self.prim.value.ge(0)
        if self.any_hit:
            return hit.name
        t = hit.select(self.best.value, np.inf)
        parts = (t, self.prim.value, self.u.value / self.over_u.value, self.v.value / self.over_v.value)
        value = "poison"
        for k, part in enumerate(parts):
            value = self.op(f"insertvalue {_HIT} {value}, {self.vector(part.ty)} {part.name}, {k}")
        return value

    # -- turns

    def _needs(self) -> tuple[Value, ...]:
        """Return what the ray may need next, as conditions: a node is to be visited, a leaf to be tested."""
        return self.node.value.ge(0), self.leaf.value.ge(0)

    def _ballots(self) -> list[Value]:
        """Return for each of :meth:`_needs` which threads of the warp have it, as bits; for a CPU its only one."""
        if self.form.threads:
            return [self._ballot(need) for need in self._needs()]
        return [need.to("zext", "i") for need in self._needs()]

    def _turn(self, *ballots: Value) -> None:
        """Write a turn: for the need that most of the warp's threads have; see :meth:`_ballots`."""
        self._visit_or_test(*ballots)
        with self.loop() as leave_boxes:
            leave_boxes(self.node.value.ge(0) | self.leaf.value.ge(0))
            leave_boxes(self.open.value.eq(self.none_open) & self.top.value.eq(0))
            self._next_box()

    def _visit_or_test(self, nodes: Value, leaves: Value) -> None:
        """Visit nodes, or test leaves."""
        nodes, leaves = (threads.call("llvm.ctpop") for threads in (nodes, leaves))
        nodes_next = (nodes * _NODES_FIRST).ge(leaves)
        has_node, has_leaf = self.node.value.ge(0), self.leaf.value.ge(0)
        with self.either(nodes_next) as otherwise:
            with self.when(has_node.name):
                self._visit_node()
            otherwise()
            with self.when(has_leaf.name):
                self._test_primitive()
            for _ in range(_PRIMITIVES - 1 if self.form.threads else 0):
                with self.when(self.leaf.value.ge(0).name):
                    self._test_primitive()

    def _ballot(self, condition: Value) -> Value:
        """Return a bit for each thread of the warp, set where a condition holds."""
        self.declarations.add("declare i32 @llvm.nvvm.vote.ballot.sync(i32, i1)")
        return self.given("i", self.op(f"call i32 @llvm.nvvm.vote.ballot.sync(i32 -1, i1 {condition.name})"))

    def _distances(self, planes: Sequence[Value]) -> list[Value]:
        """Return the distances along the ray of three planes of a box."""
        ray = zip(planes, self._ray("o"), self._ray("inverse"), strict=True)
        return [(plane - c) * inverse for plane, c, inverse in ray]

    def _entry(self, near: Sequence[Value]) -> Value:
        """Return the distance at which the ray enters a box, from the box's near planes."""
        x, y, z = self._distances(near)
        return x.call("llvm.maxnum", y).call("llvm.maxnum", z.call("llvm.maxnum", 0.0))

    def _planes(self, offsets: Sequence[Value], node: Value) -> list[list[Value]]:
        """Load three planes of each of a node's eight boxes."""
        found = []
        for offset in offsets:
            address = self.at(self.tables["tree"], "float", f"i32 {(node + offset).name}")
            numbers = []
            for half in range(2):
                four = self.op(
                    f"load <4 x float>, ptr {self.at(address, 'float', 4 * half)}, align 16, !invariant.load !0"
                )
                numbers += [self.op(f"extractelement <4 x float> {four}, i64 {k}") for k in range(4)]
            found.append([self.given("f", x) for x in numbers])
        return found

    def _visit_node(self) -> None:
        """Test the boxes of a node's children, and go on to the nearest of those that the ray hits."""
        node = self.node.value
        self.node.value = -1
        with self.when(self.open.value.ne(self.none_open).name):
            self._push()
        offsets, best = self._ray("near"), self.best.value
        near = self._planes(offsets, node)
        far = self._planes([self.number("i", (2 * k + 3) * WIDTH) - offset for k, offset in enumerate(offsets)], node)
        hits: list[Value] = []
        entries: list[Value] = []
        for k in range(WIDTH):
            entry = self._entry([planes[k] for planes in near])
            x, y, z = self._distances([planes[k] for planes in far])
            exit_ = x.call("llvm.minnum", y).call("llvm.minnum", z.call("llvm.minnum", best)) * float(SLACK)
            hits.append(entry.le(exit_))
            entries.append(entry)
        self.parent.value = node
        if self.any_hit:
            mask = self.number("i", 0)
            for k, hit in enumerate(hits):
                mask = mask | hit.select(self.number("i", 1 << k), 0)
            self.open.value = mask
            return
        keys = [
            hit.select((entry.to("bitcast", "i") & _ENTRY_BITS) | k, -1)
            for k, (hit, entry) in enumerate(zip(hits, entries, strict=True))
        ]
        for a, b in _COMPARATORS:
            keys[a], keys[b] = keys[a].call("llvm.umin", keys[b]), keys[a].call("llvm.umax", keys[b])
        order = self.number("i", self.none_open)
        for key in reversed(keys[1:]):
            order = key.ge(0).select((order << 3) | (key & 7), order)
        self.open.value = order
        with self.when(keys[0].ge(0).name):
            self._enter(node, keys[0] & 7, (keys[0] & _ENTRY_BITS).to("bitcast", "f"))

    def _push(self) -> None:
        """Push the node with children left to visit."""
        top = self.top.value
        entry = self.at(self.stack, "i32", f"i32 {(top << 1).name}")
        self.do(f"store i32 {self.parent.value.name}, ptr {entry}, align 8")
        self.do(f"store i32 {self.open.value.name}, ptr {self.at(entry, 'i32', 1)}")
        self.top.value = top + 1

    def _pop(self) -> None:
        top = self.top.value - 1
        entry = self.at(self.stack, "i32", f"i32 {(top << 1).name}")
        self.parent.value = self.given("i", self.op(f"load i32, ptr {entry}, align 8"))
        self.open.value = self.given("i", self.op(f"load i32, ptr {self.at(entry, 'i32', 1)}"))
        self.top.value = top

    def _next_box(self) -> None:
        """Go on to the next child that is left to visit, if the ray enters its box before the best hit."""
        with self.when(self.open.value.eq(self.none_open).name):
            self._pop()
        order, node = self.open.value, self.parent.value
        if self.any_hit:
            self.declarations.add("declare i32 @llvm.cttz.i32(i32, i1)")
            child = self.given("i", self.op(f"call i32 @llvm.cttz.i32(i32 {order.name}, i1 true)"))
            rest = order & (order - 1)
        else:
            child, rest = order & 7, order >> 3
        near = [self.read("f", self.tables["tree"], node + child + offset) for offset in self._ray("near")]
        entry = (self._entry(near).to("bitcast", "i") & _ENTRY_BITS).to("bitcast", "f")
        if self.any_hit:
            self.open.value = rest
            self._enter(node, child, entry)
            return
        # The children behind it in the order are no nearer.
        meets = entry.le(self.best.value * float(SLACK))
        self.open.value = meets.select(rest, self.none_open)
        with self.when(meets.name):
            self._enter(node, child, entry)

    def _enter(self, node: Value, child: Value, entry: Value) -> None:
        """Make a child the next node or leaf."""
        code = self.read("i", self.tables["tree"], node + child + CHILDREN)
        # A code counts quarters of lines.
        with self.either(code.ge(0)) as otherwise:
            self.node.value = self._placed(code * (LINE // 4))
            otherwise()
            self._enter_leaf(self._placed((~code & ~3) * (LINE // 4)), entry)

    def _placed(self, offset: Value) -> Value:
        """Return the offset in the buffer of a block, from its offset in the tree."""
        return offset

    def _enter_leaf(self, leaf: Value, entry: Value) -> None:
        """Make a leaf the next one to test."""
        self.leaf.value, self.slot.value = leaf, 0
        self.id.value = self.read("i", self.tables["tree"], leaf + IDS)
        self.floor.value = entry * float(FLOOR)

    # -- primitives

    def _test_primitive(self) -> None:
        """Test the next primitive of a leaf."""
        leaf, slot, id_ = self.leaf.value, self.slot.value, self.id.value
        self._intersect(leaf + slot, id_)
        last = slot.eq(WIDTH - 1)
        following = self.read("i", self.tables["tree"], leaf + IDS + last.select(slot, slot + 1))
        self.slot.value, self.id.value = slot + 1, following
        done = last | following.eq(-1)
        if self.any_hit:
            done = done | self.prim.value.ge(0)
        self.leaf.value = done.select(self.number("i", -1), leaf)
        if self.any_hit:
            with self.when(self.prim.value.ge(0).name):
                self._end()

    def _intersect(self, place: Value, id_: Value) -> None:
        """Intersect the primitive at a place of a leaf; there is code only for the kinds that the scene has."""
        kinds = self.search.kinds
        if kinds == ("triangle",):
            self._triangle(place, id_)
            return
        if "triangle" in kinds:
            with self.when(id_.ge(0).name):
                self._triangle(place, id_)
        prim = self.number("i", -2) - id_  # negative for a triangle
        if "rectangle" in kinds:
            with self.when((prim.ge(0) & prim.lt(self.first_id["disk"])).name):
                self._rectangle(place + RECTANGLES, prim)
        for kind, end, test in (
            ("disk", "sphere", self._disk),
            ("sphere", "quadric", self._sphere),
            ("quadric", None, self._quadric),
        ):
            if kind in kinds:
                here = prim.ge(self.first_id[kind])
                with self.when((here if end is None else here & prim.lt(self.first_id[end])).name):
                    test(prim)

    def _corner(self, place: Value, number: int) -> tuple[Value, Value, Value]:
        """Return a corner relative to the origin in sheared space, the first of whose numbers is at ``place``."""
        tree, first = self.tables["tree"], place + 3 * WIDTH * number
        x, y, z = (
            self.read("f", tree, first + offset) - c
            for offset, c in zip(self._ray("along"), self._ray("origin"), strict=True)
        )
        shear_x, shear_y, _ = self._ray("shear")
        return x - shear_x * z, y - shear_y * z, z

    def _plane(self, place: Value) -> Value:
        """Return the distance along the ray of a plane whose numbers begin at ``place``."""
        n0, n1, n2, n3 = (self.read("f", self.tables["tree"], place + WIDTH * k) for k in range(4))
        o, d = self._ray("o"), self._ray("d")
        away = n0 * o[0] + n1 * o[1] + n2 * o[2] + n3
        return -away / (n0 * d[0] + n1 * d[1] + n2 * d[2])

    def _triangle(self, place: Value, id_: Value) -> None:
        """Test a triangle by its edge functions, without any tolerance."""
        ax, ay, za = self._corner(place, 0)
        bx, by, zb = self._corner(place, 1)
        cx, cy, zc = self._corner(place, 2)
        e, f, g = cx * by - cy * bx, ax * cy - ay * cx, bx * ay - by * ax
        low, high = _lesser(_lesser(e, f), g), _greater(_greater(e, f), g)
        det = e + f + g
        with self.when(((low.ge(0.0) | high.le(0.0)) & det.ne(0.0)).name):
            plane = self._plane(place + PLANES)
            za, zb, zc = (z * self._ray("shear")[2] for z in (za, zb, zc))
            t = _lesser(_greater(plane, _lesser(_lesser(za, zb), zc)), _greater(_greater(za, zb), zc))
            self._accept(t, self._triangle_id(id_), plane.eq(plane) & t.gt(0.0), (f, det), (g, det))

    def _triangle_id(self, id_: Value) -> Value:
        """Return the id of a primitive, from a triangle's id in its leaf."""
        return id_

    def _rectangle(self, place: Value, prim: Value) -> None:
        """Test a rectangle, by the operations of :func:`torchpt.search.leaf.distances`."""
        plane = self._plane(place + RULED)
        (ax, ay, az), (bx, by, bz), (cx, cy, cz), (qx, qy, qz) = (self._corner(place, k) for k in range(4))
        az, bz, cz, qz = (z * self._ray("shear")[2] for z in (az, bz, cz, qz))
        f, g = ax * cy - ay * cx, bx * ay - by * ax
        h, k = qx * by - qy * bx, cx * qy - cy * qx
        low, high = _lesser(_lesser(f, g), _lesser(h, k)), _greater(_greater(f, g), _greater(h, k))
        across, along = f + h, g + k
        det = _lesser(abs(across), abs(along))
        met = (low.ge(0.0) | high.le(0.0)) & det.ne(0.0) & plane.eq(plane)
        near, far = (choose(choose(choose(az, bz), cz), qz) for choose in (_lesser, _greater))
        t = _lesser(_greater(plane, near), far)
        self._accept(t, prim, met & t.gt(0.0), (f, across), (g, along))

    def _row(self, table: str, first: Value, x: Sequence[Value]) -> Value:
        """Multiply the row of an affine map that begins at ``first`` with a point, or its linear part with a direction."""
        ty = x[0].ty
        a, b, c = (self.read(ty, self.tables[table], first + k) for k in range(3))
        return a * x[0] + b * x[1] + c * x[2]

    def _disk(self, prim: Value) -> None:
        """Test a disk, a plane with the rows of its u and v."""
        first = (prim - self.first_id["rectangle"]) * 12
        c0, c1, c2 = (self.read("f", self.tables["rows"], first + k) for k in (3, 7, 11))
        plane = -(self._row("rows", first, self._ray("o")) + c0) / self._row("rows", first, self._ray("d"))
        p = [o + plane * d for o, d in zip(self._ray("o"), self._ray("d"), strict=True)]
        u, v = self._row("rows", first + 4, p) + c1, self._row("rows", first + 8, p) + c2
        met = plane.gt(0.0) & plane.lt(np.inf) & (u * u + v * v).le(1.0)
        one = self.number("f", 1.0)
        self._accept(plane, prim, met, (u, one), (v, one))

    def _doubled(self, x: Sequence[Value]) -> list[Value]:
        return [c.to("fpext", "d") for c in x]

    def _sphere(self, prim: Value) -> None:
        """Test a sphere in float64, see ``sphere_distance`` of ``scripts/kernel_sources/tree_leaf.py``."""
        first = (prim - self.first_id["rectangle"]) * 12
        *centre, radius = self._doubled([self.read("f", self.tables["corner"], first + k) for k in range(4)])
        f = [o - c for o, c in zip(self._doubled(self._ray("o")), centre, strict=True)]
        e = self._doubled(self._ray("d"))
        a, b = _dot(e, e), -_dot(f, e)
        s = b / a
        off = [x + s * y for x, y in zip(f, e, strict=True)]
        root = (a * (radius * radius - _dot(off, off))).call("llvm.sqrt")  # NaN for a miss
        q = b + b.ge(0.0).select(root, -root)
        near, far = (_dot(f, f) - radius * radius) / q, q / a
        first_is_near = near.lt(far)
        low, high = first_is_near.select(near, far), first_is_near.select(far, near)
        t = low.gt(0.0).select(low, high).to("fptrunc", "f")
        zero, one = self.number("f", 0.0), self.number("f", 1.0)
        self._accept(t, prim, t.gt(0.0), (zero, one), (zero, one))

    def _quadric(self, prim: Value) -> None:
        """Test a quadric in its own space in float64, by the operations of :func:`torchpt.search.leaf.quadric`."""
        first = (prim - self.first_id["quadric"]) * 19
        numbers = {k: self.read("d", self.tables["quadrics"], first + k) for k in (3, 7, 11, *range(12, 19))}
        o, d = self._doubled(self._ray("o")), self._doubled(self._ray("d"))
        fx, fy, fz = (self._row("quadrics", first + 4 * k, o) + numbers[4 * k + 3] for k in range(3))
        ex, ey, ez = (self._row("quadrics", first + 4 * k, d) for k in range(3))
        bend, level, shift, low, high, around, half = (numbers[k] for k in range(12, 19))
        wz = fz - shift
        a = ex * ex + ey * ey + bend * (ez * ez)
        b = -(fx * ex + fy * ey + bend * (wz * ez))
        c = fx * fx + fy * fy + bend * (wz * wz) - level
        cx, cy, cz = fy * ez - wz * ey, wz * ex - fx * ez, fx * ey - fy * ex
        disc = level * a - (bend * (cx * cx + cy * cy) + cz * cz)
        bent = half.ne(0.0)  # a paraboloid: x + 0 is x for all others, but for -0
        b = bent.select(b - half * ez, b)
        c = bent.select(c + half * 2.0 * wz, c)
        disc = bent.select(disc + half * (half * (ez * ez) + (ey * cx - ex * cy) * 2.0), disc)
        root = disc.call("llvm.sqrt")  # NaN for a miss
        q = b + b.ge(0.0).select(root, -root)
        t1, t2 = c / q, q / a
        good1, good2 = (
            t.gt(0.0) & t.lt(np.inf) & z.ge(low) & z.le(high) for t, z in ((t1, fz + t1 * ez), (t2, fz + t2 * ez))
        )
        t = (good1 & ~(good2 & t2.lt(t1))).select(t1, t2)
        x, y, z = fx + t * ex, fy + t * ey, fz + t * ez
        # u and v: position on a square around the axis, and z; or on an octahedron (``around``).
        size = abs(x) + abs(y)
        share = size.gt(0.0).select(abs(x) / size, 1.0)
        one = self.number("d", 1.0)
        angle = x.ge(0.0).select(one - share, one + share) * one.call("llvm.copysign", y)
        size = size + abs(z)
        u, v = x / size, y / size
        below = z.lt(0.0)
        u, v = (
            below.select((one - abs(v)) * one.call("llvm.copysign", u), u),
            below.select((one - abs(u)) * one.call("llvm.copysign", v), v),
        )
        plain = around.eq(0.0)
        u, v = (x.to("fptrunc", "f") for x in (plain.select(angle, u), plain.select(z, v)))
        t, single = t.to("fptrunc", "f"), self.number("f", 1.0)
        self._accept(t, prim, (good1 | good2) & t.gt(0.0), (u, single), (v, single))

    def _accept(self, t: Value, id_: Value, ahead: Value, u: tuple[Value, Value], v: tuple[Value, Value]) -> None:
        """Keep a hit if it is nearer than the best one; ``u`` and ``v`` are quotients."""
        t, best = _greater(t, self.floor.value), self.best.value
        if self.any_hit:
            with self.when((ahead & t.lt(best)).name):
                self.prim.value = id_
            return
        nearer = t.lt(best) | (t.eq(best) & id_.lt(self.prim.value))
        with self.when((ahead & nearer).name):
            self.best.value, self.prim.value = t, id_
            self.u.value, self.over_u.value = u
            self.v.value, self.over_v.value = v
