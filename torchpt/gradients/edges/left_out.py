"""What of a scene moves edges that no estimator knows, for the warning; what no scene tells beforehand stands in the docs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import torch
from torch import Tensor

from torchpt.gradients.edges.curves import known
from torchpt.gradients.edges.seams import jumps_elsewhere, jumps_where_u_begins
from torchpt.gradients.parameters import is_mirror
from torchpt.paths.integrators.path import PathIntegrator
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.textures import Node
from torchpt.scene import Scene
from torchpt.scene.settings import Settings

__all__ = ["left_out", "without_gradient"]

#: Of a spot: where its light ends, and where it begins to fade.
_RIM = ("cutoff_angle", "beam_width")


def left_out(scene: Scene, settings: Settings, params: Mapping[str, Tensor] | None = None) -> list[str]:
    """Return in a few words each the edges that are not differentiated where surfaces, lights or the camera move.

    ``params``: those that replace the scene's.
    """
    return list(_found(scene, settings, scene.readable_params(params)))


def _found(scene: Scene, settings: Settings, params: Mapping[str, Tensor]) -> Iterator[str]:
    built, camera = scene.built, scene.description.camera.kind
    if scene.camera(settings.film, scene.raw_params, torch.float64).film_of(_point(scene.device)) is None:
        yield f"those that a camera of kind {camera.name} sees"
    materials = [owner.material for owner in (*built.parts, *built.copies)]
    if any(is_mirror(part, params) for material in materials for part in material.with_inner()):
        yield "those seen in mirrors and clear glass, and of light that these send on"
    if any(_has_opacity_texture(part) for material in materials for part in material.with_inner()):
        yield "those within textures of opacity that jump"
    if jumps_elsewhere(scene):
        yield "those within textures that are not interpolated, on round surfaces or of very many lines"
    if jumps_where_u_begins(scene):
        yield "those where texture coordinates of round surfaces begin anew"
    if any(part.quadric is not None and not known(part.quadric.form) for part in built.parts):
        yield "outlines of quadrics of kinds of your own"
    if settings.integrator.dark_rims and any(part.smooth and not part.material.model.transmits for part in built.parts):
        yield "inner borders of the dark rims of smooth shading (integrator.dark_rims=false has none)"
    if any(source.kind == "spot" and _sharp(params, source.name) for source in built.sources):
        yield "the rims of spots that do not fade out"
    if not isinstance(settings.integrator, PathIntegrator):
        yield f"edges of shadows where the integrator is {settings.integrator.name}"


def _has_opacity_texture(material: ResolvedMaterial) -> bool:
    """Return True if opacity jumps on a surface: a texture that is not interpolated, or one with a cutoff."""
    sheer = any(inner.model.sheer for inner in material.inner)  # its weight is an opacity
    maps = [material.opacity, *([material.values["weight"]] if sheer else [])]
    jumps = material.alpha_cutoff is not None
    return any(isinstance(node, Node) and (jumps or getattr(node, "nearest", False)) for node in maps)


def _point(device: torch.device) -> Tensor:
    """Return any point ``(3, 1)``: whether a camera has a film for points does not depend on it."""
    return torch.zeros(3, 1, dtype=torch.float64, device=device)


def without_gradient(scene: Scene, wanted: Iterable[str], params: Mapping[str, Tensor] | None = None) -> list[str]:
    """Return the parameters on which pictures depend by jumps alone, so that their gradients are 0.

    ``params``: those that replace the scene's.
    """
    values = scene.merged(params)
    owners = [*scene.built.parts, *scene.built.copies]
    cut = {
        material.name
        for owner in owners
        for material in owner.material.with_inner()
        if material.alpha_cutoff is not None
    }
    rims = {f"{source.name}.{key}" for source in scene.built.sources if source.kind == "spot" for key in _RIM}
    return [
        name
        for name in wanted
        if (name in rims and _sharp(values, name.rpartition(".")[0]))
        or any(name.startswith(f"{own}.opacity") for own in cut)
    ]


def _sharp(params: Mapping[str, Tensor], name: str) -> bool:
    cutoff, beam = (float(params[f"{name}.{key}"].detach()) for key in _RIM)
    return beam > 0.999 * cutoff
