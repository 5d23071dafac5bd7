"""Forward mode and second derivatives: against finite differences, against gradients, and against each other."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.core.errors import RenderError, TorchptError

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's, where it first meets forward mode

#: A point light and one vertex: nothing is sampled by a BSDF, so that a picture is a smooth function of what materials hold.
MATERIALS: dict[str, dict[str, Any]] = {
    "diffuse": {"type": "diffuse", "reflectance": [0.6, 0.4, 0.2]},
    "roughconductor": {"type": "roughconductor", "roughness": 0.4, "eta": [0.2, 0.4, 1.4], "k": [3.2, 2.4, 1.7]},
    "roughdiffuse": {"type": "roughdiffuse", "reflectance": [0.6, 0.4, 0.2], "alpha": 0.5},
    "beckmann": {
        "type": "roughconductor",
        "distribution": "beckmann",
        "alpha_u": 0.3,
        "alpha_v": 0.5,
        "eta": [0.2, 0.4, 1.4],
        "k": [3.2, 2.4, 1.7],
    },
    "principled": {
        "type": "principled",
        "base_color": [0.5, 0.3, 0.2],
        "roughness": 0.4,
        "metallic": 0.3,
        "sheen": 0.4,
    },
    "blend": {"type": "blend", "weight": 0.3, "a": "diffuse", "b": "roughconductor"},
}
#: Materials with tables, whose values are a little uneven over short steps.
COATS: dict[str, dict[str, Any]] = {
    f"coat_{name}": {"type": "roughplastic", "distribution": name, "diffuse_reflectance": [0.4, 0.5, 0.6], "alpha": 0.3}
    for name in ("ggx", "beckmann")
}
WISHES: dict[str, Any] = {"spp": 4, "seed": 3, "seed_grad": 3, "threads": 1, "compile": "off"}


def lit(material: str) -> torchpt.Scene:
    return torchpt.load(
        {
            "camera": {"origin": [0.4, 0.3, 2], "target": [0, 0, 0], "fov": 40},
            "film": {"width": 5, "height": 4, "filter": "gaussian"},
            "integrator": {"type": "path", "max_depth": 2},
            "materials": {**MATERIALS, **COATS},
            "shapes": {"plate": {"type": "rectangle", "material": material, "transform": [{"scale": 2}]}},
            "lights": {"bulb": {"type": "point", "position": [0.5, -0.3, 1.5], "intensity": [5, 4, 3]}},
        },
        "cpu",
    )


def enclosed(**more: Any) -> torchpt.Scene:
    """Return a ball in a half-open room with texels, light of a surface and of the sky."""
    texels = 0.2 + 0.6 * torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(2))
    return torchpt.load(
        {
            "camera": {"origin": [0, 1, 4], "target": [0, 0, 0], "fov": 40},
            "film": {"width": 6, "height": 5},
            "integrator": {"type": "path", "max_depth": 4, **more},
            "materials": {
                "floor": {"type": "diffuse", "reflectance": texels},
                "ball": {"type": "roughconductor", "reflectance": 0.9, "roughness": 0.4, "opacity": 0.7},
            },
            "shapes": {
                "floor": {
                    "type": "rectangle",
                    "material": "floor",
                    "transform": [{"scale": 2}, {"rotate": {"axis": [1, 0, 0], "angle": -70}}],
                },
                "ball": {"type": "sphere", "radius": 0.6, "center": [0, 0.5, 0.3], "material": "ball"},
                "lamp": {"type": "sphere", "radius": 0.3, "center": [1, 1.5, 1], "emission": [4, 3, 2]},
            },
            "lights": {"sky": {"type": "constant", "radiance": [0.3, 0.4, 0.5]}},
        },
        "cpu",
    )


def direction(like: Tensor, seed: int = 1) -> Tensor:
    return torch.randn(like.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(like.dtype)


def loss_of(scene: torchpt.Scene, name: str, **wishes: Any) -> Callable[[Tensor], Tensor]:
    """Return a loss of second order in the picture."""

    def loss(value: Tensor) -> Tensor:
        picture = torchpt.render(scene, params={name: value}, **{**WISHES, **wishes})
        weights = torch.linspace(0.5, 1.5, picture.numel(), dtype=picture.dtype).reshape(picture.shape)
        return (weights * picture * (1 + picture)).mean()

    return loss


def hessian_product(loss: Callable[[Tensor], Tensor], at: Tensor, u: Tensor) -> Tensor:
    return torch.func.jvp(torch.func.grad(loss), (at,), (u,))[1]


@pytest.mark.parametrize("material", MATERIALS)
def test_derivatives_of_materials_are_those_of_finite_differences(material: str):
    scene = lit(material)
    names = [name for name in scene.params if name.startswith(f"materials.{material}.")]
    assert names
    for name in [*names, "lights.bulb.intensity"]:
        at = scene.params[name].double()
        if not at.any():
            continue  # lobes that are off, at the end of their range
        u, step = direction(at), 1e-4 * float(at.abs().max())
        loss = loss_of(scene, name, dtype=torch.float64)
        gradient = torch.func.grad(loss)
        slope = (loss(at + step * u) - loss(at - step * u)) / (2 * step)
        torch.testing.assert_close(torch.func.jvp(loss, (at,), (u,))[1], slope, rtol=1e-4, atol=1e-7)
        bend = (gradient(at + step * u) - gradient(at - step * u)) / (2 * step)
        torch.testing.assert_close(hessian_product(loss, at, u), bend, rtol=2e-4, atol=1e-6, msg=name)


@pytest.mark.parametrize("name", ["alpha", "int_ior"])
@pytest.mark.parametrize("coat", COATS)
def test_derivatives_of_rough_coats_are_those_of_long_differences(coat: str, name: str):
    """Steps that move total internal reflection past nodes of a quadrature, if its tables have such nodes."""
    scene = lit(coat)
    path = f"materials.{coat}.{name}"
    at = scene.params[path].double()
    one, step = torch.ones_like(at), 0.05 * at
    loss = loss_of(scene, path, dtype=torch.float64)
    low, middle, high = (loss(at + i * step) for i in (-1, 0, 1))
    lower, higher = loss(at - 2 * step), loss(at + 2 * step)
    slope = (8 * (high - low) - (higher - lower)) / (12 * step)
    bend = (16 * (high + low) - (higher + lower) - 30 * middle) / (12 * step**2)
    torch.testing.assert_close(torch.func.grad(loss)(at), slope, rtol=5e-3, atol=0.0)
    torch.testing.assert_close(torch.func.jvp(loss, (at,), (one,))[1], slope, rtol=5e-3, atol=0.0)
    # A curvature of the slope over the number is a large one.
    torch.testing.assert_close(
        hessian_product(loss, at, one), bend, rtol=0.03, atol=0.03 * float(slope.abs() / at), msg=name
    )


NAMES = (
    "materials.floor.reflectance",
    "materials.ball.roughness",
    "materials.ball.opacity",
    "shapes.lamp.emission",
    "lights.sky.radiance",
)


@pytest.mark.parametrize("name", NAMES)
def test_forward_and_reverse_mode_of_the_same_samples_agree(name: str):
    scene = enclosed()
    at = scene.params[name].clone()
    u = direction(at)

    def picture(value: Tensor, **wishes: Any) -> Tensor:
        return torchpt.render(scene, params={name: value}, **{**WISHES, **wishes})

    value, tangent = torch.func.jvp(picture, (at,), (u,))[:2]
    assert torch.equal(value, picture(at))
    cotangent = direction(value, 5)
    (gradient,) = torch.func.vjp(picture, at)[1](cotangent)
    expected = (gradient.double() * u.double()).sum()
    torch.testing.assert_close((tangent.double() * cotangent).sum(), expected, rtol=2e-4, atol=1e-5)
    of_others = torch.func.jvp(lambda x: picture(x, seed_grad=9, spp_grad=2), (at,), (u,))[1]
    assert torch.equal(of_others, tangent)  # samples of the picture, whatever those of gradients


@pytest.mark.slow
def test_second_derivatives_of_a_squared_loss_have_no_bias():
    """The product of two Jacobians, whose samples must not be the same ones: their noise would be squared."""
    scene, name = enclosed(), "lights.sky.radiance"
    at = scene.params[name].clone()
    u = torch.ones_like(at)

    def product(seed: int, spp: int) -> float:
        def loss(value: Tensor) -> Tensor:
            wishes = {**WISHES, "spp": spp, "seed": seed, "seed_grad": None}
            return torchpt.render(scene, params={name: value}, **wishes).square().mean()

        return float(hessian_product(loss, at, u) @ u)

    known = product(0, 512)
    found = [product(seed, 1) for seed in range(1, 33)]
    error = statistics.stdev(found) / math.sqrt(len(found))
    assert abs(statistics.fmean(found) - known) < 3.5 * error + 0.01 * known
    assert error < 0.1 * known  # what the same samples would add is more


def test_hessians_are_symmetric_and_cross_from_one_parameter_to_another():
    scene = enclosed()
    pair = NAMES[0], NAMES[1]
    at = [scene.params[name].clone() for name in pair]

    def loss(*values: Tensor) -> Tensor:
        wishes = {**WISHES, "compile": "auto"}  # the gradient by kernels
        return torchpt.render(scene, params=dict(zip(pair, values, strict=True)), **wishes).square().mean()

    u, v = direction(at[0]), direction(at[1])
    gradient = torch.func.grad(loss, argnums=(0, 1))
    zero = [torch.zeros_like(x) for x in at]
    across = torch.func.jvp(gradient, tuple(at), (u, zero[1]))[1][1]
    back = torch.func.jvp(gradient, tuple(at), (zero[0], v))[1][0]
    assert float((across * v).sum()) != 0.0
    torch.testing.assert_close((across * v).sum(), (back * u).sum(), rtol=1e-3, atol=1e-7)
    leaves = [x.clone().requires_grad_() for x in at]
    first = torch.autograd.grad(loss(*leaves), leaves, create_graph=True)
    (found,) = torch.autograd.grad((first[0] * u).sum(), leaves[1])
    torch.testing.assert_close(found, across, rtol=1e-4, atol=1e-7)


def test_second_derivatives_of_colours_are_those_of_finite_differences():
    """Of light that is reflected twice; the draws do not depend on a colour."""
    scene, name = enclosed(rr_depth=100), "materials.floor.reflectance"
    at = scene.params[name].double()
    u, step = direction(at), 1e-4
    loss = loss_of(scene, name, dtype=torch.float64)
    gradient = torch.func.grad(loss)
    bend = (gradient(at + step * u) - gradient(at - step * u)) / (2 * step)
    torch.testing.assert_close(hessian_product(loss, at, u), bend, rtol=1e-4, atol=1e-9)


@pytest.mark.slow
def test_second_derivatives_by_roughness_where_directions_are_drawn_by_it():
    """Means over seeds against differences of gradients; of a linear loss, which sees no noise of the picture."""
    scene, name = enclosed(), "materials.ball.roughness"
    at, step = scene.params[name].double(), 0.04

    def gradient(value: Tensor, seed: int, spp: int) -> Tensor:
        def loss(value: Tensor) -> Tensor:
            return torchpt.render(scene, params={name: value}, spp=1, spp_grad=spp, seed_grad=seed).double().mean()

        return (
            torch.func.grad(loss)(value.float())
            if spp > 64
            else torch.func.jvp(
                torch.func.grad(loss), (value.float(),), (torch.ones_like(value, dtype=torch.float32),)
            )[1]
        )

    found = [float(gradient(at, seed, 64)) for seed in range(24)]
    known = [float(gradient(at + step, k, 2048) - gradient(at - step, k, 2048)) / (2 * step) for k in range(6)]
    error = math.hypot(*(statistics.stdev(x) / math.sqrt(len(x)) for x in (found, known)))
    off = statistics.fmean(found) - statistics.fmean(known)
    assert abs(off) < 3.5 * error + 0.03 * abs(statistics.fmean(known)), (found, known)


def test_jacobians_by_batches_of_tangents():
    scene, name = enclosed(), "materials.ball.roughness"
    loss = loss_of(scene, name)
    at = scene.params[name].clone()
    gradient = torch.func.grad(loss)(at)
    torch.testing.assert_close(torch.func.jacfwd(loss)(at), gradient, rtol=1e-4, atol=1e-7)
    product = hessian_product(loss, at, torch.ones_like(at))
    torch.testing.assert_close(torch.func.hessian(loss)(at), product, rtol=1e-4, atol=1e-7)
    with torch.autograd.forward_ad.dual_level():
        dual = loss(torch.autograd.forward_ad.make_dual(at, torch.ones_like(at)))
        tangent = torch.autograd.forward_ad.unpack_dual(dual).tangent
    torch.testing.assert_close(tangent, gradient, rtol=1e-4, atol=1e-7)


@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
@pytest.mark.parametrize("name", ["shapes.ball.to_world", "camera.to_world", "camera.fov"])
def test_what_moves_is_refused(name: str):
    scene = enclosed()
    at, loss = scene.params[name].clone(), loss_of(scene, name)
    u = torch.ones_like(at)
    with pytest.raises(RenderError, match=f"^{name}: render has forward-mode and second derivatives of colours"):
        torch.func.jvp(loss, (at,), (u,))
    with pytest.raises(RenderError, match=f"^{name}: render has forward-mode"):
        hessian_product(loss, at, u)


def test_third_derivatives_are_refused():
    scene, name = enclosed(), "materials.ball.roughness"
    loss, at = loss_of(scene, name), scene.params["materials.ball.roughness"].clone()
    second = torch.func.grad(torch.func.grad(loss))
    with pytest.raises(TorchptError, match="^render has no third derivatives"):
        torch.func.grad(second)(at)
    with pytest.raises(TorchptError, match="^render has no third derivatives"):
        torch.func.jvp(second, (at,), (torch.ones_like(at),))


def test_derivatives_by_what_no_surface_has_are_zero():
    unused = {**MATERIALS, "unused": {"type": "diffuse", "reflectance": [0.5, 0.4, 0.3]}}
    camera = {"origin": [0, 0, 4], "target": [0, 0, 0]}
    scene = torchpt.load(
        {"camera": camera, "film": {"width": 3, "height": 2}, "materials": unused, "shapes": {}}, "cpu"
    )
    name = "materials.unused.reflectance"
    loss, at = loss_of(scene, name), scene.params[name].clone()
    assert torch.func.jvp(loss, (at,), (torch.ones_like(at),))[1] == 0.0
    assert torch.equal(torch.func.hessian(loss)(at), torch.zeros(3, 3))


def test_a_jvp_by_its_tangent():
    """Where the parameter requires gradients, it is the VJP; a constant has none."""
    scene, name = enclosed(), "materials.ball.roughness"
    loss, at = loss_of(scene, name), scene.params[name].clone()

    def change(value: Tensor, u: Tensor) -> Tensor:
        return torch.func.jvp(loss, (value,), (u,))[1]

    leaf, u = at.clone().requires_grad_(), torch.ones_like(at, requires_grad=True)
    (by_tangent,) = torch.autograd.grad(change(leaf, u), u)
    torch.testing.assert_close(by_tangent, torch.func.grad(loss)(at), rtol=1e-4, atol=1e-7)
    with pytest.raises(RenderError, match="^render has no derivatives of a JVP by its tangent"):
        torch.func.grad(lambda u: change(at, u))(torch.ones_like(at))


@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
def test_second_derivatives_of_layers_are_refused():
    scene, name = enclosed(), "shapes.ball.to_world"
    at = scene.params[name].clone()

    def depth(value: Tensor) -> Tensor:
        rendering = torchpt.render(scene, params={name: value}, full=True, film={"aovs": ["depth"]}, **WISHES)
        return rendering.layers["depth"].sum()

    with pytest.raises(TorchptError, match="^a layer such as depth has no second derivatives"):
        torch.func.grad(lambda value: torch.func.grad(depth)(value).sum())(at)
