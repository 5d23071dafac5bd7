"""Parameters of a scene that were replaced, or changed in place: checked once for each change."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.scene.sources import check_light_params
from torchpt.scene.versions import changed_versions

if TYPE_CHECKING:
    from torchpt.scene.scene import Scene

__all__ = ["check_tensor", "inherited_checks", "validate_changes"]


def check_tensor(name: str, value: object, shape: torch.Size | tuple[int, ...], texels: bool = False) -> None:
    """Refuse what is no floating tensor of a shape, for a parameter; ``texels``: that might have its place.

    Raises:
        SceneError: it is not, or it holds no numbers.
    """
    found, dense, others = value, True, ", or texels (H, W, C)" if texels else ""
    if isinstance(value, Tensor):
        dense, floats = value.layout is torch.strided, value.is_floating_point()
        if dense and floats and value.shape == shape and not value.is_meta:
            return
        found = "a tensor on the device meta" if value.is_meta else (tuple(value.shape), value.dtype)
        found = found if dense else f"a {value.layout} tensor"
        others = "" if floats and value.dim() == 3 else others  # texels were looked at before
    kind = "floating tensor" if dense else "dense floating tensor"
    raise SceneError(f"params.{name}", found, f"a {kind} of shape {tuple(shape)}{others}")


def validate_changes(scene: Scene, validated_versions: dict[str, int]) -> None:
    """Check what was not yet; ``validated_versions`` is brought up to date: by name the edition that was checked.

    Raises:
        SceneError: see :meth:`Scene.check_own`.
    """
    own = scene.built.parameters
    for name in own.keys() ^ scene.params.keys():
        raise SceneError(
            f"params.{name}", "nothing" if name in own else name, "the names that the scene was loaded with"
        )
    changed = changed_versions(validated_versions, scene.versions())
    if not changed:
        return
    for name in changed:
        value = scene.params[name]
        check_tensor(name, value, own[name].shape)
        scene.check_number(name, value.detach())
    check_light_params(scene.built.sources, changed, scene.merged(None))
    validated_versions |= changed


def inherited_checks(made: Scene, scene: Scene, validated_versions: dict[str, int]) -> dict[str, int]:
    """Of what was checked of a scene, that which another one made of it has too: the same tensors, as they were checked."""
    before, now = scene.versions(), made.versions()
    return {
        name: version
        for name, version in now.items()
        if 0 < before.get(name, 0) == validated_versions.get(name) and made.params[name] is scene.params[name]
    }
