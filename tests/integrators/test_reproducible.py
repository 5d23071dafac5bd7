"""Each operation on lanes gives the same bits whatever the lane's place and the number of threads (eager, CPU).

Whole pictures are tests/render/test_invariance.py's.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch
from few import few
from showcase import showcase
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from trials import film_of, shoot

import torchpt
from torchpt.engines import tensors
from torchpt.math.sampling import (
    Distribution1D,
    concentric_disk,
    one_minus_cos,
    power_heuristic,
    uniform_cone,
    uniform_sphere,
)
from torchpt.math.vectors import Frame, normalize
from torchpt.paths.wave import Wave
from torchpt.physics.samplers import KINDS as SAMPLERS

GRAIN = 32_768  # elements that torch leaves to one thread
N = 70_003  # above that: two threads share it, and the last vector is not full

MIXED: dict[str, Any] = {
    "camera": {"origin": [0, 0, 0.9], "target": [0, 0.1, -1], "fov": 80},
    "lights": {"sky": {"type": "constant", "radiance": [0.2, 0.3, 0.4]}},
    "shapes": {
        "floor": {"type": "cube", "transform": [{"scale": [1, 0.1, 1]}, {"translate": [0, -1, 0]}]},
        "lamp": {"type": "sphere", "center": [0, 0.5, 0], "radius": 0.2, "emission": [4, 5, 6]},
        "disc": {"type": "disk", "transform": [{"scale": 0.3}, {"translate": [0.5, 0, -1]}], "emission": [1, 2, 3]},
        "pyramid": {
            "type": "mesh",
            "vertices": [[-1, -0.9, -1], [0, -0.9, -1], [-0.5, 0, -0.7], [-0.5, -0.9, -0.2]],
            "faces": [[0, 1, 2], [1, 3, 2], [3, 0, 2]],
            "emission": [0.3, 0.2, 0.1],
        },
    },
}


def _real(seed: int, *shape: int) -> torch.Tensor:
    """Numbers of many magnitudes and both signs, zeros among them."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(*shape, generator=g) * 10.0 ** torch.randint(-6, 7, shape, generator=g)
    return torch.where(torch.rand(*shape, generator=g) < 0.01, torch.zeros(()), x)


A, B, U = _real(1, 3, N), _real(2, 3, N), torch.rand(3, N, generator=torch.Generator().manual_seed(3))
CHOICE = Distribution1D.of(U[0, :999], torch.float32)

#: Arithmetic done on lanes: (name of the operation, function of columns of A, B, U).
OPERATIONS: list[tuple[str, Callable[..., torch.Tensor]]] = [
    ("add", lambda a, b, u: a + b),
    ("sub", lambda a, b, u: a - b),
    ("rsub", lambda a, b, u: 1.0 - u),
    ("mul", lambda a, b, u: a * b),
    ("mul", lambda a, b, u: a[0] * b[0] + a[1] * b[1] + a[2] * b[2]),
    ("div", lambda a, b, u: a / b),
    ("reciprocal", lambda a, b, u: 1.0 / a),
    ("neg", lambda a, b, u: -a),
    ("abs", lambda a, b, u: a.abs()),
    ("sqrt", lambda a, b, u: a.abs().sqrt()),
    ("sin", lambda a, b, u: torch.sin(2.0 * math.pi * u)),
    ("cos", lambda a, b, u: torch.cos(2.0 * math.pi * u)),
    ("sin", lambda a, b, u: torch.sin((math.pi / 4) * (2.0 * u - 1.0))),
    ("cos", lambda a, b, u: torch.cos((math.pi / 4) * (2.0 * u - 1.0))),
    ("sign", lambda a, b, u: torch.sign(a)),
    ("copysign", lambda a, b, u: torch.copysign(a, b)),
    ("clamp_min", lambda a, b, u: a.clamp_min(0.0)),
    ("clamp_max", lambda a, b, u: a.clamp_max(0.95)),
    ("clamp", lambda a, b, u: a.clamp(-0.5, 0.5)),
    ("exp", lambda a, b, u: torch.exp(a.clamp(-80.0, 80.0))),
    ("expm1", lambda a, b, u: torch.expm1(a.clamp(-80.0, 80.0))),
    ("log", lambda a, b, u: torch.log(a.abs() + 1e-6)),
    ("log1p", lambda a, b, u: torch.log1p(-u * (1.0 - 2.0**-24))),
    ("pow", lambda a, b, u: a.square()),
    ("rsqrt", lambda a, b, u: (a.abs() + 1e-6).rsqrt()),
    ("floor", lambda a, b, u: torch.floor(a)),
    ("minimum", lambda a, b, u: torch.minimum(a, b)),
    ("maximum", lambda a, b, u: torch.maximum(a, b)),
    ("addcmul", lambda a, b, u: torch.addcmul(a, b, u)),
    ("addcmul", lambda a, b, u: torch.addcmul(a, b, u[0], value=-1)),
    ("addcmul", lambda a, b, u: torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])),
    ("addcmul", lambda a, b, u: torch.addcmul(A[:, :1], A[:, 1:2], u[0])),
    ("amax", lambda a, b, u: a.amax(0)),
    ("where", lambda a, b, u: torch.where(a > b, a, 1.0)),
    ("isinf", lambda a, b, u: torch.isinf(a).float()),
    ("_to_copy", lambda a, b, u: (a.clamp(-1e6, 1e6)).to(torch.int64).to(torch.float32)),
    ("", lambda a, b, u: normalize(a)),
    ("", lambda a, b, u: torch.stack((*Frame.about(normalize(a)).to_local(b), *Frame.about(normalize(b)).to_world(a)))),
    ("", lambda a, b, u: power_heuristic(a[0].abs(), b[0].abs())),
    ("", lambda a, b, u: torch.cat((concentric_disk(u), uniform_sphere(u), uniform_cone(u, u[2])))),
    ("", lambda a, b, u: one_minus_cos(u)),
    ("", lambda a, b, u: CHOICE.draw(u[0])[0].float()),
    ("", lambda a, b, u: CHOICE.draw(u[0])[1].float()),
]
#: What moves numbers or makes constants, without arithmetic (scatters here have distinct indices), and operators of ours
#: that tests of their own hold to the bit: tests/samplers/test_kernels.py, tests/search.
EXACT = {
    "_to_copy", "_unsafe_view", "alias", "arange", "cat", "clone", "copy_", "detach", "empty", "empty_like", "expand",
    "full", "full_like", "gather", "index", "index_copy", "index_select", "lift_fresh", "new_zeros", "ones", "ones_like",
    "permute",
    "repeat", "repeat_interleave", "scalar_tensor", "scatter_", "scatter_add_", "select", "slice", "sort", "split",
    "squeeze", "stack", "take", "unsqueeze", "view", "zeros", "zeros_like", "draw",
}  # fmt: skip


@pytest.mark.parametrize("number", few(range(len(OPERATIONS)), 12))
def test_a_lanes_value_does_not_depend_on_its_place(number):
    operation = OPERATIONS[number][1]

    def at(first: int, last: int, view: bool) -> torch.Tensor:
        columns = (x[:, first:last] for x in (A, B, U))
        return operation(*(c if view else c.contiguous() for c in columns))

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        whole = at(0, N, True)
        torch.set_num_threads(2)
        assert _same(at(0, N, True), whole)
        for first, size in ((0, 1), (5, 1), (1, 3), (7, 13), (3, 1001), (11, 32_769), (1, N - 1), (N - 37, 37)):
            for view in (False, True):
                assert _same(at(first, first + size, view), whole[..., first : first + size]), (first, size, view)
    finally:
        torch.set_num_threads(before)


def _same(a: torch.Tensor, b: torch.Tensor) -> bool:
    return torch.equal(a.contiguous().view(torch.int32), b.contiguous().view(torch.int32))


class _Recorder(TorchDispatchMode):
    """Names of the operations that gave floating tensors."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        if any(isinstance(x, torch.Tensor) and x.is_floating_point() and x.dim() for x in tree_leaves(out)):
            if not _compiling():
                self.seen.add(func._schema.name.split("::")[1])
        return out


def _compiling() -> bool:
    """Return True where the lane compiler asks: what it traces becomes a kernel, and what it does to tables is no lane."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        if "/torchpt/compiler/" in frame.f_code.co_filename:
            return True
        frame = frame.f_back
    return False


@pytest.mark.slow
def test_the_audit_covers_what_waves_use(monkeypatch):
    recorder = _Recorder()

    def recorded(method: Any) -> Any:
        def call(*given: Any, **named: Any) -> Any:
            with recorder:
                return method(*given, **named)

        return call

    monkeypatch.setattr(Wave, "rays", recorded(Wave.rays))
    monkeypatch.setattr(tensors, "weighted_radiance", recorded(tensors.weighted_radiance))
    materials = torchpt.load(showcase(), device="cpu")
    for strategy in ("mis", "light", "uniform"):
        shoot(materials, 2, 0, "sobol", {"strategy": strategy, "max_depth": 4}, film_of(16), accel="brute")
    scene = torchpt.load(MIXED, device="cpu")
    strategies = product(("mis", "bsdf", "light", "uniform"), ("box", "gaussian", "tent", "mitchell"))
    for (strategy, filter), sampler in zip(strategies, 4 * list(SAMPLERS), strict=False):
        keys = {"strategy": strategy, "max_depth": 5, "rr_depth": 2}
        shoot(scene, 2, 0, sampler, keys, {**film_of(8), "filter": filter}, accel="brute")
    assert "mul" in recorder.seen
    assert recorder.seen - EXACT - {name for name, _ in OPERATIONS} <= {"tan"}  # of the camera's angle: one number


class _Twice(TorchDispatchMode):
    """Repeats what is done with large tensors on one thread and on two, and names what gives other bits."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: set[str] = set()
        self.other: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given, name = (args, kwargs or {}), func._schema.name.split("::")[1]
        if "empty" not in name and any(x.numel() > GRAIN for x in tree_leaves(given) if isinstance(x, torch.Tensor)):
            before = torch.get_num_threads()
            one, two = (self._bits(func, given, threads) for threads in (1, 2))
            torch.set_num_threads(before)
            self.seen.add(name)
            if any(not torch.equal(a, b) for a, b in zip(one, two, strict=True)):
                self.other.add(name)
        return func(*args, **(kwargs or {}))

    @staticmethod
    def _bits(func: Any, given: Any, threads: int) -> list[torch.Tensor]:
        torch.set_num_threads(threads)
        if func._schema.is_mutable:
            given = tree_map(lambda x: x.detach().clone() if isinstance(x, torch.Tensor) else x, given)
        found = func(*given[0], **given[1]), given if func._schema.is_mutable else ()
        return [x.detach().contiguous().view(-1).view(torch.uint8) for x in tree_leaves(found) if torch.is_tensor(x)]


def _large(folder: Path) -> dict[str, Any]:
    """A mesh, an image and a map that threads divide, none of them into whole vectors."""
    rng = np.random.default_rng(5)
    torchpt.write_image(folder / "map.exr", torch.from_numpy(rng.random((181, 301, 3), np.float32)) ** 8)
    torchpt.write_image(folder / "image.png", torch.from_numpy(rng.random((151, 223, 3), np.float32)))
    side = 151
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    vertices = np.stack((x, y, 0.02 * rng.random((side, side))), 2).reshape(-1, 3)
    first = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1)
    corners = np.stack((first, first + 1, first + side + 1, first + side), 1)
    return {
        "camera": {"origin": [0, 0, 2], "target": [0, 0, 0], "fov": 70},
        "lights": {"sky": {"type": "envmap", "path": str(folder / "map.exr")}},
        "materials": {
            "cloth": {"type": "diffuse", "reflectance": {"type": "image", "path": str(folder / "image.png")}},
            "metal": {"type": "roughconductor", "alpha": 0.2},
        },
        "shapes": {
            "hills": {
                "type": "mesh",
                "vertices": vertices.tolist(),
                "faces": corners[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).tolist(),
                "material": "metal",
            },
            "card": {
                "type": "rectangle",
                "transform": [{"scale": 0.3}, {"translate": [0, 0, 0.5]}],
                "material": "cloth",
            },
            "lamp": {"type": "sphere", "center": [0.7, 0, 0.6], "radius": 0.2, "emission": [4, 5, 6]},
        },
    }


@pytest.mark.slow
def test_no_operation_of_a_render_depends_on_the_threads(tmp_path):
    """From the files to the picture and its error; waves, and what is made for them once."""
    description = _large(tmp_path)
    twice = _Twice()
    with twice:
        scene = torchpt.load(description, device="cpu")
        shoot(scene, 4, 1, "sobol", {"max_depth": 2}, film_of(96), pilots=True)
    assert {"addcmul", "sqrt", "sum"} <= twice.seen
    assert not twice.other
