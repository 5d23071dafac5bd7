"""A material after its scene file was read: a BSDF model and the values of its parameters."""

from __future__ import annotations

from dataclasses import dataclass

from torchpt.physics.bsdfs.base import Bsdf
from torchpt.physics.textures import Node

__all__ = ["ResolvedMaterial", "Value"]

Value = float | tuple[float, float, float] | Node


@dataclass(frozen=True)
class ResolvedMaterial:
    """One material: a BSDF model and one row of its parameters.

    Attributes:
        model: the BSDF, in the variant for this material.
        name: dotted prefix of the parameters, e.g. ``materials.red``.
        values: values of the model by parameter name: three floats for a colour, one for a number, or a texture.
        two_sided: whether the back of an opaque model reflects as the front does.
        opacity: fraction of the light that meets the surface.
        alpha_cutoff: where set, opacity below it counts as 0, else as 1.
        emission: radiance, or None if it does not emit.
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

    def all(self) -> list[ResolvedMaterial]:
        """Return this material and all materials that it blends."""
        return [self, *(slot for inner in self.inner for slot in inner.all())]

    def own(self) -> dict[str, Value | None]:
        """Return the values by parameter name, without those of inner materials; None for numbers without effect."""
        return {
            **self.values,
            "opacity": None if self.opacity == 1.0 else self.opacity,
            "emission": self.emission,
            "emission_strength": None if self.emission is None else self.emission_strength,
            "normal_map": self.normal_map,
            "normal_strength": None if self.normal_strength == 1.0 else self.normal_strength,
            "bump_map": self.bump_map,
        }

    def readings(self) -> list[Node]:
        """Return all textures, those of inner materials included."""
        own = [value for value in self.own().values() if isinstance(value, Node)]
        return [*own, *(reading for inner in self.inner for reading in inner.readings())]

    @property
    def bends(self) -> bool:
        """True if directions of delta lobes depend on indices of refraction."""
        return self.model.refracts and self.model.delta
