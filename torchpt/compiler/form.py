"""The form of a kernel: lanes in a register, elements in a row of an arena, and how lanes are divided among threads.

An *arena* is the memory of one worker in which path states lie between kernels, component by component: a *row* holds one
component of all lanes, as 32-bit elements. Stages do not depend on the form, only the generation of LLVM IR does.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CAPACITY", "SCALAR", "VECTORS", "WARP", "Form"]


#: Elements of a row of a CPU's arenas: at most 2^14 lanes, and one vector of padding, as kernels write whole vectors.
CAPACITY = 16384 + 16
#: Threads of a warp on NVIDIA GPUs.
WARP = 32


@dataclass(frozen=True)
class Form:
    """The layout of lanes in a kernel.

    Results have the same bits in any form: each lane is computed by the same operations, and which products and sums become
    fused multiply-adds is decided in the graph (:mod:`torchpt.compiler.fusing`).

    A CPU kernel is ``kernel(ptr arguments, i64 lanes)`` and computes lanes 0 to ``lanes - 1`` in order. ``arguments`` is the
    address of a block of 64-bit words: the words of :data:`torchpt.compiler.kernel.HEAD`, the address of each *uniform* (an
    input that all lanes share), the address of each *list* of lane indices, and address and row length of each input tensor
    and then of each result tensor (:func:`torchpt.compiler.kernel.argument_words`).

    A GPU kernel (``threads``) is ``kernel(block arguments, ptr lanes)``, in PTX an entry with two parameters:

    - ``arguments``: the same block of words, by value. All addresses are of global memory of the device.
    - ``lanes``: address of one int64 in global memory, the number of lanes. The kernel itself must not write there, so it may
      be a counter of an earlier kernel, not one that this kernel increments.

    Any 1-D grid of 1-D blocks may run it whose block size is a multiple of :data:`WARP`: thread ``k`` of ``T`` computes lanes
    ``k``, ``k + T``, ... below ``lanes``. Warps stay whole: a thread whose lane does not exist computes the last lane again and
    stores nothing. Compacted lanes and appended indices keep their order within a warp, but warps append in any order. Memory
    that tables, uniforms, ``tables`` and ``search`` point to must not change while the kernel runs. There is no shared memory,
    and the kernel needs as much local memory as its code says.

    Attributes:
        width: lanes of a value; a value is an LLVM vector if there is more than one, else a scalar.
        row: elements from one row of an arena to the next.
        threads: True: GPU threads compute one lane each; False: a loop of one CPU thread takes ``width`` lanes at a time.
    """

    width: int
    row: int = CAPACITY
    threads: bool = False


#: The form of CPU kernels: 16 float32 fill a register of AVX-512. LLVM splits the vectors for narrower registers.
VECTORS = Form(width=16)
#: One lane at a time on a CPU.
SCALAR = Form(width=1)
