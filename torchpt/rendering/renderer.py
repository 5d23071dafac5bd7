"""A renderer: a scene and the settings of its pictures, decided once, for many renders of other parameters."""

from __future__ import annotations

from typing import Any, Unpack

import torch

from torchpt.rendering.api import render
from torchpt.rendering.execution import execute_request
from torchpt.rendering.requests import template_of
from torchpt.scene import Scene
from torchpt.scene.entry import as_scene
from torchpt.scene.settings import CommonOptions, Params, RendererOptions, SeedOfCall, Settings
from torchpt.spec.arguments import SCENE_VALUE, check_names, expand_signature

__all__ = ["Renderer"]


class Renderer:
    """Renders a scene with settings that are read and checked once: ``renderer(params) -> picture``.

    A call returns what :func:`torchpt.render` returns for the same arguments, to the bit, with the same gradients. What depends
    on neither parameters nor seed is decided when it is made; the scene keeps the worlds, search structures and machine code of
    the latest renders. (:class:`torchpt.nn.Renderer` is a module, which has parameters of its own.)

    Attributes:
        scene: the scene; its parameters may change between calls, as for ``torchpt.render``.
        settings: the complete settings, with the seed of the scene file.
        seed: seed of calls that pass none.

    Args:
        scene: from :func:`torchpt.load`.
        full: True makes calls return a :class:`torchpt.Rendering`.
        seed: seed of calls that pass none, as for ``torchpt.render``; None: a new one for each call.
        options: further arguments of ``torchpt.render`` for all calls.

    Raises:
        SceneError: a setting is not accepted.
        RenderError: the denoiser is missing.
        TypeError: an unknown argument.
    """

    @expand_signature
    def __init__(
        self, scene: Scene, *, full: bool = False, seed: SeedOfCall = SCENE_VALUE, **options: Unpack[RendererOptions]
    ) -> None:
        check_names("Renderer", options, RendererOptions, own=("full", "seed"))
        self.scene, self.seed = as_scene(scene), seed
        self._options: CommonOptions = {**options}
        self._full = full
        self._template = template_of(self.scene, full, options)
        self.settings: Settings = self._template.settings
        if seed is not None:  # a wrong one is an error now
            self._template.request(self.scene, None, seed)

    def __call__(self, params: Params | None = None, *, seed: SeedOfCall = SCENE_VALUE) -> Any:
        """Render the scene.

        Args:
            params: tensors in place of the scene's, by dotted name; if one requires gradients, so does the picture.
            seed: seed in place of the renderer's; None: a new one.

        Returns:
            The picture ``(H, W, 3)``; with ``full=True`` a :class:`torchpt.Rendering`.

        Raises:
            SceneError: a parameter or seed is not accepted.
            RenderError: a device or compiler is missing; a rank is lost, or renders something else.
        """
        seed = self.seed if seed is SCENE_VALUE else seed
        if torch.compiler.is_compiling():  # the custom operator of `render` becomes part of the graph
            return render(self.scene, full=self._full, **{**self._options, "params": params, "seed": seed})
        rendering = execute_request(self._template.request(self.scene, params, seed))
        return rendering if self._full else rendering.image

    def __repr__(self) -> str:
        """Return the scene's name, the size of the picture and the samples."""
        film = self.settings.film
        return f"Renderer({self.scene.name or 'scene'}: {film.width} x {film.height}, {self.settings.render.spp} spp)"
