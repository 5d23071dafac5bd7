"""How gradients are taken: an argument of ``render``, not another integrator; and what of a render they go through.

==================  =============================================================================
``replay.py``       ``replay``, the default: paths traced again, and gone back along vertex by vertex; start here
``tape.py``         ``autograd``: chunks rendered again under a plain tape
``parameters.py``   from parameters to what waves read, differentiated once a backward pass
``camera.py``       what the camera's gradient is where no surface moves: what it sees is held in place
``edges/``          what silhouettes and shadow edges that move add
==================  =============================================================================

May import: ``scene`` and what lies below.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchpt.core.errors import NotBuiltError
from torchpt.core.memory import check_memory
from torchpt.core.threads import limited_threads
from torchpt.gradients.camera import film_space_applies, film_space_backward, needs_direction_gradients
from torchpt.gradients.parameters import SceneTape, attached
from torchpt.gradients.replay import replay_paths
from torchpt.gradients.tape import tape
from torchpt.paths.integrators.path import PathIntegrator
from torchpt.ranks import Group
from torchpt.scene import Scene
from torchpt.scene.memory_estimate import mark_loaded, memory_estimate
from torchpt.scene.settings import Settings

__all__ = ["attached", "film_space_applies", "gradients"]


def gradients(
    scene: Scene,
    settings: Settings,
    params: Mapping[str, Tensor],
    wanted: tuple[str, ...],
    dtype: torch.dtype,
    attached: bool,
    kind: str,
    cotangent: Tensor,
    film_space: bool = False,
    ranks: Group | None = None,
    rays: tuple[Tensor, Tensor] | None = None,
    by_rays: bool = False,
) -> list[Tensor]:
    """Derivatives by the parameters ``wanted``, by rays, and by the weights of the caller's own models.

    Args:
        scene: what is rendered.
        settings: of the backward pass: its seed, its samples.
        params: tensors in place of the scene's.
        wanted: names of those that are differentiated.
        dtype: of the lanes.
        attached: whether geometry is differentiated.
        kind: ``replay`` or ``autograd``.
        cotangent: derivatives of a loss by the pixels ``(3, H W)``.
        film_space: whether what the camera sees is held in place (:func:`film_space_applies`), and the picture moves over it.
        ranks: those that share the pixels, which are the same on each.
        rays: in place of the camera's, see :func:`torchpt.scene.prepare.make_wave`.
        by_rays: whether they are differentiated: their origins and directions follow the parameters.

    Raises:
        SceneError: ``render.max_memory`` is too small for it.
        RenderError: not even a single lane fits in memory.
    """
    integrator = settings.integrator
    if attached and integrator.own_transmit:
        expected = "one whose rays are held up by surfaces alone, where geometry is differentiated"
        raise NotBuiltError("integrator.type", integrator.name, expected)
    if (attached or film_space) and integrator.splats:
        expected = "one whose samples light their own pixels alone, where geometry or the camera is differentiated"
        raise NotBuiltError("integrator.type", integrator.name, expected)
    with limited_threads(settings.render.threads):
        attached = needs_direction_gradients(scene, wanted) if film_space else attached
        scene_tape = SceneTape(scene, settings, params, wanted, scene.weights(), dtype, attached, ranks, rays, by_rays)
        if settings.render.max_memory is not None:
            need = memory_estimate(settings, scene.device, "tape", len(scene_tape.wave.context.world.materials.models))
            check_memory(settings.render.max_memory, scene.device, need.backward_bytes, 0)
        carried = any(not own.whole for own in integrator.fields)
        if kind == "replay" and integrator.own_transmit and (carried or scene_tape.differentiates_opacity):
            what = "its fields" if carried else "opacity"
            raise NotBuiltError(
                "adjoint", "replay", f"autograd, as {integrator.name} holds rays up and {what} is differentiated"
            )
        sums = scene_tape.sums()
        # Integrators that end at the first surface have but one vertex to keep.
        if film_space:
            film_space_backward(scene_tape, settings, cotangent, sums)
        elif kind == "replay" and isinstance(scene_tape.wave.integrator, PathIntegrator):
            replay_paths(scene, scene_tape, settings, cotangent, sums)
        else:
            tape(scene_tape, settings, cotangent, sums)
        if ranks is not None:
            sums.join_ranks(ranks)
        mark_loaded("tape")
        return scene_tape.gradients(sums)
