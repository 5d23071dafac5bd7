"""The machine that runs PTX: what it computes where the manual leaves one result, and which faults of a kernel it finds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from ptx_machine import DeviceMemory, PtxMachine

HEAD = """.version 7.0
.target sm_75
.address_size 64
.visible .entry kernel(
	.param .u64 kernel_param_0
)
{
	.reg .pred 	%p<9>;
	.reg .b32 	%r<9>;
	.reg .b64 	%rd<9>;

	ld.param.b64 	%rd1, [kernel_param_0];
	mov.u32 	%r1, %tid.x;
	mul.wide.u32 	%rd2, %r1, 4;
	add.s64 	%rd3, %rd1, %rd2;
"""


def run(body: str, words: Any, constant: bool = False, threads: int = 32, seed: int = 0) -> PtxMachine:
    """Run a body on words: ``%rd1`` is their address, ``%r1`` the thread and ``%rd3`` the address of its word."""
    memory = DeviceMemory()
    address = memory.add(words, constant)
    machine = PtxMachine(HEAD + body + "\tret;\n}\n")
    machine.launch(memory, [np.int64(address).tobytes()], 1, threads, seed, most=1000)
    return machine


def applied(instruction: str, *values: Any, size: int = 32) -> np.ndarray:
    """The results of an instruction; its operands are ``%r5, %r6, %r7``, or ``%rd5, ...`` of 64 bits."""
    name = "%r" if size == 32 else "%rd"
    rows = [np.broadcast_to(x, values[0].shape) for x in values]
    words = np.stack([*(x.view(f"u{size // 8}") for x in rows), np.zeros(len(rows[0]), f"u{size // 8}")])
    padded = np.zeros((len(words), 64), words.dtype)
    padded[:, : words.shape[1]] = words
    body = f"\tmul.wide.u32 \t%rd4, %r1, {size // 8};\n\tadd.s64 \t%rd4, %rd1, %rd4;\n"
    for k in range(len(values)):
        body += f"\tld.global.b{size} \t{name}{5 + k}, [%rd4+{64 * k * size // 8}];\n"
    body += f"\t{instruction};\n\tst.global.b{size} \t[%rd4+{64 * len(values) * size // 8}], {name}8;\n"
    run(body, padded, threads=64)
    return padded[-1, : words.shape[1]].copy()


def test_fused_multiply_and_add_is_rounded_once():
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((2, 64)).astype(np.float32)
    c = -(a * b)  # what is left is the product's rounding error
    exact = (a.astype(np.float64) * b + c).astype(np.float32)
    assert (exact != 0).any()
    assert np.array_equal(applied("fma.rn.f32 \t%r8, %r5, %r6, %r7", a, b, c).view(np.float32), exact)


def test_integers_of_floats():
    x = np.array([0.0, -1.7, 1e10, -1e10, math.inf, -math.inf, math.nan, 2147483520.0], np.float32)
    most, least = 2**31 - 1, -(2**31)
    found = applied("cvt.rzi.s32.f32 \t%r8, %r5", x).view(np.int32)
    assert found.tolist() == [0, -1, most, least, most, least, 0, 2147483520]
    wide = np.array([1e30, -1e30, math.nan, -5.9])
    found = applied("cvt.rzi.s64.f64 \t%rd8, %rd5", wide, size=64).view(np.int64)
    assert found.tolist() == [2**63 - 1, -(2**63), -(2**63), -5]


def test_comparisons_of_nan():
    x = np.array([1.0, math.nan, 2.0], np.float32)
    one = np.float32(1.0).view(np.uint32)
    for how, wanted in (
        ("eq", [1, 0, 0]),
        ("ne", [0, 0, 1]),
        ("neu", [0, 1, 1]),
        ("ltu", [0, 1, 0]),
        ("nan", [0, 1, 0]),
    ):
        body = f"setp.{how}.f32 \t%p1, %r5, 0f{one:08X};\n\tselp.b32 \t%r8, 1, 0, %p1"
        assert applied(body, x).tolist() == wanted, how


def test_extremes():
    a, b = np.array([0.0, -0.0, math.nan, 3.0], np.float32), np.array([-0.0, 0.0, 1.0, math.nan], np.float32)
    most = applied("max.f32 \t%r8, %r5, %r6", a, b).view(np.float32)
    assert most.tolist() == [0.0, 0.0, 1.0, 3.0] and not np.signbit(most).any()
    assert np.signbit(applied("min.f32 \t%r8, %r5, %r6", a, b).view(np.float32)).tolist() == [True, True, False, False]


def test_shifts_beyond_the_width():
    x, by = np.array([-8, -8, 5], np.int32), np.array([1, 40, 40], np.int32)
    assert applied("shr.s32 \t%r8, %r5, %r6", x, by).view(np.int32).tolist() == [-4, -1, 0]
    assert applied("shl.b32 \t%r8, %r5, %r6", x, by).view(np.int32).tolist() == [-16, 0, 0]


def test_threads_meet_where_paths_join():
    """Sixteen threads take five turns of a loop, the others one; behind it all of a warp run together."""
    body = """
	setp.lt.u32 	%p1, %r1, 16;
	selp.b32 	%r2, 5, 1, %p1;
	mov.b32 	%r3, 0;
$LOOP:
	add.s32 	%r3, %r3, 1;
	setp.lt.u32 	%p2, %r3, %r2;
	@%p2 bra 	$LOOP;
	rcp.rn.f32 	%r4, %r3;
	st.global.b32 	[%rd3], %r3;
"""
    words = np.zeros(32, np.int32)
    machine = run(body, words)
    assert words.tolist() == [5] * 16 + [1] * 16
    assert machine.issued["rcp"] == 1 and machine.executed["rcp"] == 32
    assert machine.issued["setp"] == 1 + 5 and machine.executed["setp"] == 32 + 32 + 4 * 16


def test_atomics_come_in_any_order():
    body = """
	atom.global.add.u32 	%r2, [%rd1], 1;
	st.global.b32 	[%rd3+128], %r2;
"""
    orders = []
    for seed in (1, 2):
        words = np.zeros(64, np.uint32)
        run(body, words, seed=seed)
        assert words[0] == 32 and sorted(words[32:]) == list(range(32))
        orders.append(words[32:].tolist())
    assert orders[0] != orders[1]


def test_votes_and_shuffles():
    body = """
	setp.gt.u32 	%p1, %r1, 29;
	vote.sync.ballot.b32 	%r2, %p1, -1;
	shfl.sync.idx.b32 	%r3, %r1, 7, 31, -1;
	add.s32 	%r4, %r2, %r3;
	st.global.b32 	[%rd3], %r4;
"""
    words = np.zeros(32, np.uint32)
    run(body, words)
    assert (words == 0xC0000000 + 7).all()


FAULTS = {
    "an access of 4 B outside of memory": "\tst.global.b32 \t[%rd3+-4], %r1;\n",
    "an access of 4 B beyond a region": "\tst.global.b32 \t[%rd3+4], %r1;\n",
    "an access of 4 B at an address that is no multiple of 4": "\tld.global.b32 \t%r2, [%rd3+2];\n",
    "PTX: sin.approx.f32": "\tsin.approx.f32 \t%r2, %r1;\n",
    "threads wait for others": "\tsetp.gt.u32 \t%p1, %r1, 3;\n\t@%p1 bra \t$END;\n"
    "\tvote.sync.ballot.b32 \t%r2, %p1, -1;\n$END:\n",
    "a kernel that does not end": "$HERE:\n\tbra.uni \t$HERE;\n",
}


@pytest.mark.parametrize("message", FAULTS)
def test_faults(message):
    with pytest.raises((IndexError, NotImplementedError, RuntimeError), match=message):
        run(FAULTS[message], np.zeros(32, np.int32))


def test_stores_to_constant_memory():
    with pytest.raises(IndexError, match="a store to constant memory"):
        run("\tst.global.b32 \t[%rd3], %r1;\n", np.zeros(32, np.int32), constant=True)
