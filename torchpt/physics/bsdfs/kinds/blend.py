"""A blend of two models: ``f = (1 - weight) a + weight b``, each of any kind, blends included."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.lobes import mixture_sample, with_delta
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.specs import Inner, fraction
from torchpt.spec import REQUIRED

__all__ = ["Blend"]


@dataclass(frozen=True)
class Blend(Bsdf):
    """A mixture: `1 - weight` of `a` and `weight` of `b`.

    Where one lets light through and the other does not, the opaque one meets both sides alike.

    Attributes:
        a: the model at weight 0.
        b: the model at weight 1.
    """

    a: Bsdf
    b: Bsdf

    name = "blend"
    parameters: ClassVar = {
        "a": Inner(doc="the material at weight 0"),
        "b": Inner(doc="the material at weight 1"),
        "weight": fraction(REQUIRED, "share of `b`"),
    }
    lobed = True

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :class:`Bsdf`."""
        return cls(values["a"], values["b"]), cls.given(values)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """Of one kind and of two, of what light passes and what it does not, and of a blend."""
        from torchpt.physics.bsdfs import KINDS

        made: dict[str, Any] = {name: KINDS[name] for name in KINDS}
        matt, rough, glass = made["diffuse"](), made["roughconductor"](), made["dielectric"]()
        inner = cls(matt, made["conductor"](schlick=True))
        return cls(matt, rough), cls(glass, matt), cls(inner, made["roughdielectric"]())

    def __post_init__(self) -> None:
        a, b = self.a, self.b
        self.has(
            factors=(*a.factors, *b.factors),
            delta=a.delta or b.delta,
            smooth=a.smooth and b.smooth,
            transmits=a.transmits or b.transmits,
            refracts=a.refracts or b.refracts,
            anisotropic=a.anisotropic or b.anisotropic,
            conserves=a.conserves and b.conserves,
            reciprocal=a.reciprocal and b.reciprocal,
        )

    def tabulate(self, values: Parameters) -> Parameters:
        """Both, each by its own."""
        return {"a": self.a.tabulate(values["a"]), "b": self.b.tabulate(values["b"])}

    def prepare(self, values: Parameters) -> Parameters:
        """Both, each by its own."""
        return {"weight": values["weight"], "a": self.a.prepare(values["a"]), "b": self.b.prepare(values["b"])}

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`Bsdf`."""
        weight = parameters["weight"].clamp(0.0, 1.0)
        value_a, pdf_a = self._facing(self.a).eval_pdf(parameters["a"], wo, wi)
        value_b, pdf_b = self._facing(self.b).eval_pdf(parameters["b"], wo, wi)
        return value_a + weight * (value_b - value_a), pdf_a + weight * (pdf_b - pdf_a)

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """One of the two by the weight; the other counts too, but for deltas."""
        assert lobe is not None
        weight = parameters["weight"].clamp(0.0, 1.0)
        second_probability = weight.detach()
        second = lobe < second_probability
        # What is left of the number after the choice is uniform again.
        low, width = (
            torch.where(second, 0.0, second_probability),
            torch.where(second, second_probability, 1.0 - second_probability),
        )
        lobe = ((lobe - low) / width).clamp(0.0, 1.0 - 2.0**-24)
        a = self._facing(self.a).sample(parameters["a"], wo, lobe if self.a.lobed else None, u)
        b = self._facing(self.b).sample(parameters["b"], wo, lobe if self.b.lobed else None, u)
        wi, pdf = torch.where(second, b.wi, a.wi), torch.where(second, b.pdf, a.pdf).detach()
        drawn = mixture_sample(self, parameters, wo, wi, (pdf > 0).to(pdf.dtype))
        if self.delta:
            amount = torch.where(second, weight, 1.0 - weight) / width
            drawn = with_delta(drawn, torch.isinf(pdf), wi, torch.where(second, b.weight, a.weight) * amount)
        eta = None
        if self.refracts:
            one = torch.ones_like(lobe)
            eta = torch.where(second, one if b.eta is None else b.eta, one if a.eta is None else a.eta)
        return replace(drawn, eta=eta)

    def albedo(self, parameters: Parameters) -> Tensor:
        """Blended likewise."""
        a, b = self.a.albedo(parameters["a"]), self.b.albedo(parameters["b"])
        return a + parameters["weight"].clamp(0.0, 1.0) * (b - a)

    def preview(self, parameters: Parameters, shade: Callable[[SplitSumMaterial], Tensor]) -> Tensor:
        """Blended likewise."""
        a, b = self.a.preview(parameters["a"], shade), self.b.preview(parameters["b"], shade)
        return a + (b - a) * parameters["weight"].clamp(0.0, 1.0)

    def weights(self) -> Iterator[Tensor]:
        """Those of both."""
        yield from self.a.weights()
        yield from self.b.weights()

    def __str__(self) -> str:
        return f"{self.name} ({self.a}, {self.b})"

    def _facing(self, inner: Bsdf) -> Bsdf:
        return _Mirrored(inner) if self.transmits and not inner.transmits else inner


@dataclass(frozen=True)
class _Mirrored(Bsdf):
    """An opaque model that meets both sides: what is below is turned up."""

    inner: Bsdf

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        side = torch.copysign(torch.ones_like(wo[2]), wo[2])
        return self.inner.eval_pdf(parameters, _turned(wo, side), _turned(wi, side))

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        side = torch.copysign(torch.ones_like(wo[2]), wo[2])
        drawn = self.inner.sample(parameters, _turned(wo, side), lobe, u)
        return BsdfSample(_turned(drawn.wi, side), drawn.pdf, drawn.weight, drawn.eta)


def _turned(w: Tensor, side: Tensor) -> Tensor:
    return torch.stack((w[0], w[1], w[2] * side))
