"""A material after its scene file was read: a BSDF model and the values of its parameters.

``torchpt.scene.materials`` makes one for each material; ``torchpt.scene.world`` turns them into tensors. A texture appears
here as a ``Node``: one use of a texture, with a name of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

from torchpt.physics.bsdfs.base import Bsdf
from torchpt.physics.textures import Node

__all__ = ["ResolvedMaterial", "Value"]

#: The value of one parameter: a number, a colour, or a texture.
Value = float | tuple[float, float, float] | Node


@dataclass(frozen=True)
class ResolvedMaterial:
    """One material: a BSDF model and one row of its parameters.

    Attributes:
        model: the BSDF, in the variant for this material.
        name: dotted prefix of the parameters, e.g. ``materials.red``.
        values: values of the model by parameter name: three floats for a colour, one for a number, or a texture.
        two_sided: whether the back of an opaque model reflects as the front does.
        opacity: fraction of the light that meets the surface, 0 to 1; the rest passes.
        alpha_cutoff: where set, opacity below it counts as 0, else as 1.
        emission: radiance that leaves the front side, or None if it does not emit.
        emission_strength: factor of ``emission``.
        normal_map: a texture of three channels, or None.
        normal_strength: factor of the tilt of its normals.
        bump_map: a texture of one channel, or None.
        inner: the two materials of a blend; then ``values`` hold the weight alone.
    """

    model: Bsdf
    name: str
    values: dict[str, Value]
    two_sided: bool = True
    opacity: float | Node = 1.0
    alpha_cutoff: float | None = None
    emission: tuple[float, float, float] | Node | None = None
    emission_strength: float = 1.0
    normal_map: Node | None = None
    normal_strength: float = 1.0
    bump_map: Node | None = None
    inner: tuple[ResolvedMaterial, ...] = ()

    def with_inner(self) -> list[ResolvedMaterial]:
        """Return this material and all materials that it blends."""
        return [self, *(material for inner in self.inner for material in inner.with_inner())]

    def own_values(self) -> dict[str, Value | None]:
        """Return the values by parameter name, without those of inner materials; None for numbers without effect.

        Only numbers that the file may set become parameters of the scene: an opacity of 1, for one, does not.
        """
        return {
            **self.values,
            "opacity": None if self.opacity == 1.0 else self.opacity,
            "emission": self.emission,
            "emission_strength": None if self.emission is None else self.emission_strength,
            "normal_map": self.normal_map,
            "normal_strength": None if self.normal_strength == 1.0 else self.normal_strength,
            "bump_map": self.bump_map,
        }

    def textures(self) -> list[Node]:
        """Return all textures, those of inner materials included."""
        own = [value for value in self.own_values().values() if isinstance(value, Node)]
        return [*own, *(node for inner in self.inner for node in inner.textures())]

    @property
    def refracts_as_delta(self) -> bool:
        """True if a delta lobe refracts: then the indices of refraction move rays, not only weights."""
        return self.model.refracts and self.model.delta
