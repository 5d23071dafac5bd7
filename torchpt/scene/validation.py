"""Read and check parameters of a scene: those of a call, and once for each change those replaced or changed in place.

A *version* (:class:`~torchpt.scene.versions.VersionCounter`) counts the changes of a parameter; a version that was checked once
is not checked again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.math.transforms import tensor_of
from torchpt.scene.sources import check_light_params
from torchpt.scene.versions import changed_versions
from torchpt.spec import Color, Index, Refused

if TYPE_CHECKING:
    from torchpt.scene.scene import Scene

__all__ = ["check_tensor", "inherited_checks", "params_as_tensors", "validate_changes"]


def check_tensor(name: str, value: object, shape: torch.Size | tuple[int, ...], *, texels: bool = False) -> None:
    """Check that a parameter's value is a dense floating tensor of a shape.

    Args:
        name: dotted name of the parameter.
        value: the value.
        shape: the shape that the parameter was loaded with.
        texels: True where errors mention that the parameter takes texels as well.

    Raises:
        SceneError: it is not, or it is on the device meta.
    """
    shown, dense, or_texels = value, True, ", or texels (H, W, C)" if texels else ""  # shown: the value in the error
    if isinstance(value, Tensor):
        dense, floats = value.layout is torch.strided, value.is_floating_point()
        if dense and floats and value.shape == shape and not value.is_meta:
            return
        shown = "a tensor on the device meta" if value.is_meta else (tuple(value.shape), value.dtype)
        shown = shown if dense else f"a {value.layout} tensor"
        # Texels for a parameter that takes them never come here: a scene with a texture was made for them before.
        or_texels = "" if floats and value.dim() == 3 else or_texels
    kind = "floating tensor" if dense else "dense floating tensor"  # says dense only where that is what is wrong
    raise SceneError(f"params.{name}", shown, f"a {kind} of shape {tuple(shape)}{or_texels}")


def params_as_tensors(scene: Scene, params: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters in the shapes that the scene has; numbers and lists become tensors as in a scene file.

    A number stands for three equal channels of a colour, a tensor of one number too, ``()`` or ``(1,)``: gradients flow to it.
    Values that are neither, and names that the scene has not, are returned unchanged: :meth:`Scene.check` refuses them.
    """
    return {
        name: _as_tensor(scene, name, value) if name in scene.raw_params else value for name, value in params.items()
    }


def _as_tensor(scene: Scene, name: str, value: Any) -> Any:
    own, spec, is_tensor = scene.raw_params[name], scene.spec(name), isinstance(value, Tensor)
    if not is_tensor:
        if isinstance(value, str) and isinstance(spec, Index):  # the name of a medium
            value = _number_of(spec, name, value)
        if not isinstance(value, int | float | list | tuple | np.ndarray | np.number) or isinstance(value, bool):
            return value
        try:
            value = tensor_of(value, own.device).to(own.dtype)
        except (TypeError, ValueError, RuntimeError, OverflowError):
            return value
    colour = isinstance(spec, Color) and own.dim() == 1
    if is_tensor and value.shape == (1,) and (colour or own.dim() == 0):
        value = value.reshape(())
    return value.expand(own.shape) if colour and value.dim() == 0 and value.is_floating_point() else value


def _number_of(spec: Index, name: str, medium: str) -> float:
    """Return the index of refraction of a medium.

    Raises:
        SceneError: an unknown medium.
    """
    try:
        return spec.read(medium)
    except Refused as error:
        raise SceneError(f"params.{name}", medium, error.expected) from None


def validate_changes(scene: Scene, validated_versions: dict[str, int]) -> None:
    """Check the parameters whose version differs from ``validated_versions``, and update that mapping.

    Raises:
        SceneError: see :meth:`Scene.check_own`.
    """
    loaded = scene.built.parameters
    for name in loaded.keys() ^ scene.raw_params.keys():  # names in one of the two: removed or added
        raise SceneError(
            f"params.{name}", "nothing" if name in loaded else name, "the names that the scene was loaded with"
        )
    changed = changed_versions(validated_versions, scene.versions())
    if not changed:
        return
    for name in changed:
        value = scene.raw_params[name]
        check_tensor(name, value, loaded[name].shape)
        scene.check_number(name, value.detach())
    merged = scene.merged(None)  # the scene's own parameters
    check_light_params(scene.built.sources, changed, merged)
    scene.check_sizes(changed, merged)
    validated_versions |= changed


def inherited_checks(made: Scene, scene: Scene, validated_versions: dict[str, int]) -> dict[str, int]:
    """Return the validated versions of a scene ``made`` from another, for the tensors that both share."""
    before, now = scene.versions(), made.versions()
    # Versions of 0 or less cannot be compared: torch counts no changes of such tensors.
    return {
        name: version
        for name, version in now.items()
        if 0 < before.get(name, 0) == validated_versions.get(name) and made.raw_params[name] is scene.raw_params[name]
    }
