"""A machine that runs PTX on numpy arrays, for tests of kernels where there is no GPU.

Arithmetic is IEEE 754's with one rounding an instruction, as PTX specifies for ``.rn``. All threads of a grid run together,
by basic blocks: of the blocks that threads stand at, the first in an order in which a block follows all that lead to it is
run by the threads that stand there. So threads that a branch has parted meet again where their paths join. Votes and
shuffles are run by whole warps. The order of atomic additions, and what registers hold before they are written, is random.

An access outside of the memory that a launch may use, a misaligned one, a store to constant memory, a vote that some threads
of a warp never come to, and an instruction that the machine does not know are errors.

What the machine does not model: weakly ordered memory (each instruction is over before the next begins), time, and ``ptxas``.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchpt.compiler import cpu

__all__ = ["DeviceMemory", "PtxMachine"]

WARP = 32

Array = np.ndarray[Any, Any]
#: Threads that run a block: their numbers, or None for all threads of the grid.
Threads = Array | None
_Read = Callable[[list[Array], Threads], Any]
_Write = Callable[[list[Array], Threads, Any], None]
_Run = Callable[["PtxMachine", list[Array], Threads], None]


# ---- Memory: arrays of the host, by their addresses


@dataclass
class _Region:
    start: int
    end: int
    bytes: Array
    constant: bool

    def words(self, dtype: Any) -> tuple[Array, int]:
        """Return the aligned elements of a type, and the address of the first."""
        size = np.dtype(dtype).itemsize
        skipped = -self.start % size
        count = (len(self.bytes) - skipped) // size
        return self.bytes[skipped : skipped + count * size].view(dtype), self.start + skipped


class DeviceMemory:
    """The memory that a launch may use: arrays of the host, at their own addresses."""

    def __init__(self) -> None:
        self._regions: dict[int, _Region] = {}
        self._starts: list[int] = []

    def add(self, array: Array, constant: bool = False) -> int:
        """Make a contiguous array accessible and return its address; ``constant``: stores to it are errors."""
        assert array.flags.c_contiguous
        start = array.ctypes.data
        known = self._regions.get(start)
        if array.nbytes and (known is None or known.end < start + array.nbytes):
            flat = array.reshape(-1).view(np.uint8)
            self._regions[start] = _Region(start, start + array.nbytes, flat, constant)
            self._starts = sorted(self._regions)
        return start

    def load(self, dtype: Any, address: Array) -> Array:
        """Load an element from each address."""
        region = self._region(address, np.dtype(dtype).itemsize, False)
        if region is not None:
            words, first = region.words(dtype)
            return words[(address - np.int64(first)) // words.itemsize]
        found = np.empty(address.shape, dtype)
        for mask in self._parts(address):
            found[mask] = self.load(dtype, address[mask])
        return found

    def store(self, dtype: Any, address: Array, value: Array) -> None:
        """Store an element to each address; of several to one address the last remains."""
        region = self._region(address, np.dtype(dtype).itemsize, True)
        if region is not None:
            words, first = region.words(dtype)
            words[(address - np.int64(first)) // words.itemsize] = value
            return
        for mask in self._parts(address):
            self.store(dtype, address[mask], value[mask])

    def _region(self, address: Array, size: int, written: bool) -> _Region | None:
        """Return the region that all addresses lie in; None if they lie in several."""
        low, high = int(address.min()), int(address.max())
        if (address & (size - 1)).any():
            raise IndexError(f"an access of {size} B at an address that is no multiple of {size}")
        k = bisect_right(self._starts, low) - 1
        region = self._regions[self._starts[k]] if k >= 0 else None
        if region is None or low + size > region.end:
            raise IndexError(f"an access of {size} B outside of memory, at {low:#x}")
        if high + size > region.end:
            if low == high or bisect_right(self._starts, high) - 1 == k:
                raise IndexError(f"an access of {size} B beyond a region that ends at {region.end:#x}, at {high:#x}")
            return None
        if written and region.constant:
            raise IndexError(f"a store to constant memory, at {low:#x}")
        return region

    def _parts(self, address: Array) -> list[Array]:
        numbers = np.searchsorted(self._starts, address, "right")
        return [numbers == number for number in np.unique(numbers)]


# ---- Arithmetic that numpy does not have


_FMA = """define void @kernel(ptr %arguments, i64 %n) {{
entry:
  {loads}
  br label %loop
loop:
  %i = phi i64 [ 0, %entry ], [ %next, %loop ]
  %pa = getelementptr {ty}, ptr %p0, i64 %i
  %pb = getelementptr {ty}, ptr %p1, i64 %i
  %pc = getelementptr {ty}, ptr %p2, i64 %i
  %pr = getelementptr {ty}, ptr %p3, i64 %i
  %a = load {ty}, ptr %pa
  %b = load {ty}, ptr %pb
  %c = load {ty}, ptr %pc
  %r = call {ty} @llvm.fma.{suffix}({ty} %a, {ty} %b, {ty} %c)
  store {ty} %r, ptr %pr
  %next = add i64 %i, 1
  %more = icmp slt i64 %next, %n
  br i1 %more, label %loop, label %exit
exit:
  ret void
}}
declare {ty} @llvm.fma.{suffix}({ty}, {ty}, {ty})
"""


def _fma_of(ty: str, suffix: str) -> Callable[[Array, Array, Array], Array]:
    """Return ``a b + c``, rounded once, by the CPU's own instruction or the C library."""
    loads = "\n  ".join(
        f"%q{k} = getelementptr i64, ptr %arguments, i64 {k}\n  %p{k} = load ptr, ptr %q{k}" for k in range(4)
    )
    call = cpu.compile_ir(_FMA.format(loads=loads, ty=ty, suffix=suffix)).call

    def fma(a: Array, b: Array, c: Array) -> Array:
        a, b, c = (np.ascontiguousarray(x) for x in np.broadcast_arrays(a, b, c))
        found = np.empty_like(a)
        words = np.array([x.ctypes.data for x in (a, b, c, found)], np.int64)
        call(words.ctypes.data, found.size)
        return found

    return fma


def _shift(a: Array, by: Array, left: bool) -> Array:
    """Shift; by the width or more gives 0, or the sign."""
    bits = 8 * a.dtype.itemsize
    by = np.asarray(by).astype(np.uint64)
    far, near = by >= bits, np.minimum(by, np.uint64(bits - 1)).astype(a.dtype)
    if left:
        return np.where(far, a.dtype.type(0), a << near)
    return a >> near if a.dtype.kind == "i" else np.where(far, a.dtype.type(0), a >> near)


def _high_product(a: Array, b: Array) -> Array:
    bits = 8 * a.dtype.itemsize
    a, b = np.broadcast_arrays(a, b)
    whole = [(int(x) * int(y)) >> bits for x, y in zip(a.ravel(), b.ravel(), strict=True)]
    return np.array(whole, a.dtype).reshape(a.shape)


def _reversed_bits(a: Array) -> Array:
    for mask, by in ((0x55555555, 1), (0x33333333, 2), (0x0F0F0F0F, 4), (0x00FF00FF, 8)):
        m, s = np.uint32(mask), np.uint32(by)
        a = ((a >> s) & m) | ((a & m) << s)
    return (a >> np.uint32(16)) | (a << np.uint32(16))


def _bit_field(a: Array, start: Array, length: Array) -> Array:
    """Return some bits of a number, extended by their sign if the type has one."""
    bits = 8 * a.dtype.itemsize
    start, length = np.minimum(start, bits), np.minimum(length, bits)
    length = np.minimum(length, bits - start)
    found = _shift(_shift(a, bits - start - length, True), bits - length, False)
    return np.where(length == 0, a.dtype.type(0), found)


def _leading_zeros(a: Array) -> Array:
    bits = 8 * a.dtype.itemsize
    return np.array([bits - int(x).bit_length() for x in a.ravel().tolist()], np.uint32).reshape(a.shape)


def _extreme(a: Array, b: Array, largest: bool) -> Array:
    """Take the maximum or minimum; a number rather than NaN, and +0 above -0."""
    if np.asarray(a).dtype.kind != "f":
        return np.maximum(a, b) if largest else np.minimum(a, b)
    found = np.fmax(a, b) if largest else np.fmin(a, b)
    negative = np.signbit(a) & np.signbit(b) if largest else np.signbit(a) | np.signbit(b)
    zero = np.asarray(found).dtype.type(0)
    return np.where((a == 0) & (b == 0), np.where(negative, -zero, zero), found)


def _to_integer(value: Array, target: Any) -> Array:
    """Convert whole floats: clamped to the range; NaN as the PTX manual has it for ``cvt``."""
    info, wide = np.iinfo(target), value.astype(np.float64)
    # 2^63 - 1 is no float64: all from 2^63 on is the largest integer.
    inside = np.where((wide >= float(info.min)) & (wide < float(info.max) + (info.bits < 64)), wide, 0.0)
    found = np.where(
        wide <= float(info.min), info.min, np.where(wide >= float(info.max), info.max, inside.astype(target))
    )
    of_nan = 0
    if value.dtype == np.float64 or info.bits == 64:
        of_nan = info.min if info.min < 0 else 1 << (info.bits - 1)
    return np.where(np.isnan(wide), np.array(of_nan, target), found.astype(target))


_BINARY: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "div": lambda a, b: a / b,
    "rem": lambda a, b: a % b,
    "and": lambda a, b: a & b,
    "or": lambda a, b: a | b,
    "xor": lambda a, b: a ^ b,
    "shl": lambda a, b: _shift(a, b, True),
    "shr": lambda a, b: _shift(a, b, False),
    "max": lambda a, b: _extreme(a, b, True),
    "min": lambda a, b: _extreme(a, b, False),
    "copysign": lambda a, b: np.copysign(b, a),  # the sign is the first operand's
}
_UNARY: dict[str, Callable[..., Any]] = {
    "rcp": lambda a: a.dtype.type(1) / a,
    "sqrt": np.sqrt,
    "abs": np.abs,
    "neg": lambda a: -a,
    "not": lambda a: ~a,
    "brev": _reversed_bits,
    "clz": _leading_zeros,
    "popc": lambda a: np.bitwise_count(a).astype(np.uint32),
}
_COMPARED: dict[str, Callable[..., Any]] = {
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "gt": lambda a, b: a > b,
    "ge": lambda a, b: a >= b,
}
_ROUNDED = {"rni": np.rint, "rmi": np.floor, "rpi": np.ceil, "rzi": np.trunc}


# ---- Instructions: PTX text to functions of the registers


_TYPES: dict[str, Any] = {
    "b8": np.uint8, "u8": np.uint8, "s8": np.int8, "b16": np.uint16, "u16": np.uint16, "s16": np.int16,
    "b32": np.uint32, "u32": np.uint32, "s32": np.int32, "f32": np.float32,
    "b64": np.uint64, "u64": np.uint64, "s64": np.int64, "f64": np.float64, "pred": np.bool_,
}  # fmt: skip
_WIDER: dict[Any, Any] = {np.int16: np.int32, np.uint16: np.uint32, np.int32: np.int64, np.uint32: np.uint64}
_UNSIGNED = {1: np.uint8, 2: np.uint16, 4: np.uint32, 8: np.uint64}
_REGISTER = re.compile(r"%[a-z]+\d+")


@dataclass
class _Block:
    """Instructions that threads run together, and where they go then."""

    runs: list[_Run] = field(default_factory=list)
    kinds: Counter[str] = field(default_factory=Counter)
    label: str = ""
    whole_warps: bool = False
    guard: int = -1  # register of the predicate of the branch; -1: always taken
    negated: bool = False
    branch: str | None = None  # label
    ends: bool = False  # by a jump or a return
    taken: int = -1  # numbers of blocks, -1: the thread is done
    next: int = -1


class PtxMachine:
    """A kernel of a PTX text, ready to run.

    Attributes:
        sizes: bytes of each parameter.
        local_bytes: bytes of local memory of a thread.
        registers: number of registers that the text declares, by kind.
        instructions: number of instructions in the text, by kind.
        executed: instructions that threads have run, by kind, over all launches.
        issued: instructions that warps have issued, by kind: one for all threads of a warp that run it together.
    """

    def __init__(self, ptx: str) -> None:
        head, body = ptx[ptx.index(".entry") :].split("{", 1)
        self._parameters: dict[str, int] = {}
        self.sizes: list[int] = []
        end = 0
        for found in re.finditer(
            r"\.param\s+(?:\.align \d+ )?\.(\w+)\s+(?:\.ptr[ .\w]*?)?(\w+)(?:\[(\d+)\])?[,\n]", head
        ):
            self.sizes.append(int(found[3]) if found[3] else np.dtype(_TYPES[found[1]]).itemsize)
            end = -(-end // 8) * 8
            self._parameters[found[2]] = end
            end += self.sizes[-1]
        self._parameter_bytes = end
        self._numbers: dict[str, int] = {}
        self.local_bytes, self._local_name = 0, ""
        self._dtypes: list[Any] = []
        self.registers: Counter[str] = Counter()
        self.executed: Counter[str] = Counter()
        self.issued: Counter[str] = Counter()
        self._fma = {np.float32: _fma_of("float", "f32"), np.float64: _fma_of("double", "f64")}
        self._blocks = self._ordered(self._parsed(body))
        self.instructions: Counter[str] = Counter()
        for block in self._blocks:
            self.instructions.update(block.kinds)

    # -- the text

    def _parsed(self, body: str) -> list[_Block]:
        blocks = [_Block()]
        for raw in body.splitlines():
            line = raw.split("//")[0].strip().rstrip(";")
            if found := re.match(r"\.reg\s+\.(\w+)\s+(%[a-z]+)<(\d+)>", line):
                dtype = np.bool_ if found[1] == "pred" else _UNSIGNED[np.dtype(_TYPES[found[1]]).itemsize]
                for k in range(int(found[3])):
                    self._numbers[f"{found[2]}{k}"] = len(self._dtypes)
                    self._dtypes.append(dtype)
                self.registers[found[1]] += int(found[3])
                continue
            if found := re.match(r"\.reg\s+\.b64\s+(%SPL?)$", line):  # where a thread's local memory begins
                self._numbers[found[1]] = len(self._dtypes)
                self._dtypes.append(np.uint64)
                continue
            if found := re.match(r"\.local\s+\.align \d+ \.b8\s+(\w+)\[(\d+)\]$", line):
                assert not self.local_bytes, line
                self._local_name, self.local_bytes = found[1], int(found[2])
                continue
            if not line or line in "{}" or line.startswith((".pragma", ".loc", ".file")):
                continue
            if line.endswith(":"):
                if blocks[-1].runs or blocks[-1].ends or blocks[-1].label:
                    blocks.append(_Block())
                blocks[-1].label = line[:-1]
                continue
            if line.startswith("."):
                raise NotImplementedError(f"PTX: {line}")
            if blocks[-1].ends:
                blocks.append(_Block())
            self._append(blocks, line)
        return blocks

    def _append(self, blocks: list[_Block], line: str) -> None:
        guard, negated = -1, False
        if found := re.match(r"@(!?)(%p\d+)\s+(.*)$", line):
            guard, negated, line = self._numbers[found[2]], found[1] == "!", found[3]
        word, _, rest = line.partition("\t") if "\t" in line else line.partition(" ")
        op = word.strip().split(".")
        given = [x.strip() for x in re.split(r",\s*(?![^{\[]*[}\]])", rest.strip())] if rest.strip() else []
        block = blocks[-1]
        if "sync" in op and block.runs:
            block = _Block()
            blocks.append(block)
        block.kinds[op[0] + (".f64" if op[-1] == "f64" else "")] += 1
        if op[0] in ("bra", "ret"):
            block.guard, block.negated, block.ends = guard, negated, True
            block.branch = given[-1] if op[0] == "bra" else None
            return
        if guard >= 0:
            raise NotImplementedError(f"PTX: a predicate before {line}")
        block.whole_warps |= "sync" in op
        try:
            block.runs.append(self._instruction(op, given))
        except KeyError as error:
            raise NotImplementedError(f"PTX: {line} ({error})") from None

    def _ordered(self, blocks: list[_Block]) -> list[_Block]:
        """Return the blocks in the order in which threads take them; see the module's text."""
        labels = {block.label: k for k, block in enumerate(blocks) if block.label}
        after: list[list[int]] = []
        for k, block in enumerate(blocks):
            block.taken = labels[block.branch] if block.branch else -1
            block.next = k + 1 if (not block.ends or block.guard >= 0) and k + 1 < len(blocks) else -1
            after.append([x for x in (block.taken, block.next) if x >= 0])
        order = _order_blocks(set(range(len(blocks))), after, 0)
        place = {k: number for number, k in enumerate(order)}
        for block in blocks:
            block.taken, block.next = place.get(block.taken, -1), place.get(block.next, -1)
        return [blocks[k] for k in order]

    # -- operands

    def _reader(self, text: str, dtype: Any) -> _Read:
        size = np.dtype(dtype).itemsize
        if _REGISTER.fullmatch(text) or text in self._numbers:
            k = self._numbers[text]
            own = self._dtypes[k]
            if own is np.bool_ or dtype is np.bool_:
                return lambda R, who: R[k] if who is None else R[k][who]
            if np.dtype(own).itemsize == size:
                return lambda R, who: (R[k] if who is None else R[k][who]).view(dtype)
            assert np.dtype(own).itemsize > size, text  # the low bits
            low = _UNSIGNED[size]
            return lambda R, who: (R[k] if who is None else R[k][who]).astype(low).view(dtype)
        if text.startswith("%"):
            return lambda R, who: (self.special[text] if who is None else self.special[text][who]).astype(dtype)
        if found := re.fullmatch(r"0[fFdD]([0-9A-Fa-f]+)", text):
            value = np.array(int(found[1], 16), _UNSIGNED[len(found[1]) // 2]).view(dtype)[()]
        elif re.fullmatch(r"-?\d+|-?0x[0-9a-fA-F]+", text):
            value = np.array(int(text, 0) % (1 << 8 * size), _UNSIGNED[size]).view(dtype)[()]
        elif text in self._parameters:
            value = np.array(self._parameters[text], _UNSIGNED[size]).view(dtype)[()]
        elif text == self._local_name:
            value = np.dtype(dtype).type(0)  # addresses of local memory are offsets in it
        else:
            raise KeyError(text)
        return lambda R, who: value

    def _writer(self, text: str) -> _Write:
        """Return a writer of a new array, or of a number."""
        k = self._numbers[text]
        own = self._dtypes[k]
        size = np.dtype(own).itemsize

        def write(R: list[Array], who: Threads, value: Any) -> None:
            if own is not np.bool_:
                if value.dtype.itemsize == size:
                    value = value.view(own)
                else:  # extended by its own sign
                    value = value.astype(np.int64 if value.dtype.kind == "i" else np.uint64).astype(own)
            if who is None:
                R[k] = value if value.shape else np.full(R[k].shape, value)
            else:
                R[k][who] = value

        return write

    def _address(self, text: str) -> _Read:
        name, _, offset = text.strip("[]").partition("+")
        base, more = self._reader(name.strip(), np.int64), int(offset or 0)
        return lambda R, who: base(R, who) + np.int64(more)

    # -- instructions

    def _instruction(self, op: list[str], given: list[str]) -> _Run:
        """Return the function that runs an instruction."""
        name, last = op[0], op[-1]
        special = getattr(self, f"_{name}_", None)
        if special is not None:
            return special(op, given)
        dtype = _TYPES[last]
        if np.dtype(dtype).kind == "f" and name in ("add", "sub", "mul", "div", "rcp", "sqrt", "fma"):
            assert op[1] == "rn" and len(op) == 3, op  # rounded to nearest, subnormals kept
        elif name in _BINARY or name in _UNARY:
            assert len(op) == 2 and (name not in ("div", "rem") or np.dtype(dtype).kind == "u"), op
        write = self._writer(given[0])
        if name in ("shl", "shr"):
            function = _BINARY[name]
            a, by = self._reader(given[1], dtype), self._reader(given[2], np.uint32)
            return lambda m, R, who: write(R, who, function(a(R, who), by(R, who)))
        if name == "bfe":
            a, start, length = (self._reader(x, y) for x, y in zip(given[1:], (dtype, np.int32, np.int32), strict=True))
            return lambda m, R, who: write(R, who, _bit_field(a(R, who), start(R, who), length(R, who)))
        reads = [self._reader(x, dtype) for x in given[1:]]
        if name == "fma":
            fma = self._fma[dtype]
            return lambda m, R, who: write(R, who, fma(*(read(R, who) for read in reads)))
        function = _UNARY[name] if len(reads) == 1 else _BINARY[name]
        return lambda m, R, who: write(R, who, function(*(read(R, who) for read in reads)))

    def _ld_(self, op: list[str], given: list[str]) -> _Run:
        dtype, address = _TYPES[op[-1]], self._address(given[1])
        size = np.dtype(dtype).itemsize
        writes = [self._writer(x.strip()) for x in given[0].strip("{}").split(",")]
        if op[1] == "param":
            assert len(writes) == 1

            def load(m: PtxMachine, R: list[Array], who: Threads) -> None:
                at = int(address(R, who))
                writes[0](R, who, m._words[at : at + size].copy().view(dtype)[0])

            return load
        assert op[1] in ("global", "local") and {*op[2:-1]} <= {"nc", f"v{len(writes)}"}, op
        local = op[1] == "local"

        def load(m: PtxMachine, R: list[Array], who: Threads) -> None:
            first = address(R, who)
            for k, write in enumerate(writes):
                at = first + np.int64(k * size)
                if local:
                    write(R, who, m._local.view(dtype)[m._local_place(at, size, who)])
                else:
                    write(R, who, m.memory.load(dtype, at))

        return load

    def _st_(self, op: list[str], given: list[str]) -> _Run:
        dtype, address = _TYPES[op[-1]], self._address(given[0])
        size = np.dtype(dtype).itemsize
        reads = [self._reader(x.strip(), dtype) for x in given[1].strip("{}").split(",")]
        assert op[1] in ("global", "local") and {*op[2:-1]} <= {f"v{len(reads)}"}, op
        local = op[1] == "local"

        def store(m: PtxMachine, R: list[Array], who: Threads) -> None:
            first = address(R, who)
            for k, read in enumerate(reads):
                at, value = first + np.int64(k * size), np.broadcast_to(read(R, who), first.shape)
                if local:
                    m._local.view(dtype)[m._local_place(at, size, who)] = value
                else:
                    m.memory.store(dtype, at, value)

        return store

    def _local_place(self, address: Array, size: int, who: Threads) -> tuple[Array, Array]:
        """Return rows and columns of elements in local memory."""
        if (address < 0).any() or (address + size > self.local_bytes).any() or (address % size).any():
            raise IndexError(f"an access of {size} B outside of {self.local_bytes} B of local memory, or misaligned")
        thread = np.arange(len(self._local)) if who is None else who
        return np.broadcast_to(thread, address.shape), address // size

    def _mov_(self, op: list[str], given: list[str]) -> _Run:
        dtype = _TYPES[op[-1]]
        if given[1].startswith("{"):  # two halves
            low, high = (self._reader(x.strip(), np.uint32) for x in given[1].strip("{}").split(","))
            assert dtype is np.uint64
            write, by = self._writer(given[0]), np.uint64(32)
            return lambda m, R, who: write(
                R, who, low(R, who).astype(np.uint64) | (high(R, who).astype(np.uint64) << by)
            )
        read = self._reader(given[1], dtype)
        if given[0].startswith("{"):
            names = [x.strip() for x in given[0].strip("{}").split(",")]
            assert dtype is np.uint64 and len(names) == 2
            writes = [None if x == "_" else self._writer(x) for x in names]

            def halves(m: PtxMachine, R: list[Array], who: Threads) -> None:
                value = read(R, who)
                for k, write in enumerate(writes):
                    if write is not None:
                        write(R, who, (value >> np.uint64(32 * k)).astype(np.uint32))

            return halves
        write = self._writer(given[0])
        return lambda m, R, who: write(R, who, read(R, who).copy())

    def _setp_(self, op: list[str], given: list[str]) -> _Run:
        assert len(op) == 3, op
        dtype, how = _TYPES[op[-1]], op[1]
        a, b, write = self._reader(given[1], dtype), self._reader(given[2], dtype), self._writer(given[0])
        if how in ("nan", "num"):
            none: Any = lambda x, y: np.isnan(x) | np.isnan(y)  # noqa: E731
            compare = none if how == "nan" else lambda x, y: ~none(x, y)
        elif np.dtype(dtype).kind != "f":
            compare = _COMPARED[{"lo": "lt", "ls": "le", "hi": "gt", "hs": "ge"}.get(how, how)]
        elif len(how) == 3:  # true where either is NaN
            plain: Any = _COMPARED[how[:2]]
            compare = lambda x, y: plain(x, y) | np.isnan(x) | np.isnan(y)  # noqa: E731
        elif how == "ne":
            compare = lambda x, y: (x < y) | (x > y)  # noqa: E731
        else:
            compare = _COMPARED[how]
        return lambda m, R, who: write(R, who, np.asarray(compare(a(R, who), b(R, who))))

    def _selp_(self, op: list[str], given: list[str]) -> _Run:
        dtype = _TYPES[op[-1]]
        a, b, chosen = self._reader(given[1], dtype), self._reader(given[2], dtype), self._reader(given[3], np.bool_)
        write = self._writer(given[0])
        return lambda m, R, who: write(R, who, np.where(chosen(R, who), a(R, who), b(R, who)))

    def _cvt_(self, op: list[str], given: list[str]) -> _Run:
        target, source = _TYPES[op[-2]], _TYPES[op[-1]]
        read, write = self._reader(given[1], source), self._writer(given[0])
        to_float, of_float = np.dtype(target).kind == "f", np.dtype(source).kind == "f"
        how = op[1] if len(op) == 4 else ""
        assert len(op) == 3 or how in ("rn", *_ROUNDED), op
        whole = _ROUNDED.get(how)
        assert (whole is not None) == (of_float and (not to_float or target is source)), op

        def convert(m: PtxMachine, R: list[Array], who: Threads) -> None:
            value = read(R, who)
            if whole is not None:
                value = whole(value)
            write(R, who, _to_integer(value, target) if of_float and not to_float else value.astype(target))

        return convert

    def _mul_(self, op: list[str], given: list[str], added: bool = False) -> _Run:
        dtype, how = _TYPES[op[-1]], op[1]
        a, b = self._reader(given[1], dtype), self._reader(given[2], dtype)
        write = self._writer(given[0])
        wide: Any = _WIDER[dtype] if how == "wide" else dtype
        if how == "wide":
            product: Any = lambda x, y: x.astype(wide) * y.astype(wide)  # noqa: E731
        elif how == "hi":
            product = _high_product
        else:
            assert how == ("rn" if np.dtype(dtype).kind == "f" else "lo"), op
            product = lambda x, y: x * y  # noqa: E731
        if not added:
            return lambda m, R, who: write(R, who, product(a(R, who), b(R, who)))
        c = self._reader(given[3], wide)
        return lambda m, R, who: write(R, who, product(a(R, who), b(R, who)) + c(R, who))

    def _mad_(self, op: list[str], given: list[str]) -> _Run:
        return self._mul_(op, given, True)

    def _vote_(self, op: list[str], given: list[str]) -> _Run:
        assert op[1:] == ["sync", "ballot", "b32"] and given[2] == "-1", (op, given)
        read, write, bits = self._reader(given[1], np.bool_), self._writer(given[0]), np.arange(WARP, dtype=np.uint64)

        def ballot(m: PtxMachine, R: list[Array], who: Threads) -> None:
            held = read(R, who).reshape(-1, WARP).astype(np.uint64)
            write(R, who, np.repeat((held << bits).sum(1).astype(np.uint32), WARP))

        return ballot

    def _shfl_(self, op: list[str], given: list[str]) -> _Run:
        assert op[1:] == ["sync", "idx", "b32"] and given[3:] == ["31", "-1"], (op, given)
        write = self._writer(given[0].split("|")[0])
        read, place = self._reader(given[1], np.uint32), self._reader(given[2], np.uint32)

        def shuffle(m: PtxMachine, R: list[Array], who: Threads) -> None:
            value = read(R, who).reshape(-1, WARP)
            source = np.broadcast_to(place(R, who), (value.size,)).reshape(-1, WARP) & np.uint32(31)
            write(R, who, np.take_along_axis(value, source.astype(np.int64), 1).reshape(-1))

        return shuffle

    def _atom_(self, op: list[str], given: list[str]) -> _Run:
        assert op[1:-1] in (["global", "add"], ["global", "gpu", "add"], ["relaxed", "gpu", "global", "add"]), op
        dtype, address = _TYPES[op[-1]], self._address(given[1])
        read, write = self._reader(given[2], dtype), self._writer(given[0])

        def add(m: PtxMachine, R: list[Array], who: Threads) -> None:
            at = address(R, who)
            value, old = np.broadcast_to(read(R, who), at.shape), np.empty(at.shape, dtype)
            for k in m.rng.permutation(at.size):
                own = at[k : k + 1]
                old[k] = m.memory.load(dtype, own)[0]
                m.memory.store(dtype, own, old[k : k + 1] + value[k])
            write(R, who, old)

        return add

    # -- a launch

    def launch(
        self, memory: DeviceMemory, arguments: Sequence[bytes], blocks: int, threads: int, seed: int = 0,
        most: int = 1 << 22,
    ) -> None:  # fmt: skip
        """Run a grid to its end.

        Args:
            memory: global memory.
            arguments: value of each parameter.
            blocks: number of blocks of the grid.
            threads: number of threads of a block, a multiple of a warp.
            seed: of the order of atomics, and of what registers hold at first.
            most: error beyond this number of basic blocks.
        """
        assert threads % WARP == 0 and [len(x) for x in arguments] == self.sizes
        self.memory, self.rng = memory, np.random.default_rng(seed)
        self._words = np.zeros(self._parameter_bytes, np.uint8)
        for offset, value in zip(self._parameters.values(), arguments, strict=True):
            self._words[offset : offset + len(value)] = np.frombuffer(value, np.uint8)
        n = blocks * threads
        thread = np.arange(n)
        self.special: dict[str, Array] = {
            "%tid.x": thread % threads,
            "%ctaid.x": thread // threads,
            "%ntid.x": np.full(n, threads),
            "%nctaid.x": np.full(n, blocks),
            "%lanemask_lt": (1 << (thread % WARP)) - 1,
        }
        row = -(-self.local_bytes // 8) * 8
        self._local = self.rng.integers(0, 256, (n, row), np.uint8)
        R = [self.rng.integers(0, 256, n * np.dtype(x).itemsize, np.uint8).view(x) if x is not np.bool_
             else self.rng.integers(0, 2, n).astype(np.bool_) for x in self._dtypes]  # fmt: skip
        done = len(self._blocks)
        runs = np.zeros((2, done), np.int64)  # of threads and of warps
        at = np.zeros(n, np.int64)
        with np.errstate(all="ignore"):
            for _ in range(most):
                number = int(at.min())
                if number == done:
                    break
                number, who = self._next(at, number)
                block = self._blocks[number]
                for run in block.runs:
                    run(self, R, who)
                after = block.taken if block.taken >= 0 else done
                other = block.next if block.next >= 0 else done
                where: Any = slice(None) if who is None else who
                if block.guard >= 0:
                    at[where] = np.where(R[block.guard][where] ^ block.negated, after, other)
                else:
                    at[where] = after if block.ends else other
                runs[0, number] += n if who is None else who.size
                runs[1, number] += n // WARP if who is None else 1 + int(np.count_nonzero(np.diff(who // WARP)))
            else:
                raise RuntimeError("a kernel that does not end")
        for total, counts in ((self.executed, runs[0]), (self.issued, runs[1])):
            for block, count in zip(self._blocks, counts.tolist(), strict=True):
                for kind, each in block.kinds.items():
                    total[kind] += each * count

    def _next(self, at: Array, number: int) -> tuple[int, Threads]:
        """Return the first block that threads can run from block ``number`` on, and these threads."""
        done = len(self._blocks)
        while True:
            here = at == number
            if self._blocks[number].whole_warps:
                here &= np.repeat(here.reshape(-1, WARP).all(1), WARP)
            count = np.count_nonzero(here)
            if count:
                return number, None if count == here.size else np.flatnonzero(here)
            later = at[at > number]
            number = int(later.min()) if later.size else done
            if number == done:
                raise RuntimeError("threads wait for others of their warp that do not come")


def _order_blocks(blocks: set[int], after: Sequence[Sequence[int]], entry: int) -> list[int]:
    """Return the blocks that can be reached from ``entry``: each behind all that lead to it, those of a loop together."""
    found: list[int] = []
    for part in _components(blocks, after, entry):
        if len(part) == 1:
            found += part
            continue
        inside = set(part)
        heads = [x for x in part if x == entry or any(x in after[y] for y in blocks - inside)]
        head = min(heads or part)
        # Without the ways back to its head a loop's body is ordered like the whole.
        body = [[y for y in to if y != head] if x in inside else to for x, to in enumerate(after)]
        found += _order_blocks(inside, body, head)
    return found


def _components(blocks: set[int], after: Sequence[Sequence[int]], entry: int) -> list[list[int]]:
    """Return the strongly connected components that can be reached, each before those that it leads to (Tarjan 1972)."""
    index: dict[int, int] = {}
    low: dict[int, int] = {}
    path: list[int] = []
    on_path: set[int] = set()
    found: list[list[int]] = []
    work = [(entry, 0)]
    while work:
        node, k = work.pop()
        if k == 0:
            index[node] = low[node] = len(index)
            path.append(node)
            on_path.add(node)
        to = [x for x in after[node] if x in blocks]
        if k > 0:
            low[node] = min(low[node], low[to[k - 1]])
        while k < len(to) and to[k] in index:
            if to[k] in on_path:
                low[node] = min(low[node], index[to[k]])
            k += 1
        if k < len(to):
            work += [(node, k + 1), (to[k], 0)]
        elif low[node] == index[node]:
            part = path[path.index(node) :]
            del path[path.index(node) :]
            on_path.difference_update(part)
            found.append(part)
    return found[::-1]
