"""Second derivatives and forward mode: chunks of lanes on an autograd tape that is differentiated twice.

With the picture p(x) of given samples, the VJP is ``g(x, c) = cᵀ J(x)``. The tape of a chunk is differentiated once, keeping
the graph, and then ``<g, u>`` is: with respect to c that is the JVP ``J u``, with respect to x the product of u with the
Hessian of ``<c, p>``. So forward mode needs no rules of its own.

Directions and their densities are held fixed, as for gradients (``docs/explanations/gradients.md``), so that colours, textures,
parameters of BSDFs and radiances have these derivatives. What moves points, directions or edges is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from torchpt.core.errors import NotBuiltError, RenderError
from torchpt.core.memory import Span
from torchpt.core.threads import limited_threads, one_thread
from torchpt.engines.engine import radiance as radiance_of
from torchpt.gradients.edges import concerns
from torchpt.gradients.parameters import SceneTape, attached
from torchpt.gradients.tape import LANES, TAPE_BYTES, budget_of_chunks, clamped_samples, tape_per_lane
from torchpt.scene import Scene
from torchpt.scene.prepare import is_small
from torchpt.scene.settings import Settings

__all__ = ["hessian_products", "jvp"]

#: Tapes that a chunk takes while it is differentiated twice: the first one, that of the gradient, and what they pass on.
_TAPES = 3


def jvp(
    scene: Scene, settings: Settings, params: Mapping[str, Tensor], tangents: Mapping[str, Tensor], dtype: torch.dtype
) -> Tensor:
    """Return the JVP of the pixels ``(3, H W)`` float64.

    Args:
        scene: the scene.
        settings: of the picture, with its samples a pixel.
        params: parameters in place of the scene's.
        tangents: of the differentiated parameters, by name.
        dtype: of the lanes.

    Raises:
        RenderError: a parameter moves points, directions or edges; models have weights of their own.
        NotBuiltError: samples of the integrator light other pixels than their own.
    """
    scene_tape = _tape_of(scene, settings, params, tuple(tangents), dtype)
    wave = scene_tape.wave
    _, _, width, height = wave.crop
    pixels = torch.zeros(3, width * height, dtype=torch.float64, device=wave.centre.device)
    leaf_tangents = scene_tape.leaf_tangents(list(tangents.values()))

    def add(first: int, values: Tensor) -> None:
        cotangent = torch.zeros_like(values, requires_grad=True)  # the VJP is linear in it
        grads = torch.autograd.grad(values, scene_tape.leaves, cotangent, create_graph=True, allow_unused=True)
        (change,) = torch.autograd.grad(_along(grads, leaf_tangents), cotangent)
        pixels[:, first : first + values.shape[1]] += change.double()

    _in_chunks(scene, scene_tape, settings, add)
    return pixels


def hessian_products(
    scene: Scene,
    settings: Settings,
    params: Mapping[str, Tensor],
    tangents: Mapping[str, Tensor],
    dtype: torch.dtype,
    cotangent: Tensor,
) -> dict[str, Tensor]:
    """Return products of tangents with the Hessian of the inner product of the pixels and ``cotangent (3, H W)``.

    Arguments and errors are those of :func:`jvp`, but ``settings`` are those of the backward pass.
    """
    scene_tape = _tape_of(scene, settings, params, tuple(tangents), dtype)
    leaves, given = scene_tape.leaves, list(tangents.values())
    leaf_tangents = scene_tape.leaf_tangents(given)
    sums = [torch.zeros_like(leaf) for leaf in leaves]  # of the gradient
    products = [torch.zeros_like(leaf) for leaf in leaves]

    def add(first: int, values: Tensor) -> None:
        mine = cotangent[:, first : first + values.shape[1]].to(values.dtype)
        grads = torch.autograd.grad(values, leaves, mine, create_graph=True, allow_unused=True)
        inner = _along(grads, leaf_tangents)
        twice = torch.autograd.grad(inner, leaves, allow_unused=True) if inner.requires_grad else [None] * len(leaves)
        for total, more in (*zip(sums, grads, strict=True), *zip(products, twice, strict=True)):
            if more is not None:
                total += more.detach()

    _in_chunks(scene, scene_tape, settings, add)
    return dict(zip(tangents, scene_tape.products(sums, products, given), strict=True))


def _tape_of(
    scene: Scene, settings: Settings, params: Mapping[str, Tensor], names: tuple[str, ...], dtype: torch.dtype
) -> SceneTape:
    """Return the tape of parameters by name, or raise as :func:`jvp` does."""
    for name in names:
        if attached(scene, (name,)) or concerns(scene, (name,)):
            raise RenderError(
                f"{name}: render has forward-mode and second derivatives of colours, textures, roughness and radiance alone;"
                " of what moves take the difference of two renders of one seed, or of two gradients of one seed_grad"
            )
    if scene.weights():
        raise RenderError("render has no forward-mode and no second derivatives of models with weights of their own")
    if settings.integrator.splats:
        expected = "one whose samples light their own pixels alone, for forward mode and second derivatives"
        raise NotBuiltError("integrator.type", settings.integrator.name, expected)
    return SceneTape(scene, settings, params, names, (), dtype, attached=False)


def _along(grads: Sequence[Tensor | None], tangents: Sequence[Tensor]) -> Tensor:
    """Return the inner product of gradients, None for 0, with tangents."""
    return torch.stack([(g * u).sum() for g, u in zip(grads, tangents, strict=True) if g is not None]).sum()


def _in_chunks(scene: Scene, scene_tape: SceneTape, settings: Settings, add: Callable[[int, Tensor], None]) -> None:
    """Call ``add`` with chunks of pixels: the first one, and on the tape what samples add to them ``(3, n)``."""
    if not scene_tape.leaves:  # all derivatives are 0
        return
    wave, spp, per_lane = scene_tape.taped, settings.render.spp, _TAPES * tape_per_lane(settings)
    _, _, width, height = wave.crop

    def work(span: Span) -> None:
        with torch.enable_grad():
            values = clamped_samples(settings, radiance_of(wave, *span)).sum(1) / spp
            if values.requires_grad:  # else nothing in these pixels depends on the parameters
                add(span[0], values)

    device = wave.centre.device
    lanes = max(min(LANES.get(device.type, LANES["cpu"]), TAPE_BYTES // per_lane), 1)
    what, limit = "the tape of a single lane, differentiated twice", settings.render.max_memory
    budget = budget_of_chunks(device, lanes, what=what, limit=limit, per_lane=per_lane)
    with limited_threads(settings.render.threads, is_small(scene, settings)), one_thread():
        scene_tape.run_in_chunks(budget, work, width * height, spp)
