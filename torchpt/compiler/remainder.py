"""The remainder of floats, C's ``fmod``, as LLVM IR: a function that kernels for GPUs call.

On CPUs LLVM's instruction ``frem`` calls the C library. On GPUs it would become ``x - trunc(x / y) y``, which is wrong where
the quotient is rounded.
"""

from __future__ import annotations

from torchpt.compiler.block import ELEMENTS, Block
from torchpt.compiler.form import Form
from torchpt.compiler.graph import FLOATS, Graph

__all__ = ["float_remainders"]

#: Operations of a graph that take a remainder of floats.
_OPERATIONS = ("fmod", "remainder", "floordiv")
#: Bits of the fraction, by node type. A remainder is shifted by 63 less these at once, so that it stays below 2^64.
_FRACTION = {"f": 23, "d": 52}


def float_remainders(graph: Graph, needed: list[int], form: Form) -> Block:
    """Write the functions ``fmod_f`` and ``fmod_d`` that a graph needs for GPU threads; nothing for other forms.

    Both numbers are integers times a power of two, so the remainder is that of a long division of integers, and exact:
    ``m 2^n mod k``, a few bits of ``n`` at a time.

    Args:
        graph: the graph of a stage.
        needed: nodes that are computed.
        form: layout of lanes.
    """
    block = Block(form)
    if form.threads:
        for ty in sorted({graph.type(k) for k in needed if graph.nodes[k][0] in _OPERATIONS} & set(FLOATS)):
            block.lines += _text(ty).splitlines()
            block.declarations.add("declare i64 @llvm.ctlz.i64(i64, i1)")
            block.declarations.add("declare i64 @llvm.umin.i64(i64, i64)")
    return block


def _text(ty: str) -> str:
    """Return the definition of ``fmod_f`` or ``fmod_d``.

    ``%a`` and ``%b`` are the bits of ``|x|`` and ``|y|``, which order as the numbers do. The result is NaN where ``%none`` is
    set: ``x`` infinite or NaN, ``y`` NaN or 0. It is ``x`` if ``|x| < |y|``. Else ``|x| = m 2^p`` and ``|y| = k 2^q`` up to a
    common factor, and ``n = p - q``; ``%r`` becomes ``m 2^n mod k`` in the loop, where ``%left`` bits of ``n`` are left.
    ``normalize`` shifts ``%r`` up until its leading bit is the hidden one, as far as the exponent ``q`` allows.
    """
    real, fraction = ELEMENTS[ty], _FRACTION[ty]
    bits = 32 if ty == "f" else 64
    exponents = (1 << (bits - 1 - fraction)) - 1
    to_wide = "zext i32 {} to i64" if bits == 32 else "add i64 {}, 0"
    to_bits = "trunc i64 {} to i32" if bits == 32 else "add i64 {}, 0"
    return f"""define internal {real} @fmod_{ty}({real} %x, {real} %y) alwaysinline #0 {{
entry:
  %x_bits = bitcast {real} %x to i{bits}
  %y_bits = bitcast {real} %y to i{bits}
  %x_wide = {to_wide.format("%x_bits")}
  %y_wide = {to_wide.format("%y_bits")}
  %sign = and i64 %x_wide, {-(1 << 63) if bits == 64 else 1 << 31}
  %a = and i64 %x_wide, {(1 << (bits - 1)) - 1}
  %b = and i64 %y_wide, {(1 << (bits - 1)) - 1}
  %smaller = icmp ult i64 %a, %b
  %x_infinite = icmp uge i64 %a, {exponents << fraction}
  %y_nan = icmp ugt i64 %b, {exponents << fraction}
  %y_zero = icmp eq i64 %b, 0
  %x_or_y = or i1 %x_infinite, %y_nan
  %none = or i1 %x_or_y, %y_zero
  %simple = or i1 %none, %smaller
  br i1 %simple, label %exit, label %divide
divide:
  %x_exponent = lshr i64 %a, {fraction}
  %y_exponent = lshr i64 %b, {fraction}
  %x_fraction = and i64 %a, {(1 << fraction) - 1}
  %y_fraction = and i64 %b, {(1 << fraction) - 1}
  %x_full = or i64 %x_fraction, {1 << fraction}
  %y_full = or i64 %y_fraction, {1 << fraction}
  %x_subnormal = icmp eq i64 %x_exponent, 0
  %y_subnormal = icmp eq i64 %y_exponent, 0
  %m = select i1 %x_subnormal, i64 %x_fraction, i64 %x_full
  %k = select i1 %y_subnormal, i64 %y_fraction, i64 %y_full
  %p = select i1 %x_subnormal, i64 1, i64 %x_exponent
  %q = select i1 %y_subnormal, i64 1, i64 %y_exponent
  %n = sub i64 %p, %q
  %first = urem i64 %m, %k
  br label %loop
loop:
  %r = phi i64 [ %first, %divide ], [ %next, %step ]
  %left = phi i64 [ %n, %divide ], [ %less, %step ]
  %more = icmp ne i64 %left, 0
  br i1 %more, label %step, label %normalize
step:
  %by = call i64 @llvm.umin.i64(i64 %left, i64 {63 - fraction})
  %shifted = shl i64 %r, %by
  %next = urem i64 %shifted, %k
  %less = sub i64 %left, %by
  br label %loop
normalize:
  %zeros = call i64 @llvm.ctlz.i64(i64 %r, i1 false)
  %free = sub i64 %zeros, {63 - fraction}
  %down = sub i64 %q, 1
  %up = call i64 @llvm.umin.i64(i64 %free, i64 %down)
  %exponent = sub i64 %down, %up
  %high = shl i64 %exponent, {fraction}
  %low = shl i64 %r, %up
  %sum = add i64 %high, %low
  %is_zero = icmp eq i64 %r, 0
  %size = select i1 %is_zero, i64 0, i64 %sum
  %signed = or i64 %size, %sign
  %narrow = {to_bits.format("%signed")}
  %value = bitcast i{bits} %narrow to {real}
  br label %exit
exit:
  %plain = phi {real} [ %x, %entry ], [ %value, %normalize ]
  %result = select i1 %none, {real} 0x7FF8000000000000, {real} %plain
  ret {real} %result
}}
"""
