"""Object code linked without LLVM: the same addresses and results as LLVM's linker, and no crash by damaged objects."""

from __future__ import annotations

import ctypes
import json
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from torchpt.native import elf, kernels, machine

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64", reason="other systems leave all to LLVM"
)

#: All that kernels need of a linker: constants, a function of their own, one of the process.
IR = """
@bits = private unnamed_addr constant [4 x i64] [i64 3, i64 5, i64 7, i64 11]
declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)
define internal i64 @pick(i64 %k) noinline nounwind {
  %place = getelementptr [4 x i64], ptr @bits, i64 0, i64 %k
  %value = load i64, ptr %place
  ret i64 %value
}
define void @kernel(ptr %a, i64 %n) nounwind {
  %end = getelementptr i8, ptr %a, i64 32
  call void @llvm.memset.p0.i64(ptr %end, i8 1, i64 %n, i1 false)
  %value = call i64 @pick(i64 2)
  store i64 %value, ptr %a
  %second = getelementptr i64, ptr %a, i64 1
  %given = load double, ptr %second
  %sum = fadd double %given, 0.1
  store double %sum, ptr %second
  ret void
}
"""
FUSED = """
declare float @llvm.fma.f32(float, float, float)
define void @kernel(ptr %a) nounwind {
  %second = getelementptr float, ptr %a, i64 1
  %third = getelementptr float, ptr %a, i64 2
  %x = load float, ptr %a
  %y = load float, ptr %second
  %z = load float, ptr %third
  %sum = call float @llvm.fma.f32(float %x, float %y, float %z)
  store float %sum, ptr %a
  ret void
}
"""
WRITABLE = """
@count = global i64 4
define i64 @kernel() nounwind {
  %old = load i64, ptr @count
  %new = add i64 %old, 1
  store i64 %new, ptr @count
  ret i64 %new
}
"""
UNKNOWN = "declare i64 @no_function_of_this_name()\n" + (
    "define i64 @kernel() nounwind {\n  %a = call i64 @no_function_of_this_name()\n  ret i64 %a\n}\n"
)


@pytest.fixture(scope="module")
def code() -> bytes:
    return machine.object_code(IR)


def relocations(code: bytes) -> dict[int, set[int]]:
    """Return the types of an object's relocations, each with the places of its 24 bytes in the file."""
    header = elf._HEADER.unpack_from(code)
    found: dict[int, set[int]] = {}
    for k in range(header[12]):
        section = elf._Section(*elf._SECTION.unpack_from(code, header[6] + k * elf._SECTION.size))
        for place in range(section.offset, section.offset + section.size, 24) if section.type == 4 else ():
            found.setdefault(elf._RELOCATION.unpack_from(code, place)[1] & 0xFFFFFFFF, set()).add(place)
    return found


def results(address: int) -> bytes:
    out = np.array([0, 0.7, 0, 0, 0, 0, 0], np.float64)
    ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64)(address)(out.ctypes.data, 20)
    return out.tobytes()


def test_results_are_those_of_llvm(code, monkeypatch):
    linked = elf.link(code)
    assert linked is not None
    monkeypatch.setattr(elf, "link", lambda code: None)
    engine, address_of = machine.load_object(code)
    found = results(linked.functions["kernel"])
    assert found == results(address_of("kernel"))
    assert np.frombuffer(found, np.int64)[0] == 7 and np.frombuffer(found)[1] == 0.7 + 0.1
    assert found[32:] == b"\1" * 20 + b"\0" * 4
    del engine


def test_functions_of_the_c_library():
    """A CPU without fused multiply and add calls ``fmaf``, as LLVM's linker finds it too."""
    old = machine.new_machine("nehalem")
    code = old.emit_object(machine.parse(FUSED, old))
    linked = elf.link(code)
    assert linked is not None and b"fmaf" in code
    values = np.array([1 + 2**-12, 1 + 2**-12, -1 - 2**-11], np.float32)
    ctypes.CFUNCTYPE(None, ctypes.c_void_p)(linked.functions["kernel"])(values.ctypes.data)
    assert values[0] == 2**-24  # 0 if the product is rounded


def test_all_kernels_of_the_package_are_linked_here():
    for path in kernels.FOLDER.iterdir():
        name = path.name.removesuffix(".ll.xz")
        code = machine.object_code(kernels.read_module(name))
        linked = elf.link(code)
        assert linked is not None and set(linked.functions) >= set(kernels._load(name)), name
        assert set(relocations(code)) <= {1}


def test_no_memory_is_writable_and_executable(code):
    linked = elf.link(code)
    assert linked is not None
    address, maps = linked.functions["kernel"], {}
    for line in Path("/proc/self/maps").read_text().splitlines():
        span, rights, *_ = line.split()
        first, end = (int(part, 16) for part in span.split("-"))
        maps[range(first, end)] = rights
    assert next(rights for span, rights in maps.items() if address in span) == "r-xp"
    start = ctypes.addressof(ctypes.c_char.from_buffer(linked.memory))
    ours = {rights for span, rights in maps.items() if span.start < start + len(linked.memory) and start < span.stop}
    assert ours == {"r-xp", "r--p"}


def test_writable_data_is_left_to_llvm():
    code = machine.object_code(WRITABLE)
    assert elf.link(code) is None
    engine, address_of = machine.load_object(code)
    count = ctypes.CFUNCTYPE(ctypes.c_int64)(address_of("kernel"))
    assert [count(), count()] == [5, 6]
    del engine


def test_an_unknown_function_is_left_to_llvm():
    assert elf.link(machine.object_code(UNKNOWN)) is None


def test_other_relocations_are_left_to_llvm(code):
    """Of the types of the processor's supplement only the absolute one of 64 bits is linked."""
    places = relocations(code)
    assert set(places) == {1} and len(places[1]) >= 3  # a constant, a function of the object, one of the process
    for place in places[1]:
        for kind in (0, 2, 4, 9, 10, 11, 24, 26, 42, 255):  # PC32, PLT32, GOTPCREL, 32, 32S, PC64, ...
            other = bytearray(code)
            other[place + 8] = kind
            assert elf.link(bytes(other)) is None


@pytest.mark.parametrize(
    "start", [b"", b"\xcf\xfa\xed\xfe\x07\0\0\1", b"\x64\x86\6\0", b"\x7fELF\1\1\1", b"\x7fELF\2\2\1"]
)
def test_other_formats_are_left_to_llvm(start, code):
    assert elf.link(start + code[len(start) :] if start else b"") is None


def test_other_processors_are_left_to_llvm(code):
    assert elf.link(code[:18] + (183).to_bytes(2, "little") + code[20:]) is None  # AArch64


def test_damaged_objects_do_no_harm(code):
    """They are refused, or linked to code that nobody calls (the cache has checksums); no access is beyond an end."""
    assert all(elf.link(code[:end]) is None for end in range(0, len(code) - 1, 7))
    random = np.random.default_rng(5)
    refused = 0
    for value in (0, 1, 0x7F, 0x80, 0xFF):
        for place in range(len(code)):
            damaged = bytearray(code)
            damaged[place] = value
            refused += elf.link(bytes(damaged)) is None
    for _ in range(3000):
        damaged = bytearray(code)
        place = int(random.integers(len(code) - 8))
        damaged[place : place + 8] = random.bytes(8)
        refused += elf.link(bytes(damaged)) is None
    assert refused > 1000


# -- renders

#: Prints digests of pictures, a gradient, and the modules of LLVM and Numba that were imported. ``llvm`` links by LLVM.
RENDERS = """
import hashlib, json, sys
import torch, torchpt
from torchpt.native import elf
linker, *names = sys.argv[1:]
if linker == "llvm":
    elf.link = lambda code: None
torch.set_num_threads(1)
found = []
for name in names:
    scene = torchpt.load(name, "cpu", overrides={"film.width": 24, "film.height": 24, "render.spp": 4, "render.threads": 1})
    found.append(hashlib.sha256(torchpt.render(scene, seed=3).numpy().tobytes()).hexdigest())
    if name == "cornell_box":
        leaf = scene.params["materials.red.reflectance"].clone().requires_grad_()
        picture = torchpt.render(scene, params={"materials.red.reflectance": leaf}, seed=3)
        (gradient,) = torch.autograd.grad(picture.square().sum(), leaf)
        found.append(gradient.tolist())
libraries = [name for name in sys.modules if name.startswith(("llvmlite.binding", "llvmlite.ir", "numba"))]
print(json.dumps([found, libraries]))
"""


def rendered(linker: str, scenes: tuple[str, ...]) -> tuple[list[object], list[str]]:
    done = subprocess.run([sys.executable, "-c", RENDERS, linker, *scenes], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    found, libraries = json.loads(done.stdout)
    return found, libraries


@pytest.mark.parametrize(
    "scenes",
    [("cornell_box",), pytest.param(("material_row", "shapes_and_maps", "instances"), marks=pytest.mark.slow)],
    ids=len,
)
def test_renders_have_the_bits_of_llvm_and_load_no_llvm(scenes):
    by_llvm, libraries = rendered("llvm", scenes)  # kernels that are not cached are compiled here
    assert "llvmlite.binding" in libraries
    found, libraries = rendered("own", scenes)
    assert found == by_llvm
    assert libraries == []
