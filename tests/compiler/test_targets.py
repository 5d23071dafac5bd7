"""Code for other machines: older vectors give the same bits here, and an AArch64 object is one."""

from __future__ import annotations

import math
import platform
import struct

import pytest
import torch
from forms import differing
from torch import Tensor

from torchpt.compiler import cpu as engine
from torchpt.compiler.function import compile_lanewise
from torchpt.compiler.target import Target
from torchpt.native import machine

X86 = platform.machine().lower() in ("x86_64", "amd64")
N = 333
_rng = torch.Generator().manual_seed(5)
TABLE = torch.rand(2, 77, generator=_rng)
SORTED = torch.sort(torch.rand(50, generator=_rng)).values
MARKS = torch.rand(77, generator=_rng) < 0.5
X = torch.randn(3, N, generator=_rng)
D = torch.randn(2, N, generator=_rng, dtype=torch.float64)
I = torch.randint(-(1 << 31), (1 << 31) - 1, (2, N), generator=_rng).int()  # noqa: E741
B = torch.rand(N, generator=_rng) < 0.5
U = torch.randint(0, 256, (N,), generator=_rng, dtype=torch.uint8)
GIVEN = (X, D, I, B, U)


def plain(x: Tensor, d: Tensor, i: Tensor, b: Tensor, u: Tensor) -> list[Tensor]:
    """Operators one by one."""
    index = (x[0] * 20).long().clamp(0, 76)
    return [
        torch.sqrt(x.abs()),
        x[0] / x[1],
        torch.where(b, x[0], x[1]),
        torch.maximum(d[0], x[0]),
        x[0].clamp(-0.5, math.inf).floor(),
        i[0] * i[1],
        (i[0].long() * i[1]) >> 7,
        torch.remainder(i[0], (i[1] | 1) % 1000 + 1001),
        torch.div(i[0].long() * i[1], 77, rounding_mode="floor"),
        (u + u).to(torch.int64),
        u > 100,
        torch.index_select(TABLE, 1, index),
        torch.index_select(MARKS, 0, index) ^ b,
        torch.searchsorted(SORTED, x[2]),
        x[0].double() + d[1],
        d[0].float(),
        (x[1] * 1000).int(),
        torch.round(x[2] * 4),
        x[0] % 0.3,
        torch.arange(x.shape[1]) + i[0],
    ]


def fused(x: Tensor, d: Tensor, i: Tensor, b: Tensor, u: Tensor) -> list[Tensor]:
    """Compute products that are rounded once with a sum, also where no instruction does that."""
    names = "sin cos tan atan exp exp2 expm1 tanh sinh cosh sigmoid".split()
    found = [getattr(torch, name)(v) for name in names for v in (x[0], d[0])]
    found += [getattr(torch, name)(v.abs()) for name in ("log", "log10", "log1p") for v in (x[1], d[1])]
    found += [
        torch.asin(x[0] * 0.2),
        torch.acos(d[0] * 0.2),
        torch.atan2(x[0], x[1]),
        x[1].abs() ** x[0],
        d[1].abs() ** d[0],
    ]
    return [*found, x.prod(0), (x * x).sum(0), torch.lerp(x[0], x[1], x[2]), x[0] * x[1] + x[2]]


@pytest.mark.skipif(not X86, reason="these are x86 machines")
@pytest.mark.parametrize("cpu", ["haswell", "nehalem"])
def test_older_machines(cpu):
    """Without AVX-512, and without AVX and fused multiply and add; this machine runs them as well."""
    if cpu == "haswell" and "+avx2" not in engine.host().features.split(","):
        pytest.skip("this machine has no AVX2")
    target = Target(cpu, "")  # of features only the CPU's own
    for function in (plain, fused):
        there, here = (compile_lanewise(function, GIVEN, t) for t in (target, None))
        for n in (1, 16, N):
            given = [x[..., :n] for x in GIVEN]
            for k, (a, b) in enumerate(zip(there(*given), here(*given), strict=True)):
                assert not differing(a, b).any(), f"{function.__name__}, result {k}, {n} lanes"


@pytest.mark.skipif(not X86, reason="these are x86 machines")
def test_older_machines_have_no_newer_vectors():
    import llvmlite.binding as llvm

    ir = "define void @kernel(ptr %a, i64 %n) {\n  %x = load <16 x float>, ptr %a, align 4\n"
    ir += "  %y = fadd <16 x float> %x, %x\n  store <16 x float> %y, ptr %a, align 4\n  ret void\n}\n"
    module = llvm.parse_assembly(ir)
    for cpu, registers in (("nehalem", "xmm"), ("haswell", "ymm"), ("skylake-avx512", None)):
        text = machine.new_machine(cpu).emit_assembly(module)
        assert ("zmm" in text) == (cpu == "skylake-avx512")
        assert registers is None or registers in text
        assert ("ymm" in text) == (cpu == "haswell")


def test_aarch64():
    """The same functions as an object for another machine; nothing here runs it."""
    target = Target("generic", "+neon", "aarch64-linux-gnu")
    run = compile_lanewise(lambda *x: [*plain(*x), x[0].sin(), x[1].log()], GIVEN, target)
    assert callable(run)
    made = [f for f in engine._functions.values() if f.call is None]
    assert made
    code = made[-1].code
    assert code[:4] == b"\x7fELF" and code[4] == 2
    kind, machine = struct.unpack_from("<HH", code, 16)
    assert (kind, machine) == (1, 183)  # relocatable, EM_AARCH64


def test_host_features_are_sorted():
    """The key of an entry is the same in every process."""
    names = [feature[1:] for feature in engine.host().features.split(",")]
    assert names == sorted(names)
