"""One render with complete settings: what every way to a picture comes down to."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from torchpt.core.threads import limited_threads, undisturbed
from torchpt.forward.result import Progress, Rendering
from torchpt.forward.run import Run
from torchpt.forward.split import stamp
from torchpt.ranks import Group, together
from torchpt.scene import Scene
from torchpt.settings import Settings

__all__ = ["render_scene"]


def render_scene(
    scene: Scene,
    settings: Settings,
    on_progress: Callable[[Progress], bool | None] | None = None,
    params: Mapping[str, Tensor] | None = None,
    dtype: torch.dtype = torch.float32,
    ranks: Group | None = None,
    rays: tuple[Tensor, Tensor] | None = None,
) -> Rendering:
    """Render with complete settings.

    Args:
        scene: what.
        settings: how.
        on_progress: called after every chunk; returning True stops early with the picture so far.
        params: tensors in place of the scene's, without gradients.
        dtype: of the lanes.
        ranks: those that share the work; each gets all of the picture.
        rays: in place of the camera's, see :func:`torchpt.forward.wave.make_wave`; by one process.

    Raises:
        SceneError: settings that this scene cannot be rendered with.
        RenderError: with ``integrator.strict``, the first sample that is not finite.
        AssetError: a checkpoint that is damaged, or of another render.
        OutputError: a checkpoint that cannot be written, or that is there although nobody wishes to go on from it.
    """
    with undisturbed(scene.device), limited_threads(settings.render.threads):
        with together(ranks, "what is rendered", lambda: stamp(scene, settings, params, dtype)):
            return Run(scene, settings, params, dtype, group=ranks, rays=rays).go(on_progress)
