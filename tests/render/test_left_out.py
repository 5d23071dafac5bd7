"""What a scene does not use costs nothing: no tensor, no operator call, and `info` says so."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
import torch
from showcase import MATERIALS, showcase
from torch.utils._python_dispatch import TorchDispatchMode
from trials import film_of

import torchpt
from torchpt.records import tensors_of
from torchpt.scene.description import settings


class _Counter(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.calls: Counter[str] = Counter()
        self.elements = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        self.calls[func._schema.name] += 1
        self.elements += sum(t.numel() for t in tensors_of(out)) if not isinstance(out, bool) else 0
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
    return counter.calls, counter.elements, image, len(tensors_of(world))


@pytest.mark.parametrize("unused", ["glass", "comb", "lace", "ember", "shell", "window"])
def test_an_unused_material_costs_nothing(unused):
    plain = showcase("diffuse")
    inner = {
        MATERIALS[unused][key]: MATERIALS[MATERIALS[unused][key]] for key in ("a", "b") if key in MATERIALS[unused]
    }
    more = {**plain, "materials": {**plain["materials"], **inner, "extra": MATERIALS[unused]}}
    calls, elements, image, tensors = counted(plain)
    again = counted(more)
    assert calls == again[0] and elements == again[1] and tensors == again[3]
    assert torch.equal(image, again[2])
    assert calls["aten::mul"] > 0


def test_used_it_does_cost():
    assert counted(showcase("diffuse"))[0] != counted(showcase("diffuse", "glass"))[0]


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
