"""Backward passes of a render: the argument ``adjoint`` of ``render`` chooses the method; integrators stay the same.

==================  ==========================================================================================
``replay.py``       ``replay``, the default: path replay, paths traced again and differentiated by vertex; start here
``tape.py``         ``autograd``: chunks rendered again on one autograd tape
``second.py``       second derivatives and forward mode
``parameters.py``   from parameters to the tensors of waves, differentiated once a backward pass
``camera.py``       gradients with respect to the camera in film space, where no surface moves
``edges/``          boundary terms of silhouettes and shadow edges that move
==================  ==========================================================================================

``rendering/derivatives.py`` calls :func:`gradients` when autograd goes back through a picture. A cotangent is the derivative of
the loss with respect to a value; gradient sums collect those of parameters, in the order of samples.

May import: ``scene`` and what lies below.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchpt.core.errors import NotBuiltError, SceneError
from torchpt.core.memory import check_memory
from torchpt.core.threads import limited_threads
from torchpt.gradients.camera import film_space_applies, film_space_backward, needs_direction_gradients
from torchpt.gradients.parameters import SceneTape, attached
from torchpt.gradients.replay import replay_paths
from torchpt.gradients.tape import tape
from torchpt.paths.integrators import KINDS as INTEGRATORS
from torchpt.paths.integrators.path import PathIntegrator
from torchpt.ranks import Group
from torchpt.scene import Scene
from torchpt.scene.memory_estimate import mark_loaded, memory_estimate
from torchpt.scene.prepare import is_small
from torchpt.scene.settings import Settings

__all__ = ["attached", "film_space_applies", "gradients", "integrators_with_gradients"]


def integrators_with_gradients() -> str:
    """Return a phrase of the integrators that have gradients: samples of these light their own pixel, without light paths."""
    kinds = {name: kind for name, kind in INTEGRATORS.items() if kind.light and not kind.splats}
    names = [name for name, kind in kinds.items() if kind().light_walk() is None]
    return f"one of {', '.join(names)} where gradients are wanted"


def gradients(
    scene: Scene,
    settings: Settings,
    params: Mapping[str, Tensor],
    wanted: tuple[str, ...],
    dtype: torch.dtype,
    *,
    attached: bool,
    method: str,
    cotangent: Tensor,
    film_space: bool = False,
    ranks: Group | None = None,
    rays: tuple[Tensor, Tensor] | None = None,
    differentiates_rays: bool = False,
) -> list[Tensor]:
    """Return gradients of parameters ``wanted``, of rays, and of the weights of the user's own models, in this order.

    Args:
        scene: the scene.
        settings: of the backward pass, with its own seed and samples a pixel.
        params: parameters in place of the scene's.
        wanted: names of the parameters to differentiate.
        dtype: of the lanes.
        attached: True: geometry is differentiated (a parameter moves points, so directions and distances have derivatives).
        method: ``replay`` or ``autograd``.
        cotangent: derivatives of the loss with respect to the pixels ``(3, H W)``.
        film_space: True: first hits stay in place while the camera moves, see :func:`film_space_applies`.
        ranks: processes that share the pixels; arguments are the same on all of them.
        rays: rays in place of camera rays, see :func:`torchpt.scene.prepare.make_wave`.
        differentiates_rays: True: gradients of their origins and directions are returned too.

    Raises:
        SceneError: ``render.max_memory`` is too small for it.
        RenderError: not even a single lane fits in memory.
    """
    integrator = settings.integrator
    if attached and integrator.has_own_transmit:
        expected = "one without a transmit of its own, where geometry is differentiated"
        raise NotBuiltError("integrator.type", integrator.name, expected)
    if integrator.light_walk() is not None:
        raise SceneError("integrator.type", integrator.name, integrators_with_gradients())
    if (attached or film_space) and integrator.splats:
        expected = "one whose samples light their own pixels alone, where geometry or the camera is differentiated"
        raise NotBuiltError("integrator.type", integrator.name, expected)
    with limited_threads(settings.render.threads, is_small(scene, settings)):
        attached = needs_direction_gradients(scene, wanted) if film_space else attached
        scene_tape = SceneTape(
            scene,
            settings,
            params,
            wanted,
            scene.weights(),
            dtype,
            attached=attached,
            ranks=ranks,
            rays=rays,
            differentiates_rays=differentiates_rays,
        )
        if settings.render.max_memory is not None:
            models = len(scene_tape.wave.context.world.materials.models)
            need = memory_estimate(settings, scene.device, "tape", models)
            check_memory(settings.render.max_memory, scene.device, need.backward_bytes, 0)
        # Fields are what an integrator carries along a path; those of whole numbers have no derivatives.
        differentiates_fields = any(not own.whole for own in integrator.fields)
        if (
            method == "replay"
            and integrator.has_own_transmit
            and (differentiates_fields or scene_tape.differentiates_opacity)
        ):
            what = "its fields" if differentiates_fields else "opacity"
            raise NotBuiltError(
                "adjoint",
                "replay",
                f"autograd, as {integrator.name} has a transmit of its own and {what} is differentiated",
            )
        sums = scene_tape.sums()
        # Integrators that end at the first surface have a single vertex: a tape is enough.
        if film_space:
            film_space_backward(scene_tape, settings, cotangent, sums)
        elif method == "replay" and isinstance(scene_tape.wave.integrator, PathIntegrator):
            replay_paths(scene, scene_tape, settings, cotangent, sums)
        else:
            tape(scene_tape, settings, cotangent, sums)
        if ranks is not None:
            sums.join_ranks(ranks)
        mark_loaded("tape")
        return scene_tape.gradients(sums)
