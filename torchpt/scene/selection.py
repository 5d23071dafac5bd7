"""Choose parameters of a scene by names and patterns such as ``materials.*.reflectance``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase

from torchpt.core.errors import SceneError, example_names
from torchpt.scene.scene import Scene
from torchpt.scene.sizes import is_size

__all__ = ["matching_names"]


def matching_names(scene: Scene, names: str | Sequence[str], key: str = "names") -> tuple[str, ...]:
    """Return the parameters that names and patterns match, in their order; those of a pattern in the scene's.

    Args:
        scene: the scene.
        names: a name or pattern, or several.
        key: of errors.

    Raises:
        SceneError: no text, or a name or pattern that matches nothing.
    """
    if isinstance(names, str):
        names = (names,)
    if not isinstance(names, Iterable) or isinstance(names, Mapping):
        raise SceneError(key, names, "a name of scene.params, or a sequence of names and patterns")
    matched: dict[str, None] = {}
    for name in names:
        if not isinstance(name, str):
            raise SceneError(key, name, "a name of scene.params or a pattern of some, as text")
        matches = [parameter for parameter in scene.raw_params if parameter == name or _matches(scene, parameter, name)]
        if not matches:
            examples = example_names(name, list(scene.raw_params))
            raise SceneError(key, name, f"a parameter of this scene or a pattern of some, such as {examples}")
        matched |= dict.fromkeys(matches)
    return tuple(matched)


def _matches(scene: Scene, parameter: str, pattern: str) -> bool:
    """Return True if a pattern matches a parameter. Sizes of shapes, which poses hold too, match by their own name alone."""
    own_name = pattern.rpartition(".")[2] == parameter.rpartition(".")[2]
    return fnmatchcase(parameter, pattern) and (own_name or not is_size(scene.spec(parameter)))
