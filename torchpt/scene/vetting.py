"""Parameters of a scene that were replaced, or changed in place: checked once for each change."""

from __future__ import annotations

from typing import TYPE_CHECKING
from weakref import ref

from torch import Tensor

from torchpt.errors import SceneError

if TYPE_CHECKING:
    from torchpt.scene.scene import Scene

__all__ = ["Vetted", "vet"]

#: By name the tensor that was checked, and its version then.
Vetted = dict[str, tuple[ref[Tensor], int]]


def vet(scene: Scene, vetted: Vetted) -> None:
    """Check what was not yet; ``vetted`` is brought up to date.

    Raises:
        SceneError: see :meth:`Scene.check_own`.
    """
    own = scene.built.parameters
    for name in own.keys() ^ scene.params.keys():
        raise SceneError(
            f"params.{name}", "nothing" if name in own else name, "the names that the scene was loaded with"
        )
    for name, value in scene.params.items():
        # Tensors of torch.inference_mode count no versions, and are checked each time.
        version = -1 if isinstance(value, Tensor) and value.is_inference() else getattr(value, "_version", -1)
        seen = vetted.get(name)
        if seen is not None and seen[0]() is value and seen[1] == version >= 0:
            continue
        shape = own[name].shape
        if not isinstance(value, Tensor) or not value.is_floating_point() or value.shape != shape:
            found = (tuple(value.shape), value.dtype) if isinstance(value, Tensor) else value
            raise SceneError(f"params.{name}", found, f"a floating tensor of shape {tuple(shape)}")
        scene.check_number(name, value.detach())
        vetted[name] = ref(value), version
