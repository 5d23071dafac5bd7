"""Tables of materials are kept for numbers that come again, and only there."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.physics.bsdfs.kinds.roughconductor import RoughConductor
from torchpt.physics.bsdfs.kinds.roughdielectric import RoughDielectric
from torchpt.physics.bsdfs.kinds.roughplastic import RoughPlastic

MODELS = [
    (RoughPlastic(), "inner"),
    (RoughPlastic(beckmann=True), "inner"),
    (RoughDielectric(energy_compensation=True), "energy"),
    (RoughConductor(energy_compensation=True), "energy"),
]


def numbers(alpha: float) -> dict[str, Any]:
    index = {"int_ior": torch.tensor([1.5]), "ext_ior": torch.tensor([1.0])}
    return {"alpha": torch.tensor([alpha]), "diffuse_reflectance": torch.rand(3, 1), **index}


def all_numbers(tables: Any) -> Tensor:
    parts = (
        tables.values() if isinstance(tables, dict) else vars(tables).values() if hasattr(tables, "count") else [tables]
    )
    found = [all_numbers(part) if not isinstance(part, Tensor) else part.reshape(-1) for part in parts if part is not None
             and not isinstance(part, int)]  # fmt: skip
    return torch.cat(found) if found else torch.empty(0)


@pytest.mark.parametrize(("model", "name"), MODELS, ids=lambda x: getattr(x, "name", x))
def test_tables_of_equal_numbers_are_computed_once(model: Any, name: str) -> None:
    first, again, other = (model.tabulate(numbers(alpha)) for alpha in (0.37, 0.37, 0.38))
    assert first[name] is again[name] and first is not again
    assert not torch.equal(all_numbers(first), all_numbers(other))
    anew = type(model).tabulate.__wrapped__(model, numbers(0.37))
    assert torch.equal(all_numbers(first), all_numbers(anew))


def test_tables_by_which_derivatives_are_wanted_are_not_kept() -> None:
    values = numbers(0.41)
    RoughPlastic().tabulate(values)
    values["alpha"].requires_grad_()
    (slope,) = torch.autograd.grad(RoughPlastic().tabulate(values)["inner"].sum(), values["alpha"])
    step = 1e-3
    ends = [float(RoughPlastic().tabulate(numbers(0.41 + h))["inner"]) for h in (step, -step)]
    assert float(slope) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.02)

    def inner(alpha: Tensor) -> Tensor:
        return RoughPlastic().tabulate({**numbers(0.41), "alpha": alpha})["inner"].sum()

    assert float(torch.func.grad(inner)(torch.tensor([0.41]))) == pytest.approx(float(slope), rel=1e-3)


def test_tables_made_in_inference_mode_serve_gradients() -> None:
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 0, 3], "target": [0, 0, 0]},
            "film": {"width": 4, "height": 4},
            "materials": {"coat": {"type": "roughplastic", "alpha": 0.2345}},
            "shapes": {"ball": {"type": "sphere", "material": "coat"}},
            "lights": {"sky": {"type": "constant"}},
        },
        "cpu",
    )
    with torch.inference_mode():
        torchpt.render(scene, spp=1)
    color = scene.params["materials.coat.diffuse_reflectance"].clone().requires_grad_()
    torchpt.render(scene, spp=1, params={"materials.coat.diffuse_reflectance": color}).mean().backward()
    assert color.grad is not None and float(color.grad.sum()) > 0
