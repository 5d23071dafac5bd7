"""What of a scene moves edges that no estimator knows, for the warning; what no scene tells beforehand stands in the docs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from torchpt.edges.sets import known
from torchpt.integrators.path import PathIntegrator
from torchpt.scene import Scene
from torchpt.settings import Settings

__all__ = ["left_out", "without_gradient"]

#: Of a spot: where its light ends, and where it begins to fade.
_RIM = ("cutoff_angle", "beam_width")


def left_out(scene: Scene, settings: Settings) -> list[str]:
    """Edges of the scene that are not differentiated where surfaces, lights or the camera move, each in a few words."""
    return list(_found(scene, settings))


def _found(scene: Scene, settings: Settings) -> Iterator[str]:
    built, camera = scene.built, scene.description.camera.kind
    if camera.lens:
        yield "those that a lens blurs"
    elif scene.camera(settings.film, scene.params, torch.float64).film_of(_point(scene.device)) is None:
        yield f"those that a camera of kind {camera.name} sees"
    materials = [owner.material for owner in (*built.parts, *built.copies)]
    if any(part.model.delta for material in materials for part in material.all()):
        yield "those seen in mirrors and clear glass, and of light that these send on"
    if any(material.opacity != 1.0 for material in materials):
        yield "those of surfaces that are not opaque"
    nodes = [node for material in materials for node in material.readings()]
    if any(getattr(node, "nearest", False) and not node.filtered for node in nodes):
        yield "those within textures that are not interpolated"
    if any(part.quadric is not None and not known(part.quadric.form) for part in built.parts):
        yield "outlines of quadrics of kinds of your own"
    if any(source.kind == "spot" and _sharp(scene, source.name) for source in built.sources):
        yield "the rims of spots that do not fade out"
    if not isinstance(settings.integrator, PathIntegrator):
        yield f"edges of shadows where the integrator is {settings.integrator.name}"


def _point(device: torch.device) -> Tensor:
    """Any point ``(3, 1)``: whether a camera has a film for points does not depend on it."""
    return torch.zeros(3, 1, dtype=torch.float64, device=device)


def without_gradient(scene: Scene, wanted: Iterable[str]) -> list[str]:
    """Those of the parameters of which pictures depend by jumps alone, so that their gradients are 0."""
    owners = [*scene.built.parts, *scene.built.copies]
    cut = {material.name for owner in owners for material in owner.material.all() if material.alpha_cutoff is not None}
    rims = {f"{source.name}.{key}" for source in scene.built.sources if source.kind == "spot" for key in _RIM}
    return [
        name
        for name in wanted
        if (name in rims and _sharp(scene, name.rpartition(".")[0]))
        or any(name.startswith(f"{own}.opacity") for own in cut)
    ]


def _sharp(scene: Scene, name: str) -> bool:
    cutoff, beam = (float(scene.params[f"{name}.{key}"].detach()) for key in _RIM)
    return beam > 0.999 * cutoff
