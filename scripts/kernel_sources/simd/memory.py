"""Loads and stores of vectors, in contiguous arrays or by pointers. Addresses need not be aligned."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types

from kernel_sources.simd.types import ELEMENTS, I32, Vector, intrinsic, lanes_of, splatted

__all__ = ["gather", "item", "load", "load_masked", "pointer", "prefetch", "put", "store", "store_masked"]

_BYTES = 4  # of an element, and alignment of all accesses
_I64 = ir.IntType(64)


def _base(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Return the address of an array or pointer; ``kind`` is its type."""
    return value if isinstance(kind, types.CPointer) else context.make_array(kind)(context, builder, value).data


def _place(context: Any, builder: Any, kind: Any, value: Any, i: Any) -> Any:
    """Return the address of element ``i``."""
    return builder.gep(_base(context, builder, kind, value), [i], inbounds=True)


def _address(context: Any, builder: Any, kind: Any, value: Any, i: Any, target: Any) -> Any:
    """Return the address of element ``i`` as a pointer to the LLVM type ``target``."""
    return builder.bitcast(_place(context, builder, kind, value, i), target.as_pointer())


def _llvm(kind: Vector) -> Any:
    return ir.VectorType(ELEMENTS[kind.element], kind.lanes)


def _contiguous(array: Any) -> bool:
    return isinstance(array, types.CPointer) or (isinstance(array, types.Array) and array.layout == "C")


def _holds(array: Any) -> bool:
    """Return True for a type of memory that vectors can be loaded from: contiguous float32 or int32."""
    return _contiguous(array) and array.dtype in (types.float32, types.int32)


@intrinsic
def pointer(context, array):
    """Return a pointer to the memory of a contiguous array, which all functions here accept in place of the array.

    A pointer can be passed on and put into tuples at no cost, while numba counts references of arrays even in inner loops. It
    does not keep the array alive: the function that allocated an array must use it after the last use of its pointer.
    """
    if not (isinstance(array, types.Array) and array.layout == "C"):
        return None
    kind = types.CPointer(array.dtype)
    return kind(array), lambda context, builder, signature, args: _base(context, builder, array, args[0])


@intrinsic(prefer_literal=True)
def load(context, array, i, n):
    """Load ``n`` elements of a C-contiguous float32 or int32 array from flat index ``i`` on: ``load(a, i, n)``."""
    if not _holds(array):
        return None
    kind = Vector(array.dtype, lanes_of(n))

    def generate(context, builder, signature, args):
        value = builder.load(_address(context, builder, array, args[0], args[1], _llvm(kind)))
        value.align = _BYTES
        return value

    return kind(array, types.intp, n), generate


@intrinsic
def store(context, array, i, x):
    """Store the lanes of ``x`` from flat index ``i`` on: ``store(a, i, x)``."""
    if not (_holds(array) and isinstance(x, Vector) and x.element == array.dtype):
        return None

    def generate(context, builder, signature, args):
        written = builder.store(args[2], _address(context, builder, array, args[0], args[1], _llvm(x)))
        written.align = _BYTES
        return context.get_dummy_value()

    return types.none(array, types.intp, x), generate


@intrinsic
def item(context, array, i):
    """Load one element at flat index ``i`` of a contiguous array: ``item(a, i)``."""
    if not _contiguous(array):
        return None

    def generate(context, builder, signature, args):
        place = _place(context, builder, array, args[0], args[1])
        return context.unpack_value(builder, array.dtype, place)

    return array.dtype(array, types.intp), generate


@intrinsic
def put(context, array, i, x):
    """Store one element at flat index ``i``, converted to the type of the array: ``put(a, i, x)``."""
    if not _contiguous(array):
        return None

    def generate(context, builder, signature, args):
        context.pack_value(builder, array.dtype, args[2], _place(context, builder, array, args[0], args[1]))
        return context.get_dummy_value()

    return types.none(array, types.intp, array.dtype), generate


@intrinsic
def load_masked(context, array, i, m, other):
    """Load elements from flat index ``i`` on where the mask is set, and only those; else return lanes of ``other``."""
    if not (_holds(array) and isinstance(other, Vector) and other.element == array.dtype):
        return None

    def generate(context, builder, signature, args):
        kind, place = _llvm(other), _address(context, builder, array, args[0], args[1], _llvm(other))
        shape = ir.FunctionType(kind, [place.type, I32, args[2].type, kind])
        call = cgutils.get_or_insert_function(builder.module, shape, f"llvm.masked.load.{other.code}.p0")
        return builder.call(call, [place, I32(_BYTES), args[2], args[3]])

    return other(array, types.intp, m, other), generate


@intrinsic
def store_masked(context, array, i, m, x):
    """Store the lanes of ``x`` where the mask is set; other elements are not accessed."""
    if not (_holds(array) and isinstance(x, Vector) and x.element == array.dtype):
        return None

    def generate(context, builder, signature, args):
        place = _address(context, builder, array, args[0], args[1], _llvm(x))
        shape = ir.FunctionType(ir.VoidType(), [_llvm(x), place.type, I32, args[2].type])
        call = cgutils.get_or_insert_function(builder.module, shape, f"llvm.masked.store.{x.code}.p0")
        builder.call(call, [args[3], place, I32(_BYTES), args[2]])
        return context.get_dummy_value()

    return types.none(array, types.intp, m, x), generate


@intrinsic
def gather(context, array, places, m, other):
    """Load elements at int32 indices ``places`` where the mask is set, and only those; else return lanes of ``other``."""
    if not (_holds(array) and isinstance(other, Vector) and other.element == array.dtype):
        return None
    if places != Vector(types.int32, other.lanes):
        return None

    def generate(context, builder, signature, args):
        lanes = other.lanes
        wide = builder.sext(args[1], ir.VectorType(_I64, lanes))
        base = builder.ptrtoint(_base(context, builder, array, args[0]), _I64)
        scaled = builder.mul(wide, splatted(builder, _I64(_BYTES), lanes))
        address = builder.add(splatted(builder, base, lanes), scaled)
        pointers = builder.inttoptr(address, ir.VectorType(ELEMENTS[other.element].as_pointer(), lanes))
        shape = ir.FunctionType(_llvm(other), [pointers.type, I32, args[2].type, _llvm(other)])
        name = f"llvm.masked.gather.{other.code}.v{lanes}p0"
        call = cgutils.get_or_insert_function(builder.module, shape, name)
        return builder.call(call, [pointers, I32(_BYTES), args[2], args[3]])

    return other(array, places, m, other), generate


@intrinsic
def prefetch(context, array, i):
    """Prefetch the cache line of flat index ``i``; any address is allowed."""
    if not _contiguous(array):
        return None

    def generate(context, builder, signature, args):
        place = _address(context, builder, array, args[0], args[1], ir.IntType(8))
        shape = ir.FunctionType(ir.VoidType(), [place.type, I32, I32, I32])
        call = cgutils.get_or_insert_function(builder.module, shape, "llvm.prefetch.p0")
        builder.call(call, [place, I32(0), I32(3), I32(1)])  # to read, keep, data
        return context.get_dummy_value()

    return types.none(array, types.intp), generate
