"""What a scene does not use costs nothing: no tensor, no operator call, no node of a kernel; and `info` says so."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections import Counter
from typing import Any

import pytest
import torch
from features import FEATURES, Feature, kernels, with_feature
from few import few
from showcase import MATERIALS, showcase
from torch.utils._python_dispatch import TorchDispatchMode
from trials import film_of

import torchpt
from torchpt.compiler import cache
from torchpt.compiler.program import Program
from torchpt.core.tree import leaves
from torchpt.scene.formats.description import settings


class _Counter(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.calls: Counter[str] = Counter()
        self.elements = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        self.calls[func._schema.name] += 1
        self.elements += sum(t.numel() for t in leaves(out)) if not isinstance(out, bool) else 0
        return out


def counted(described: dict[str, Any]) -> tuple[Counter[str], int, torch.Tensor, int]:
    """Operator calls of a render, elements that they wrote, the picture, and how many tensors the world holds."""
    scene = torchpt.load(described, "cpu")
    world, _ = scene.world(torch.float32)
    torchpt.render(scene, spp=1, film=film_of(4), compile="off")
    with _Counter() as counter:
        image = torchpt.render(
            scene, spp=4, film=film_of(32), compile="off", integrator={"type": "path", "max_depth": 4}
        )
    return counter.calls, counter.elements, image, len(leaves(world))


@functools.cache
def counted_plain() -> tuple[Counter[str], int, torch.Tensor, int]:
    return counted(showcase("diffuse"))


@pytest.mark.parametrize("unused", few(["glass", "comb", "lace", "ember", "shell", "window"], 3))
def test_an_unused_material_costs_nothing(unused):
    plain = showcase("diffuse")
    inner = {
        MATERIALS[unused][key]: MATERIALS[MATERIALS[unused][key]] for key in ("a", "b") if key in MATERIALS[unused]
    }
    more = {**plain, "materials": {**plain["materials"], **inner, "extra": MATERIALS[unused]}}
    calls, elements, image, tensors = counted_plain()
    again = counted(more)
    assert calls == again[0] and elements == again[1] and tensors == again[3]
    assert torch.equal(image, again[2])
    assert calls["aten::mul"] > 0


def test_used_it_does_cost():
    assert counted_plain()[0] != counted(showcase("diffuse", "glass"))[0]


def test_info_says_what_was_left_out():
    def left_out(*names: str) -> list[str]:
        scene = torchpt.load(showcase(*names), "cpu")
        return scene.info(settings(scene.description))["left_out"]

    plain = left_out("diffuse")
    for words in (
        "principled bsdf", "dielectric bsdf", "sorting by bsdf (one model)", "one-sided materials",
        "opacity (every surface is met)", "tangents (nothing is anisotropic)", "refraction (no index along paths)",
        "choice among lobes",
    ):  # fmt: skip
        assert words in plain
    assert "opacity (every surface is met)" not in left_out("lace")
    assert "tangents (nothing is anisotropic)" not in left_out("lathe")
    assert "refraction (no index along paths)" not in left_out("glass")
    assert "one-sided materials" not in left_out("shell")
    assert "choice among lobes" not in left_out("plastic")
    info = torchpt.load(showcase("brushed", "glass"), "cpu")
    made = info.info(settings(info.description))["built"]["bsdfs"]
    assert made == {"diffuse": 2, "roughconductor (anisotropic)": 1, "dielectric": 1}  # floor and lamp have their own


_IMPORTED = """
import sys
sys.path[:0] = {paths!r}
import torchpt
from features import with_feature
scene = torchpt.load(with_feature(None), "cpu")
print(*[name for name in sys.modules if name.startswith("torchpt.physics.bsdfs.kinds.")])
"""


@pytest.mark.slow
def test_a_model_is_imported_where_a_scene_has_it():
    code = _IMPORTED.format(paths=[path for path in sys.path if path.endswith("references")])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.split() == ["torchpt.physics.bsdfs.kinds.diffuse"], done.stderr


# -- kernels of the compiled loop


def _programs(described: dict[str, Any]) -> dict[Any, Program]:
    return {key: kernel.program for key, kernel in kernels(described)[0]._made.items()}


def _of(feature: Feature, programs: dict[Any, Program]) -> tuple[int, int]:
    """Nodes that a feature's files asked for, and tables that it brings."""
    nodes = sum(program.nodes.get(file, 0) for program in programs.values() for file in feature.files)
    leaves = {leaf for program in programs.values() for leaf in program.leaves()}
    return nodes, sum(leaf.startswith(feature.leaves) for leaf in leaves) if feature.leaves else 0


@pytest.fixture(scope="module")
def plain() -> dict[Any, Program]:
    return _programs(with_feature(None))


@pytest.mark.parametrize(
    "name", few([pytest.param(name, marks=pytest.mark.slow) if name == "preview" else name for name in FEATURES], 8)
)
def test_kernels_hold_nothing_of_what_is_not_there(name, plain):
    feature = FEATURES[name]
    assert _of(feature, plain) == (0, 0)
    made, _ = kernels(with_feature(name))
    nodes, tables = _of(feature, {key: kernel.program for key, kernel in made._made.items()})
    assert nodes > 0  # these are its files
    assert tables > 0 or not feature.leaves
    without, _ = kernels(with_feature(None))
    for row in feature.rows:
        assert row in made.state and row not in without.state
    if feature.rows:
        assert made.state.count > without.state.count


@pytest.mark.parametrize("name", few(FEATURES, 4))
def test_kernels_are_the_same_after_it_was_there_and_is_gone(name, plain):
    """Traced anew, not from the cache: the machine code's name is made of the IR."""
    kernels(with_feature(name))
    cache.clear_programs()
    again = _programs(with_feature(None))
    assert {key: program.code for key, program in again.items()} == {
        key: program.code for key, program in plain.items()
    }
    assert len(plain) >= 3


_BLOCKED = """
import sys
sys.path[:0] = {paths!r}
name = sys.argv[1]
if name != "none":
    sys.modules[name] = None
import torchpt
from features import with_feature
image = torchpt.render(torchpt.load(with_feature(None), "cpu"), spp=2, threads=1, compile="on")
print(float(image.double().sum()).hex())
if name != "none":
    from features import FEATURES
    wanted = next(key for key, feature in FEATURES.items() if feature.module == name)
    try:
        torchpt.render(torchpt.load(with_feature(wanted), "cpu"), spp=1, threads=1)
    except ImportError:
        print("missed")
"""


@pytest.fixture(scope="module")
def unblocked() -> list[str]:
    return _blocked("none")


def _blocked(module: str) -> list[str]:
    code = _BLOCKED.format(paths=[path for path in sys.path if path.endswith("references")])
    command = [sys.executable, "-W", "ignore", "-c", code, module]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.slow
@pytest.mark.parametrize("module", sorted({f.module for f in FEATURES.values() if f.module is not None}))
def test_the_same_picture_where_its_module_cannot_be_imported(module, unblocked):
    assert _blocked(module) == [*unblocked, "missed"]
