"""Generate LLVM instructions for the nodes of a graph.

:func:`generate_node` calls the handler of the node's operation: ``handler(block, ty, *values, extra)``. ``ty`` is the node's
type (:mod:`torchpt.compiler.graph`), ``values`` are the LLVM registers of its arguments, ``extra`` are its constants, if it has
any; a handler returns the register of the result. ``block.op(text)`` appends an instruction and returns its register,
``block.each("i32")`` is the LLVM type of one i32 a lane, ``block.vector(ty)`` that of a value of type ``ty``. Names of
registers such as ``%table0`` are those that :mod:`torchpt.compiler.kernel` loads.
"""

from __future__ import annotations

from collections.abc import Callable

from torchpt.compiler.block import ELEMENTS, Block
from torchpt.compiler.form import Form
from torchpt.compiler.functions import FUNCTIONS
from torchpt.compiler.graph import FLOATS, Graph, Unsupported

__all__ = ["MEMORY", "LoopBody", "generate_node"]

#: LLVM type of an element in tables and in the arena, by node type; see :func:`torchpt.compiler.program.bind_tables`.
MEMORY = {"f": "float", "d": "double", "i": "i32", "l": "i32", "L": "i32", "u": "i32", "b": "i32"}

#: LLVM's predicates of a comparison: of floats, and of signed integers. NaN compares as in torch.
_COMPARISONS = {
    "gt": ("ogt", "sgt"),
    "lt": ("olt", "slt"),
    "ge": ("oge", "sge"),
    "le": ("ole", "sle"),
    "eq": ("oeq", "eq"),
    "ne": ("une", "ne"),
}


class LoopBody(Block):
    """A builder for the body of a kernel's loop.

    Attributes:
        listed: True: lanes are read at the indices of a list; False: all lanes in order.
        products: the product that is fused into each sum, both as nodes; see :func:`torchpt.compiler.fusing.fused_products`.
    """

    def __init__(self, form: Form, listed: bool, products: dict[int, int]) -> None:
        super().__init__(form)
        self.listed, self.products = listed, products


def generate_node(block: LoopBody, graph: Graph, node: int, names: dict[int, str]) -> str:
    """Write the instructions of one node and return the name of its value; ``names`` maps its arguments to their values."""
    op, ty, arguments, extra = graph.nodes[node]
    if node in block.products:
        return _fused(block, graph, node, names)
    a = [names[k] for k in arguments]
    types = [graph.type(k) for k in arguments]
    if op == "const":
        return block.constant(ty, graph.value(node))
    if op in FUNCTIONS:
        return FUNCTIONS[op](block, ty, *a)
    if op in _COMPARISONS:
        return _comparison(block, op, types[0], *a)
    if op == "cast":
        return _cast(block, types[0], ty, a[0])
    if op == "retype":
        return a[0]
    if op == "select":
        return block.select(ty, *a)
    handler = _HANDLERS.get(op)
    if handler is None:
        raise Unsupported(f"the operation {op} on numbers of type {ty}")
    value = handler(block, ty, *a) if extra is None else handler(block, ty, *a, extra)
    return _byte(block, value) if ty == "u" and op in _CARRIES else value


def _fused(block: LoopBody, graph: Graph, node: int, names: dict[int, str]) -> str:
    """Compute ``a b + c``, ``a b - c`` or ``c - a b``, rounded once."""
    op, ty, terms, _ = graph.nodes[node]
    product = block.products[node]
    first = terms[0] == product
    a, b = (names[k] for k in graph.nodes[product][2])
    c = names[terms[1] if first else terms[0]]
    if op == "sub" and first:
        c = block.negative(ty, c)
    elif op == "sub":
        a = block.negative(ty, a)
    return block.fma(ty, a, b, c)


#: Operations on uint8 (held in 32 bits) whose result may need more than eight bits.
_CARRIES = ("add", "sub", "mul", "shl", "neg", "xor", "floordiv", "truncdiv", "remainder", "fmod")


def _byte(block: Block, a: str) -> str:
    """Keep the lowest eight bits of a uint8 held in 32 bits."""
    return block.binary("and", "u", a, block.constant("u", 255))


def _comparison(block: Block, op: str, ty: str, a: str, b: str) -> str:
    if ty == "b":
        return block.compare(_COMPARISONS[op][1].replace("s", "u"), ty, a, b)  # i1 true is -1 in signed comparisons
    return block.compare(_COMPARISONS[op][ty not in FLOATS], ty, a, b)


def _cast(block: Block, source: str, target: str, a: str) -> str:
    if target == "b":
        return block.compare("une" if source in FLOATS else "ne", source, a, block.constant(source, 0))
    if source == "b":
        return block.select(target, a, block.constant(target, 1), block.constant(target, 0))
    if source in FLOATS and target in FLOATS:
        return block.convert("fpext" if target == "d" else "fptrunc", source, target, a)
    if source in FLOATS:
        number = block.to_integer(source, target, a)
        return _byte(block, number) if target == "u" else number
    if target in FLOATS:
        return block.convert("sitofp", source, target, a)
    if target == "L":
        return block.convert("sext", source, target, a)
    if source == "L":
        a = block.convert("trunc", source, target, a)
    return _byte(block, a) if target == "u" else a


def _arithmetic(op: str) -> Callable[..., str]:
    """Return the handler of a sum, difference or product; of booleans, as in torch, ``or`` and for products ``and``."""

    def handler(block: Block, ty: str, a: str, b: str) -> str:
        if ty == "b":
            return block.op(f"{'and' if op == 'mul' else 'or'} {block.each('i1')} {a}, {b}")
        return getattr(block, op)(ty, a, b)

    return handler


def _bits(op: str) -> Callable[..., str]:
    def handler(block: Block, ty: str, a: str, b: str) -> str:
        return block.op(f"{op} {block.vector(ty)} {a}, {b}")

    return handler


def _shift(op: str) -> Callable[..., str]:
    """Return a handler of shifts; shifts by more than the width, or negative ones, give 0 or the sign, as in torch."""

    def handler(block: Block, ty: str, a: str, b: str) -> str:
        most = block.constant(ty, 63 if ty == "L" else 31)
        far = block.compare("ugt", ty, b, most)
        shifted = block.op(f"{op} {block.vector(ty)} {a}, {block.select(ty, far, most, b)}")
        return shifted if op == "ashr" else block.select(ty, far, block.constant(ty, 0), shifted)

    return handler


def _intrinsic(name: str) -> Callable[..., str]:
    def handler(block: Block, ty: str, *a: str) -> str:
        if ty not in FLOATS:
            return a[0]  # integers stay as they are
        return block.call(name, ty, *a)

    return handler


def _abs(block: Block, ty: str, a: str) -> str:
    if ty in FLOATS:
        return block.call("llvm.fabs", ty, a)
    return block.select(ty, block.compare("slt", ty, a, block.constant(ty, 0)), block.negative(ty, a), a)


def _sign(block: Block, ty: str, a: str) -> str:
    if ty == "b":
        return a
    zero = block.constant(ty, 0)
    up, down = ("ogt", "olt") if ty in FLOATS else ("sgt", "slt")
    sign = block.select(ty, block.compare(up, ty, a, zero), block.constant(ty, 1), zero)
    return block.select(ty, block.compare(down, ty, a, zero), block.constant(ty, -1), sign)


def _quotient(block: Block, ty: str, a: str, b: str, rounding: str) -> str:
    """Divide 32-bit integers, with LLVM's ``rounding`` (floor, trunc).

    The division is done in float64, where it is exact after rounding, as CPUs have no integer division of vectors.
    """
    x, y = (block.convert("sitofp", ty, "d", v) for v in (a, b))
    q = block.call(f"llvm.{rounding}", "d", block.div("d", x, y))
    return block.to_integer("d", ty, q)


def _wide_quotient(block: Block, a: str, b: str) -> tuple[str, str]:
    """Return the floored quotient and the remainder of 64-bit integers.

    A quotient in float64 is off by up to 2^10, so the remainder is divided once more. Divisors must fit in 62 bits.
    """
    x, y = (block.convert("sitofp", "L", "d", v) for v in (a, b))

    def floored(top: str) -> str:
        return block.to_integer("d", "L", block.call("llvm.floor", "d", block.div("d", top, y)))

    q = floored(x)
    r = block.sub("L", a, block.mul("L", q, b))
    q = block.add("L", q, floored(block.convert("sitofp", "L", "d", r)))
    r = block.sub("L", a, block.mul("L", q, b))
    zero, one = block.constant("L", 0), block.constant("L", 1)
    # The remainder has the divisor's sign, and is smaller.
    low = block.op(
        f"and {block.each('i1')} {block.compare('ne', 'L', r, zero)}, "
        + block.compare("slt", "L", block.op(f"xor {block.vector('L')} {r}, {b}"), zero)
    )
    q, r = block.select("L", low, block.sub("L", q, one), q), block.select("L", low, block.add("L", r, b), r)
    high = block.compare("sge", "L", _abs(block, "L", r), _abs(block, "L", b))
    return block.select("L", high, block.add("L", q, one), q), block.select("L", high, block.sub("L", r, b), r)


def _floordiv(block: Block, ty: str, a: str, b: str) -> str:
    if ty not in FLOATS:
        return _wide_quotient(block, a, b)[0] if ty == "L" else _quotient(block, ty, a, b, "floor")
    # As in Python and torch: the exact quotient rounded down, not the rounded quotient; 1 // 0.1 is 9.
    zero, one = block.constant(ty, 0.0), block.constant(ty, 1.0)
    r = _fmod(block, ty, a, b)
    q = block.div(ty, block.sub(ty, a, r), b)  # an integer up to rounding
    q = block.select(ty, _against(block, ty, r, b), block.sub(ty, q, one), q)
    floored = block.call("llvm.floor", ty, q)
    up = block.compare("ogt", ty, block.sub(ty, q, floored), block.constant(ty, 0.5))
    floored = block.select(ty, up, block.add(ty, floored, one), floored)
    # a quotient of 0 has the sign of a / b, and a division by 0 gives what a / b gives
    quotient = block.div(ty, a, b)
    signed_zero = block.call("llvm.copysign", ty, zero, quotient)
    floored = block.select(ty, block.compare("oeq", ty, q, zero), signed_zero, floored)
    return block.select(ty, block.compare("oeq", ty, b, zero), quotient, floored)


def _truncdiv(block: Block, ty: str, a: str, b: str) -> str:
    if ty in FLOATS:
        return block.call("llvm.trunc", ty, block.div(ty, a, b))
    if ty != "L":
        return _quotient(block, ty, a, b, "trunc")
    q, r = _wide_quotient(block, a, b)
    zero, one = block.constant("L", 0), block.constant("L", 1)
    up = block.op(
        f"and {block.each('i1')} {block.compare('ne', 'L', r, zero)}, "
        + block.compare("slt", "L", block.op(f"xor {block.vector('L')} {a}, {b}"), zero)
    )
    return block.select("L", up, block.add("L", q, one), q)


def _remainder(block: Block, ty: str, a: str, b: str) -> str:
    """Return the remainder of the floored quotient; it has the sign of the divisor."""
    if ty == "L":
        return _wide_quotient(block, a, b)[1]
    if ty not in FLOATS:
        return block.sub(ty, a, block.mul(ty, _quotient(block, ty, a, b, "floor"), b))
    r = _fmod(block, ty, a, b)
    return block.select(ty, _against(block, ty, r, b), block.add(ty, r, b), r)


def _against(block: Block, ty: str, r: str, b: str) -> str:
    """Return a mask: a float remainder is not 0 and differs in sign from the divisor."""
    zero = block.constant(ty, 0.0)
    other = block.op(f"xor {block.each('i1')} {block.compare('olt', ty, r, zero)}, {block.compare('olt', ty, b, zero)}")
    return block.op(f"and {block.each('i1')} {other}, {block.compare('une', ty, r, zero)}")


def _fmod(block: Block, ty: str, a: str, b: str) -> str:
    if ty in FLOATS and block.form.threads:
        return block.op(f"call {block.vector(ty)} @fmod_{ty}({block.vector(ty)} {a}, {block.vector(ty)} {b})")
    if ty in FLOATS:
        return block.op(f"frem {block.vector(ty)} {a}, {b}")
    return block.sub(ty, a, block.mul(ty, _truncdiv(block, ty, a, b), b))


def _gather(block: Block, ty: str, index: str, extra: tuple[int, int, int]) -> str:
    """Load component ``k`` of ``width`` of entry ``index`` of a table; indices out of range read the last entry."""
    table, width, k = extra
    index = block.call("llvm.umin", "i", index, f"%last{table}")
    if width != 1:
        index = block.mul("i", index, block.constant("i", width))
    element = MEMORY[ty]
    pointer = block.at(f"%table{table}", element, k) if k else f"%table{table}"
    return _from_memory(block, ty, block.gather(element, pointer, index, invariant=True))


def _from_memory(block: Block, ty: str, stored: str) -> str:
    if ty == "b":
        return block.op(f"icmp ne {block.each('i32')} {stored}, zeroinitializer")
    return block.convert("sext", "i", "L", stored) if ty == "L" else stored


def _scalar(block: Block, ty: str, pointer: str, place: int) -> str:
    """Load element ``place`` of a table or uniform and broadcast it to all lanes."""
    value = block.load(MEMORY[ty], block.at(pointer, MEMORY[ty], place))
    if ty == "b":
        value = block.op(f"trunc i32 {value} to i1")
    elif ty == "L":
        value = block.op(f"sext i32 {value} to i64")
    return block.splat(ty, value)


def _search(block: Block, ty: str, value: str, extra: tuple[int, str, bool]) -> str:
    """Count the entries of a sorted table that are below a value (``right``: not above it), by a call of a binary search.

    ``extra`` is the number of the table, its node type, and ``right``.
    """
    table, table_ty, right = extra
    name = f"@sorted_{table_ty}_{'right' if right else 'left'}"
    vector = block.vector(table_ty)
    return block.op(f"call {block.each('i32')} {name}(ptr %table{table}, i64 %count{table}, {vector} {value})")


def _occluded(block: Block, ty: str, *ray: str) -> str:
    """Test a ray, the values o, d (three components each) and t_max, for any hit (:mod:`torchpt.compiler.packet`)."""
    typed = ", ".join(f"{block.each('float')} {x}" for x in ray)
    return block.op(f"call {block.each('i1')} @occluded({typed}, ptr %search)")


def _nearest(block: Block, ty: str, *ray: str) -> str:
    """Find the nearest hit of a ray, as a struct of t, prim, u, v; arguments as for :func:`_occluded`."""
    typed = ", ".join(f"{block.each('float')} {x}" for x in ray)
    return block.op(f"call {{{_hit(block)}}} @nearest({typed}, ptr %search)")


def _hit(block: Block) -> str:
    """Return the LLVM types of t, prim, u, v."""
    return ", ".join(map(block.each, ("float", "i32", "float", "float")))


def _part(block: Block, ty: str, a: str, extra: int) -> str:
    """Take element ``extra`` of the result of :func:`_nearest`."""
    return block.op(f"extractvalue {{{_hit(block)}}} {a}, {extra}")


def _iota(block: Block, ty: str) -> str:
    """Return the number of the lane in this call of the kernel."""
    places = block.places("%i")
    return block.convert("sext", "i", "L", places) if ty == "L" else _cast(block, "i", ty, places)


def _place(block: LoopBody, ty: str) -> str:
    """Return the index of the lane in the arena."""
    return "%place" if block.listed else _iota(block, ty)


def _arena(block: LoopBody, ty: str, extra: int) -> str:
    """Load row ``extra`` of the source arena at the lane's index."""
    element = MEMORY[ty]
    if block.listed:
        stored = block.gather(element, f"%row{extra}", "%place")
    else:
        stored = block.op(f"load {block.each(element)}, ptr {block.at(f'%row{extra}', element, '%i')}, align 4")
    return _from_memory(block, ty, stored)


def _slot(block: Block, ty: str, place: str, extra: int) -> str:
    """Load row ``extra`` of the slots at index ``place``."""
    element = MEMORY[ty]
    start = block.at("%slots", element, block.op(f"mul i64 %stride, {extra}")) if extra else "%slots"
    # The index comes from the arena, whose rows hold any number behind the last lane.
    return _from_memory(block, ty, block.gather(element, start, place, mask="%mask"))


def _segment(block: Block, ty: str, first: str, end: str, start: str) -> str:
    """Add a segment of the slots to ``start``, see :mod:`torchpt.compiler.segments`."""
    real = ELEMENTS[ty]
    return block.op(f"call {real} @segment_{ty}(ptr %slots, i32 {first}, i32 {end}, {real} {start})")


def _tensor(block: Block, ty: str, extra: tuple[int, int]) -> str:
    """Load row ``k`` of input tensor ``slot`` at the lane's number; ``%in0s`` is the length of the rows of ``%in0``."""
    slot, k = extra
    element = {"l": "i64", "L": "i64", "b": "i8", "u": "i8"}.get(ty, ELEMENTS[ty])
    size = {"i64": 8, "double": 8, "i8": 1}.get(element, 4)
    row = block.at(f"%in{slot}", "i8", block.op(f"mul i64 %in{slot}s, {k * size}")) if k else f"%in{slot}"
    stored = block.masked_load(element, block.at(row, element, "%i"), "%mask")
    if element == "i64":
        return stored if ty == "L" else block.op(f"trunc {block.each('i64')} {stored} to {block.each('i32')}")
    if ty == "b":
        return block.op(f"icmp ne {block.each('i8')} {stored}, zeroinitializer")
    return block.op(f"zext {block.each('i8')} {stored} to {block.each('i32')}") if ty == "u" else stored


#: The handler of each operation. `extra` of those that have it: gather (table, numbers an entry, component), element (table,
#: index), uniform (uniform, index), search (table, its type, right), part (index), arena and slot (row), tensor
#: (tensor, row).
_HANDLERS: dict[str, Callable[..., str]] = {
    "bitreverse": lambda block, ty, a: block.call("llvm.bitreverse", ty, a),
    "add": _arithmetic("add"),
    "sub": _arithmetic("sub"),
    "mul": _arithmetic("mul"),
    "div": lambda block, ty, a, b: block.div(ty, a, b),
    "and": _bits("and"),
    "or": _bits("or"),
    "xor": _bits("xor"),
    "ashr": _shift("ashr"),
    "shl": _shift("shl"),
    "max": lambda block, ty, a, b: block.extreme("max", ty, a, b),
    "min": lambda block, ty, a, b: block.extreme("min", ty, a, b),
    "neg": lambda block, ty, a: block.negative(ty, a),
    "abs": _abs,
    "sign": _sign,
    "sqrt": _intrinsic("llvm.sqrt"),
    "floor": _intrinsic("llvm.floor"),
    "ceil": _intrinsic("llvm.ceil"),
    "round": _intrinsic("llvm.rint"),  # to even, as torch does
    "trunc": _intrinsic("llvm.trunc"),
    "copysign": _intrinsic("llvm.copysign"),
    "floordiv": _floordiv,
    "truncdiv": _truncdiv,
    "remainder": _remainder,
    "fmod": _fmod,
    "gather": _gather,
    "element": lambda block, ty, extra: _scalar(block, ty, f"%table{extra[0]}", extra[1]),
    "uniform": lambda block, ty, extra: _scalar(block, ty, f"%uniform{extra[0]}", extra[1]),
    "search": _search,
    "occluded": _occluded,
    "nearest": _nearest,
    "part": _part,
    "iota": _iota,
    "place": _place,
    "arena": _arena,
    "slot": _slot,
    "tensor": _tensor,
    "segment": _segment,
}
