"""What a BSDF is, stated once: the conventions, the base class, and tables that a model may look up.

Directions are local: ``+z`` is the shading normal; ``wo`` points toward the previous vertex, ``wi`` is sampled. Both leave
the surface. ``eval`` includes ``|cos(theta_i)|``, ``pdf`` is in solid angle, ``weight = eval / pdf``, and ``pdf = 0`` says
that the sample failed. A lobe that is a delta is not seen by ``eval`` and ``pdf``; ``sample`` gives it ``pdf = inf``.

Radiance is carried, so what is refracted scales by ``1 / eta^2`` (Veach, *Robust Monte Carlo Methods*, 1997, section 5.2).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import take
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.specs import Heights, Normals, fraction
from torchpt.spec import Color, Flag, Refused, Scalar, Spec, parameters_of

__all__ = ["Bsdf", "Parameters", "Table", "Values", "diffuse_split_sum", "gather", "made", "stacked"]

#: By name: a tensor, ``(3, N)`` or ``(N,)``; a :class:`Table`; such a mapping again; None where it asks for nothing.
Parameters = dict[str, Any]

#: By name, as a scene file has them: numbers, colours as three, textures, words.
Values = Mapping[str, Any]


class Bsdf:
    """A material model: pure tensor functions on plain values. One instance is one group of lanes.

    A subclass defines :meth:`sample` and either :meth:`eval_pdf`, or :meth:`eval` and :meth:`pdf`. Its ``parameters`` are
    added to those that every material has, which stand here.

    Attributes:
        name: its ``type`` in a scene file.
        parameters: what a material of this type takes: specs, or plain defaults (a number, or three for a colour).
        factors: those that scale a lobe: where a material lacks one that others of its model have, it counts as 1.
        tabulated: parameters that :meth:`tabulate` needs, so that no texture can give them.
        sheer: whether nothing is there: rays pass, which is no bounce.
        lobed: whether ``sample`` reads ``lobe``; the others are spared that number.
        delta: whether ``sample`` may give ``pdf = inf``.
        smooth: whether it gives nothing else: then no light is sampled for it.
        transmits: whether light passes through. Other models meet ``wo.z >= 0`` only: callers turn the frame around on the
            back, or see to it that the back is black (``two_sided``).
        refracts: whether ``sample`` returns ``eta``.
        anisotropic: whether the tangent matters.
        conserves: whether it reflects no more than it receives, for parameters in their ranges.
        reciprocal: whether ``f(wo, wi) = f(wi, wo)`` (for refraction: divided by the squared indices).
    """

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec | float | tuple[float, float, float]]] = {
        "two_sided": Flag(
            True, doc="whether the back of an opaque material reflects as the front does; else it is black"
        ),
        "opacity": fraction(
            1.0, "fraction of the light that meets the surface; the rest passes as if it were not there"
        ),
        "alpha_cutoff": Scalar(None, high=1.0, doc="an opacity below it counts as 0, else as 1"),
        "emission": Color(None, texture=True, doc="radiance leaving the front side: an area light"),
        "emission_strength": Scalar(1.0, doc="factor of `emission`"),
        "normal_map": Normals(doc="shading normals in the surface's own frame, `2 c - 1` of the colours c"),
        "normal_strength": Scalar(1.0, doc="factor of how far the map's normals lean"),
        "bump_map": Heights(doc="heights along the normal, in the scene's units, whose slope tilts the shading normal"),
    }
    factors: tuple[str, ...] = ("specular_reflectance", "specular_transmittance")
    tabulated: tuple[str, ...] = ()
    sheer: ClassVar[bool] = False
    lobed: ClassVar[bool] = False
    conserves: bool = True
    reciprocal: bool = True
    delta: bool = False
    smooth: bool = False
    transmits: bool = False
    refracts: bool = False
    anisotropic: bool = False

    def __init_subclass__(cls, part: bool = False, **kwargs: Any) -> None:
        """``part``: of models, and none by itself."""
        super().__init_subclass__(**kwargs)
        if not part and cls.eval_pdf is Bsdf.eval_pdf and (cls.eval is Bsdf.eval or cls.pdf is Bsdf.pdf):
            raise TypeError(f"{cls.__name__} has to define eval_pdf, or eval and pdf")

    def has(self, **traits: Any) -> None:
        """Traits above that depend on a variant's own fields; to be called from ``__post_init__``."""
        for name, value in traits.items():
            object.__setattr__(self, name, value)

    @classmethod
    def check(cls, values: Values, given: frozenset[str]) -> None:
        """Refuse values that do not go together.

        Args:
            values: of all parameters, defaults filled in.
            given: names of those that the file states.

        Raises:
            Refused: says which, and what is accepted.
        """
        if values["alpha_cutoff"] is not None and "opacity" not in given:
            raise Refused("an opacity beside alpha_cutoff", values["alpha_cutoff"], ("alpha_cutoff",))
        if values["normal_map"] is not None and values["bump_map"] is not None:
            raise Refused("either normal_map or bump_map, not both", values["bump_map"], ("bump_map",))
        for key, whole in (("normal_strength", "normal_map"), ("emission_strength", "emission")):
            if key in given and values[whole] is None:
                raise Refused(f"{'an' if whole[0] in 'aeiou' else 'a'} {whole} beside {key}", values[key], (key,))

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """The model in the variant that a material needs, and what it is given: see :meth:`given`.

        Args:
            values: of all parameters; in place of other materials their models.
        """
        return cls(), cls.given(values)

    @classmethod
    def given(cls, values: Values) -> dict[str, Any]:
        """What the model is given of a material's values: its own numbers, colours and textures, None excepted."""
        specs = parameters_of(cls)
        return {
            key: value
            for key, value in values.items()
            if value is not None and key not in Bsdf.parameters and (key not in specs or specs[key].differentiable)
        }

    @classmethod
    def energy(cls, values: Values) -> str:
        """Why a material reflects more than it receives, or ""; what textures give is not known yet."""
        return ""

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """The model in every variant that scenes can ask for: tests run over them."""
        return (cls(),)

    def tabulate(self, values: Parameters) -> Parameters:
        """What :meth:`prepare` needs beside ``values`` and can be had once a material: integrals over directions."""
        return {}

    def prepare(self, values: Parameters) -> Parameters:
        """Lane parameters from those a material was given, differentiable.

        Once a material (``(3, 1)`` or ``(1,)``); where textures give some of them at every lane (``(3, N)``, ``(N,)``),
        with what :meth:`tabulate` gave.
        """
        return dict(values)

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Draw ``wi``.

        Args:
            parameters: lane values.
            wo: ``(3, N)``.
            lobe: ``(N,)`` in [0, 1), given where ``lobed``.
            u: ``(2, N)`` in [0, 1).
        """
        raise NotImplementedError

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """``f |cos(theta_i)|`` ``(3, N)`` and the density ``(N,)`` with which :meth:`sample` draws ``wi``."""
        return self.eval(parameters, wo, wi), self.pdf(parameters, wo, wi)

    def eval(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> Tensor:
        """``f |cos(theta_i)|``: ``(3, N), (3, N) -> (3, N)``."""
        return self.eval_pdf(parameters, wo, wi)[0]

    def pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> Tensor:
        """Density of :meth:`sample` in solid angle ``(N,)``."""
        return self.eval_pdf(parameters, wo, wi)[1]

    def albedo(self, parameters: Parameters) -> Tensor:
        """Colour ``(3, N)`` for the albedo layer."""
        raise NotImplementedError

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """What split-sum shading, the preview, takes the material for; by default diffuse, of the colour :meth:`albedo`."""
        return diffuse_split_sum(self.albedo(parameters))

    def preview(self, parameters: Parameters, shade: Callable[[SplitSumMaterial], Tensor]) -> Tensor:
        """Radiance ``(3, N)`` in the preview, where ``shade`` gives that of one material."""
        return shade(self.split_sum(parameters))

    def weights(self) -> Iterator[Tensor]:
        """Trainable tensors of its own, those of modules it holds: gradients flow to them."""
        for module in self.held():
            yield from torch.nn.Module.parameters(module)

    def held(self) -> list[torch.nn.Module]:
        """The modules with such tensors: itself, where it is one."""
        if isinstance(self, torch.nn.Module):
            return [self]
        return [value for value in vars(self).values() if isinstance(value, torch.nn.Module)]

    def __str__(self) -> str:
        variants = [key.replace("_", " ") for key, value in vars(self).items() if value is True]
        return f"{self.name} ({', '.join(variants)})" if variants else self.name


def made(kind: Any, values: Values) -> tuple[Bsdf, dict[str, Any]]:
    """A kind's model and what it is given, see :meth:`Bsdf.of`; a caller's own kind is the one instance that they made."""
    return kind.of(values) if isinstance(kind, type) else (kind, kind.given(values))


def diffuse_split_sum(color: Tensor) -> SplitSumMaterial:
    """A diffuse surface ``(3, N)`` without a mirror."""
    none = torch.zeros_like(color[0])
    return SplitSumMaterial(color, none, none, torch.ones_like(none), None)


@dataclass(frozen=True)
class Table:
    """Functions on [0, 1], one a material, each by ``K`` values at equal distances; linear between them.

    Attributes:
        values: ``(M K,)``, one function after the other: flat as it is looked up in, so that its derivatives go to this tensor.
        count: K.
        row: ``(N,)`` which of them a lane reads; None before lanes are known.
    """

    values: Tensor
    count: int
    row: Tensor | None = None

    def at(self, x: Tensor) -> Tensor:
        """Values ``(N,)`` at ``x (N,)``, clamped to [0, 1]."""
        last = self.count - 1
        place = x.clamp(0.0, 1.0) * last
        below = place.detach().to(torch.int64).clamp_max(last - 1)
        start = below if self.row is None else self.row * self.count + below
        low = take(self.values, start)
        return low + (take(self.values, start + 1) - low) * (place - below)


def gather(rows: Parameters, row: Tensor) -> Parameters:
    """Lane values of a model's stacked parameters at rows ``(N,)``: the one place where parameters are resolved."""

    def at(value: Any) -> Any:
        if value is None:
            return None
        if isinstance(value, dict):
            return gather(value, row)
        if isinstance(value, Table):
            return replace(value, row=row)
        return take(value, row)

    return {name: at(value) for name, value in rows.items()}


def stacked(prepared: Sequence[Parameters], factors: Sequence[str] = Bsdf.factors) -> Parameters:
    """One mapping of rows from those of several materials of one model. Of what is None in some, they get 0, of a factor 1."""
    out: Parameters = {}
    for name in dict.fromkeys(name for values in prepared for name in values):
        column = [values.get(name) for values in prepared]
        like = next((value for value in column if value is not None), None)
        if like is None:
            out[name] = None
        elif isinstance(like, dict):
            out[name] = stacked([value or {} for value in column], factors)
        elif isinstance(like, Table):
            values = torch.cat([torch.zeros_like(like.values) if t is None else t.values for t in column])
            out[name] = Table(values, like.count)
        else:
            nothing = torch.ones_like(like) if name in factors else torch.zeros_like(like)
            out[name] = torch.cat([nothing if t is None else t for t in column], -1)
    return out
