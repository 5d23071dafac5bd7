"""A material as it is resolved: a model, and what it is given."""

from __future__ import annotations

from dataclasses import dataclass

from torchpt.physics.bsdfs.base import Bsdf
from torchpt.physics.textures import Node

__all__ = ["ResolvedMaterial", "Value"]

Value = float | tuple[float, float, float] | Node


@dataclass(frozen=True)
class ResolvedMaterial:
    """One material: one row of one BSDF model.

    Attributes:
        model: its model, in the variant that it needs.
        name: dotted prefix of its parameters, e.g. ``materials.red``.
        values: what the model is given, by parameter name: colours as three floats, numbers as one, textures.
        two_sided: whether the back of an opaque model reflects as the front does.
        opacity: fraction of the light that meets the surface at all.
        alpha_cutoff: where set, opacity below it counts as 0, else as 1.
        emission: radiance, or None where it does not emit.
        emission_strength: factor of it.
        normal_map: a colour texture, or None.
        normal_strength: factor of how far its normals lean.
        bump_map: a number texture, or None.
        inner: the two materials of a blend, whose own ``values`` hold but the weight.
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
        """Itself and the materials that it blends."""
        return [self, *(slot for inner in self.inner for slot in inner.all())]

    def own(self) -> dict[str, Value | None]:
        """What it has by parameter name, that of inner materials excepted: numbers that say nothing are None."""
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
        """Its textures, those of inner materials included."""
        own = [value for value in self.own().values() if isinstance(value, Node)]
        return [*own, *(reading for inner in self.inner for reading in inner.readings())]

    @property
    def bends(self) -> bool:
        """Whether its deltas send rays on in directions that follow its indices of refraction."""
        return self.model.refracts and self.model.delta
