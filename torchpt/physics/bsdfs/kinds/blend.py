"""The mixture of two BSDFs: ``f = (1 - weight) a + weight b``, either of any type, blends included.

Parameters nest: those of a blend have, beside ``weight``, one mapping ``a`` and one ``b`` with those of the inner models.
"""

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

    Where one transmits light and the other is opaque, both sides of the opaque one reflect alike.

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
    lobed = True  # `sample` reads a number `lobe`, which chooses between the models

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :meth:`Bsdf.of`."""
        # `values` has the models of both inner materials in place of the materials.
        return cls(a=values["a"], b=values["b"]), cls.given(values)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """Return blends of two opaque models, of an opaque and a transmitting one, and of a blend with another model."""
        from torchpt.physics.bsdfs import KINDS

        kinds: dict[str, Any] = {name: KINDS[name] for name in KINDS}  # Any: the models' constructors differ
        matt, rough, glass = kinds["diffuse"](), kinds["roughconductor"](), kinds["dielectric"]()
        inner = cls(a=matt, b=kinds["conductor"](schlick=True))
        return cls(a=matt, b=rough), cls(a=glass, b=matt), cls(a=inner, b=kinds["roughdielectric"]())

    def __post_init__(self) -> None:
        a, b = self.a, self.b
        self.has(  # sets these attributes
            factors=(*a.factors, *b.factors),  # names of the parameters that scale a lobe
            delta=a.delta or b.delta,  # some lobe is a delta
            smooth=a.smooth and b.smooth,  # all lobes are deltas
            transmits=a.transmits or b.transmits,
            refracts=a.refracts or b.refracts,
            anisotropic=a.anisotropic or b.anisotropic,
            conserves=a.conserves and b.conserves,
            reciprocal=a.reciprocal and b.reciprocal,
        )

    def tabulate(self, values: Parameters) -> Parameters:
        """Return the tables of both models."""
        return {"a": self.a.tabulate(values["a"]), "b": self.b.tabulate(values["b"])}

    def prepare(self, values: Parameters) -> Parameters:
        """Return the weight and the parameters of both models."""
        return {"weight": values["weight"], "a": self.a.prepare(values["a"]), "b": self.b.prepare(values["b"])}

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Bsdf.eval_pdf`."""
        weight = parameters["weight"].clamp(0.0, 1.0)
        value_a, pdf_a = self._facing(self.a).eval_pdf(parameters["a"], wo, wi)
        value_b, pdf_b = self._facing(self.b).eval_pdf(parameters["b"], wo, wi)
        return value_a + weight * (value_b - value_a), pdf_a + weight * (pdf_b - pdf_a)

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Choose a model by the weight; unless it draws a delta, both models evaluate the weight of the sample."""
        assert lobe is not None
        weight = parameters["weight"].clamp(0.0, 1.0)
        second_probability = weight.detach()
        second = lobe < second_probability
        # `lobe` was drawn from [0, 1). Given the choice it lies in an interval from `low`, `width` long; rescaled to [0, 1) it
        # is uniform again, for the choice of a lobe within the model.
        low, width = (
            torch.where(second, 0.0, second_probability),
            torch.where(second, second_probability, 1.0 - second_probability),  # also the probability of the choice
        )
        lobe = ((lobe - low) / width).clamp(0.0, 1.0 - 2.0**-24)  # below 1, which division may round to
        a = self._facing(self.a).sample(parameters["a"], wo, lobe if self.a.lobed else None, u)
        b = self._facing(self.b).sample(parameters["b"], wo, lobe if self.b.lobed else None, u)
        wi, pdf = torch.where(second, b.wi, a.wi), torch.where(second, b.pdf, a.pdf).detach()
        drawn = mixture_sample(self, parameters, wo, wi, valid=(pdf > 0).to(pdf.dtype))
        if self.delta:
            # The value is 1, as weight and probability cancel; the derivative is that of the weight.
            amount = torch.where(second, weight, 1.0 - weight) / width
            drawn = with_delta(drawn, torch.isinf(pdf), wi, torch.where(second, b.weight, a.weight) * amount)
        eta = None
        if self.refracts:
            unrefracted = torch.ones_like(lobe)
            eta_a, eta_b = (unrefracted if inner.eta is None else inner.eta for inner in (a, b))
            eta = torch.where(second, eta_b, eta_a)
        return replace(drawn, eta=eta)

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the blend of both albedos."""
        a, b = self.a.albedo(parameters["a"]), self.b.albedo(parameters["b"])
        return a + parameters["weight"].clamp(0.0, 1.0) * (b - a)

    def preview(self, parameters: Parameters, shade: Callable[[SplitSumMaterial], Tensor]) -> Tensor:
        """Return the blend of both previews."""
        a, b = self.a.preview(parameters["a"], shade), self.b.preview(parameters["b"], shade)
        return a + (b - a) * parameters["weight"].clamp(0.0, 1.0)

    def weights(self) -> Iterator[Tensor]:
        """Yield the trainable tensors of both models."""
        yield from self.a.weights()
        yield from self.b.weights()

    def __str__(self) -> str:
        return f"{self.name} ({self.a}, {self.b})"

    def _facing(self, inner: Bsdf) -> Bsdf:
        """Return the model; beside one that transmits, an opaque model made two-sided."""
        return _TwoSided(inner) if self.transmits and not inner.transmits else inner


@dataclass(frozen=True)
class _TwoSided(Bsdf):
    """An opaque model made two-sided: directions are flipped where ``wo`` is below the surface."""

    inner: Bsdf

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        side = torch.copysign(torch.ones_like(wo[2]), wo[2])
        return self.inner.eval_pdf(parameters, _flipped(wo, side), _flipped(wi, side))

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        side = torch.copysign(torch.ones_like(wo[2]), wo[2])
        drawn = self.inner.sample(parameters, _flipped(wo, side), lobe, u)
        return replace(drawn, wi=_flipped(drawn.wi, side))


def _flipped(w: Tensor, side: Tensor) -> Tensor:
    """Return local directions ``w (3, N)`` with z multiplied by ``side (N,)``, 1 or -1."""
    return torch.stack((w[0], w[1], w[2] * side))
