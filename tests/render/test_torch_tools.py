"""torch's own tools around ``render``: ``torch.func``, ``autograd.functional``, checkpoints, several backward passes, modes."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

import torchpt
from torchpt.core.errors import RenderError, SceneError, TorchptError

WALL = "materials.wall.reflectance"
WISHES: dict[str, Any] = {"spp": 4, "seed": 3, "threads": 1, "compile": "off"}
ROOM: dict[str, Any] = {
    "camera": {"type": "perspective", "origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40},
    "film": {"width": 6, "height": 5, "filter": "box"},
    "integrator": {"type": "path", "max_depth": 3},
    "materials": {"wall": {"type": "diffuse", "reflectance": [0.6, 0.4, 0.2]}},
    "shapes": {"back": {"type": "rectangle", "material": "wall", "transform": [{"scale": 2}]}},
    "lights": {"sun": {"type": "point", "position": [1, 1, 2], "intensity": 5}},
}


@pytest.fixture(scope="module")
def scene() -> torchpt.Scene:
    return torchpt.load(ROOM, "cpu")


@pytest.fixture
def colour(scene) -> Tensor:
    return scene.params[WALL].clone()


@pytest.fixture
def picture(scene) -> Callable[[Tensor], Tensor]:
    return lambda colour: torchpt.render(scene, params={WALL: colour}, **WISHES)


@pytest.fixture
def loss(picture) -> Callable[[Tensor], Tensor]:
    return lambda colour: (picture(colour) ** 2).mean()


def gradient(loss: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """By ``backward``, which all else is held against."""
    leaf = at.clone().requires_grad_()
    loss(leaf).backward()
    assert leaf.grad is not None and float(leaf.grad.abs().max()) > 0
    return leaf.grad


# -- torch.func


def test_func_grad_and_vjp(picture, loss, colour):
    expected = gradient(loss, colour)
    assert torch.equal(torch.func.grad(loss)(colour), expected)
    value, back = torch.func.vjp(loss, colour)[:2]
    assert torch.equal(back(torch.ones(()))[0], expected) and torch.equal(value, loss(colour))
    back = torch.func.vjp(picture, colour)[1]
    torch.testing.assert_close(back(2 * picture(colour) / 90)[0], expected)


def test_func_grad_of_a_pose_and_of_constants_beside_it(scene, colour):
    def loss(pose: Tensor, colour: Tensor) -> Tensor:
        return torchpt.render(scene, params={WALL: colour, "camera.to_world": pose}, **WISHES).mean()

    pose = scene.params["camera.to_world"]
    assert torch.equal(torch.func.grad(loss)(pose, colour), gradient(lambda pose: loss(pose, colour), pose))


def test_a_refused_parameter_is_refused_under_a_transform_too(loss, colour):
    for transform in (torch.func.grad, lambda loss: torch.func.vmap(loss)):
        with pytest.raises(SceneError, match=f"params.{WALL}: expected"):
            transform(loss)(torch.stack([colour - 5, colour - 5]) if transform is not torch.func.grad else colour - 5)


def test_vmap_renders_one_picture_after_the_other(picture, loss, colour):
    colours = torch.stack([colour, colour / 2])
    assert torch.equal(torch.func.vmap(picture)(colours), torch.stack([picture(c) for c in colours]))
    grads = torch.stack([gradient(loss, c) for c in colours])
    assert torch.equal(torch.func.vmap(torch.func.grad(loss))(colours), grads)
    torch.testing.assert_close(torch.func.grad(lambda c: torch.func.vmap(loss)(c).sum())(colours), grads)
    assert torch.equal(torch.func.vmap(picture, in_dims=1)(colours.T.contiguous())[1], picture(colour / 2))


def test_a_full_rendering_of_a_batch_is_refused(scene, colour):
    with pytest.raises(SceneError, match=r"full: expected False under torch\.func\.vmap"):
        torch.func.vmap(lambda c: torchpt.render(scene, params={WALL: c}, full=True, **WISHES).image)(colour[None])


def test_jacobians_by_batches_of_cotangents(picture, colour):
    def mean(colour: Tensor) -> Tensor:
        return picture(colour).mean((0, 1))

    expected = torch.stack(
        [torch.autograd.grad(mean(leaf := colour.clone().requires_grad_())[k], leaf)[0] for k in range(3)]
    )
    assert torch.equal(torch.func.jacrev(mean)(colour), expected)
    assert torch.equal(torch.autograd.functional.jacobian(mean, colour), expected)
    # torch's older kind of batches, which no function of a caller's own ever sees as such
    with pytest.raises(TorchptError, match=r"^render takes batches of cotangents by torch\.func\.jacrev alone"):
        torch.autograd.functional.jacobian(mean, colour, vectorize=True)


def test_functional_vjp(loss, colour):
    found: Any = torch.autograd.functional.vjp(loss, colour)[1]
    assert torch.equal(found, gradient(loss, colour))


# -- forward mode and second derivatives (tests/gradients/test_second.py has their values)


TWICE: dict[str, Callable[..., Any]] = {
    "jvp of grad": lambda loss, c, u: torch.func.jvp(torch.func.grad(loss), (c,), (u,))[1],
    "hessian": lambda loss, c, u: torch.func.hessian(loss)(c) @ u,
    "create_graph": lambda loss, c, u: torch.autograd.grad(gradient_on_tape(loss, c) @ u, c)[0],
    "grad of grad": lambda loss, c, u: torch.func.grad(lambda c: torch.func.grad(loss)(c) @ u)(c),
    "hvp": lambda loss, c, u: torch.autograd.functional.hvp(loss, c, u)[1],
    "vhp": lambda loss, c, u: torch.autograd.functional.vhp(loss, c, u)[1],
    "functional.hessian": lambda loss, c, u: torch.autograd.functional.hessian(loss, c) @ u,
}
ONCE: dict[str, Callable[..., Any]] = {
    "jvp": lambda loss, c, u: torch.func.jvp(loss, (c,), (u,))[1],
    "jacfwd": lambda loss, c, u: torch.func.jacfwd(loss)(c) @ u,
    "functional.jvp": lambda loss, c, u: torch.autograd.functional.jvp(loss, c, u)[1],
}


def gradient_on_tape(loss: Callable[[Tensor], Tensor], leaf: Tensor) -> Tensor:
    leaf.requires_grad_()
    return torch.autograd.grad(loss(leaf), leaf, create_graph=True)[0]


own = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's, where it first meets forward mode


@own
@pytest.mark.parametrize("way", ONCE)
def test_forward_mode_differentiates_the_picture_itself(loss, colour, way):
    u, step = torch.tensor([1.0, -0.5, 0.3]), 0.01
    expected = (loss(colour + step * u) - loss(colour - step * u)) / (2 * step)
    torch.testing.assert_close(ONCE[way](loss, colour, u), expected, rtol=1e-3, atol=1e-6)


@own
@pytest.mark.parametrize("way", TWICE)
def test_each_way_to_second_derivatives_gives_the_same(loss, colour, way):
    u, step = torch.tensor([1.0, -0.5, 0.3]), 0.01
    expected = (gradient(loss, colour + step * u) - gradient(loss, colour - step * u)) / (2 * step)
    torch.testing.assert_close(TWICE[way](loss, colour, u), expected, rtol=1e-3, atol=1e-6)


def test_create_graph_alone_gives_the_gradient(loss, colour):
    leaf = colour.clone().requires_grad_()
    (found,) = torch.autograd.grad(loss(leaf), leaf, create_graph=True)
    assert torch.equal(found.detach(), gradient(loss, colour))


# -- graphs of several renders, and several backward passes


def test_two_renders_of_one_parameter_add_up(loss, colour):
    twice = gradient(lambda c: loss(c) + loss(c), colour)
    torch.testing.assert_close(twice, 2 * gradient(loss, colour), rtol=1e-6, atol=0)


def test_a_graph_that_is_kept_gives_the_same_gradient_again(loss, colour):
    leaf = colour.clone().requires_grad_()
    value = loss(leaf)
    value.backward(retain_graph=True)
    assert leaf.grad is not None
    first = leaf.grad.clone()
    value.backward()
    assert torch.equal(leaf.grad, 2 * first)
    with pytest.raises(RuntimeError, match="second time"):
        value.backward()


def test_a_parameter_changed_before_the_backward_pass_is_noticed(picture, colour):
    leaf = colour.clone().requires_grad_()
    value = picture(leaf).mean()
    with torch.no_grad():
        leaf.mul_(0.5)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        value.backward()


@pytest.mark.parametrize("reentrant", [False, True])
def test_checkpointing(loss, colour, reentrant):
    found = gradient(lambda c: checkpoint(loss, c, use_reentrant=reentrant), colour)  # pyright: ignore
    assert torch.equal(found, gradient(loss, colour))


def test_layers_under_func_grad(scene):
    def depth(pose: Tensor) -> Tensor:
        wish = {**WISHES, "film": {**ROOM["film"], "aovs": ["depth"]}}
        return torchpt.render(scene, params={"camera.to_world": pose}, full=True, **wish)["depth"].mean()

    pose = scene.params["camera.to_world"]
    leaf = pose.clone().requires_grad_()
    depth(leaf).backward()
    assert torch.equal(torch.func.grad(depth)(pose), leaf.grad) and float(leaf.grad[2, 3]) == pytest.approx(1, rel=0.1)


LAYERED = {**WISHES, "film": {**ROOM["film"], "aovs": ["depth", "object_id", "albedo"]}, "full": True}


def layered(scene: torchpt.Scene, colour: Tensor) -> Any:
    return torchpt.render(scene, params={WALL: colour}, **LAYERED)


@own
@pytest.mark.parametrize("way", [*ONCE, *TWICE])
def test_layers_that_no_loss_reads_have_no_say(scene, colour, way):
    def of_picture(colour: Tensor) -> Tensor:
        rendering = layered(scene, colour)
        assert list(rendering.layers) == ["depth", "object_id", "albedo"] and len(rendering.layers["object_id"])
        return rendering.image.square().mean()

    def alone(colour: Tensor) -> Tensor:
        return torchpt.render(scene, params={WALL: colour}, **WISHES, film=ROOM["film"]).square().mean()

    u = torch.tensor([1.0, -0.5, 0.3])
    ways = {**ONCE, **TWICE}
    assert torch.equal(ways[way](of_picture, colour, u), ways[way](alone, colour.clone(), u))


READ: dict[str, Callable[[Any], Tensor]] = {
    "item": lambda layers: layers["albedo"],
    "get": lambda layers: layers.get("albedo"),
    "values": lambda layers: list(layers.values())[2],
    "items": lambda layers: dict(layers.items())["albedo"],
    "copy": lambda layers: layers.copy()["albedo"],
    "dict": lambda layers: {**layers}["albedo"],
    "or": lambda layers: (layers | {})["albedo"],
}


@own
@pytest.mark.parametrize("way", ["jvp", "hessian", "dual"])
@pytest.mark.parametrize("read", READ)
def test_a_layer_that_is_read_in_forward_mode_is_named(scene, colour, read, way):
    """Its tangent was 0 without a word."""

    def mean(colour: Tensor) -> Tensor:
        return READ[read](layered(scene, colour).layers).mean()

    forward_ad, u = torch.autograd.forward_ad, torch.ones(3)
    named = r"^layers.(albedo|depth): this layer has no forward-mode derivatives"
    with pytest.raises(TorchptError, match=named):
        if way == "dual":
            with forward_ad.dual_level():
                mean(forward_ad.make_dual(colour, u))
        else:
            ({**ONCE, **TWICE}[way])(mean, colour, u)
    if way == "jvp":
        leaf = colour.clone().requires_grad_()
        mean(leaf).backward()
        assert leaf.grad is not None and torch.equal(torch.func.grad(mean)(colour), leaf.grad)


@own
def test_layers_of_a_batch_in_forward_mode(scene, colour):
    def pictures(colour: Tensor) -> Any:
        return torchpt.render_batch(scene, params=[{WALL: colour}], **LAYERED)

    u = torch.ones(3)
    assert float(torch.func.jvp(lambda c: pictures(c).image.mean(), (colour,), (u,))[1]) > 0.0
    with pytest.raises(TorchptError, match=r"layers.albedo: "):
        torch.func.jvp(lambda c: pictures(c).layers["albedo"].mean(), (colour,), (u,))


def test_denoising_under_a_transform_is_refused(scene, colour):
    film = {**ROOM["film"], "denoise": True}
    with pytest.raises(SceneError, match="film.denoise: expected false under transforms of torch.func"):
        torch.func.grad(lambda c: torchpt.render(scene, params={WALL: c}, full=True, film=film).image.mean())(colour)


# -- modes


@pytest.mark.parametrize("mode", ["off", "auto"])
def test_autocast_changes_no_bit(scene, colour, mode):
    wishes = {**WISHES, "compile": mode}

    def loss(colour: Tensor) -> Tensor:
        return torchpt.render(scene, params={WALL: colour, "camera.to_world": pose}, **wishes).square().mean()

    pose = scene.params["camera.to_world"].clone().requires_grad_()
    plain, expected = torchpt.render(scene, **wishes), gradient(loss, colour)
    of_pose, pose.grad = pose.grad, None
    fresh = copy.deepcopy(scene)  # what is kept of a scene is made in the mode too
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(torchpt.render(fresh, **wishes), plain)
        assert torch.equal(gradient(loss, colour), expected)
    assert pose.grad is not None and of_pose is not None and torch.equal(pose.grad, of_pose)


def test_a_half_precision_parameter_gets_a_half_precision_gradient(loss, colour):
    half = colour.bfloat16()
    found = gradient(loss, half)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.float(), gradient(loss, half.float()), rtol=0.01, atol=0)


@pytest.mark.parametrize(
    "change", [lambda s: s.params[WALL].mul_(0.5), lambda s: s.params.update({WALL: s.params[WALL] * 0.5})]
)
@pytest.mark.parametrize("adjoint", ["replay", "autograd"])
def test_a_scene_that_changed_before_its_gradient(change, adjoint, scene):
    fresh = copy.deepcopy(scene)
    pose = fresh.params["camera.to_world"].clone().requires_grad_()
    picture = torchpt.render(fresh, params={"camera.to_world": pose}, adjoint=adjoint, **WISHES)
    change(fresh)
    with pytest.raises(RenderError, match=r"scene.params\[.*\] was changed after the picture"):
        picture.mean().backward()


def test_no_grad(loss, colour):
    leaf = colour.clone().requires_grad_()
    with torch.no_grad():
        assert not loss(leaf).requires_grad
    assert loss(leaf).requires_grad


def test_a_scene_is_the_same_outside_of_inference_mode(picture, loss, colour, scene):
    fresh = copy.deepcopy(scene)
    expected, plain = gradient(loss, colour), torchpt.render(scene, **WISHES)
    with torch.inference_mode():
        assert torch.equal(torchpt.render(fresh, **WISHES), plain)
        assert torch.equal(torchpt.render(fresh, params={WALL: colour * 1.0}, **WISHES), plain)
        fresh.params[WALL].mul_(0.5)
        darker = torchpt.render(fresh, **WISHES)
        assert not torch.equal(darker, plain)
        fresh.params[WALL].mul_(2.0)
        loaded = torchpt.load(ROOM, "cpu")
    for found in (fresh, loaded):
        assert torch.equal(torchpt.render(found, **WISHES), plain)
        leaf = colour.clone().requires_grad_()
        (torchpt.render(found, params={WALL: leaf}, **WISHES) ** 2).mean().backward()
        assert leaf.grad is not None and torch.equal(leaf.grad, expected)


def test_a_view_made_in_inference_mode_serves_outside_of_it(scene, loss, colour):
    camera = {"origin": [0.2, 1, 3], "target": [0, 1, 0]}
    with torch.inference_mode():
        view = scene.seen_by(camera)
    assert not any(value.is_inference() for value in view.params.values())
    pose = view.params["camera.to_world"].clone().requires_grad_()
    torchpt.render(view, params={"camera.to_world": pose}, **WISHES).mean().backward()
    assert pose.grad is not None and bool(pose.grad.any())


def test_batches_do_not_heed_autocast(scene):
    views = [{"origin": [x, 1, 3], "target": [0, 1, 0]} for x in (0.0, 0.2)]
    plain = torchpt.render_batch([scene, scene], views, **WISHES)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(torchpt.render_batch([scene, scene], views, **WISHES), plain)


def test_tensors_of_inference_mode_may_stand_in_a_scene(colour, loss):
    with torch.inference_mode():
        found = copy.deepcopy(torchpt.load(ROOM, "cpu"))  # its parameters are copied in that mode
        bright = colour * 1.5
    assert all(value.is_inference() for value in found.params.values())
    leaf = colour.clone().requires_grad_()
    (torchpt.render(found, params={WALL: leaf}, **WISHES) ** 2).mean().backward()
    assert leaf.grad is not None and torch.equal(leaf.grad, gradient(loss, colour))
    with torch.inference_mode():
        before = torchpt.render(found, **WISHES)
        found.params[WALL].copy_(bright)  # counts no version
        torch.testing.assert_close(torchpt.render(found, **WISHES), 1.5 * before)


def test_texels_in_a_colours_place_under_transforms() -> None:
    """The scene with a texture in that place is made outside of any transform, and serves afterwards."""
    described = {
        "camera": {"origin": [0, 1, 4], "target": [0, 0, 0]},
        "film": {"width": 6, "height": 6},
        "materials": {"paint": {"type": "diffuse"}},
        "shapes": {"wall": {"type": "rectangle", "material": "paint"}},
        "lights": {"sky": {"type": "constant"}},
    }
    scene = torchpt.load(described, "cpu")

    def picture(texels: torch.Tensor) -> torch.Tensor:
        return torchpt.render(scene, params={"materials.paint.reflectance": texels}, spp=4)

    texels = torch.rand(2, 4, 4, 3, generator=torch.Generator().manual_seed(1))
    found = torch.func.grad(lambda x: picture(x).sum())(texels[0])
    leaf = texels[0].clone().requires_grad_()
    picture(leaf).sum().backward()
    assert leaf.grad is not None and torch.equal(found, leaf.grad) and float(found.norm()) > 0
    both = torch.func.vmap(picture)(texels)
    assert torch.equal(both, torch.stack([picture(one) for one in texels]))
