"""The base class of BSDFs, their conventions of frames and densities, and 1-D tables for them.

A model's values change form three times. A scene file gives ``Values``: numbers, colours, textures. Each material becomes one
row of ``Parameters``: tensors ``(3, 1)`` or ``(1,)``. The rows of all materials of a model are :func:`stacked`, and
:func:`gather` reads, for each of N lanes (paths that are traced together), the row of the material that it hit.

Directions are local: ``+z`` is the shading normal; ``wo`` points toward the previous vertex, ``wi`` is sampled. Both leave
the surface. ``eval`` includes ``|cos(theta_i)|``, ``pdf`` is in solid angle, ``weight = eval / pdf``, and ``pdf = 0`` means
that the sample failed. ``eval`` and ``pdf`` leave out delta lobes; ``sample`` returns ``pdf = inf`` for them.

Paths carry radiance, so refracted light scales by ``1 / eta^2`` (Veach, *Robust Monte Carlo Methods*, 1997, section 5.2).
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
from torchpt.spec import Color, Flag, Moves, Refused, Scalar, Spec, parameters_of

__all__ = ["Bsdf", "Parameters", "Table", "Values", "diffuse_split_sum", "gather", "model_and_values", "stacked"]

#: Values by parameter name: a tensor ``(3, N)`` or ``(N,)``, a :class:`Table`, a nested mapping, or None if absent.
Parameters = dict[str, Any]

#: Values by parameter name, as in a scene file: numbers, colours as three numbers, textures, words.
Values = Mapping[str, Any]


class Bsdf:
    """A BSDF model: pure tensor functions of texture-free parameters.

    An instance holds no numbers of a material, only which variant of the model it is: materials with equal instances share one
    call. A subclass defines :meth:`sample` and either :meth:`eval_pdf`, or
    :meth:`eval` and :meth:`pdf`. Its ``parameters`` are added to those of this class, which every material has.

    Attributes:
        name: the ``type`` in a scene file.
        parameters: parameters of this type: specs, or plain defaults (a number, or three for a colour).
        factors: parameters that scale a lobe. Where materials of one model are stacked, one without such a factor gets 1.
        tabulated: parameters that :meth:`tabulate` reads; they cannot be textures.
        sheer: whether the surface is invisible, as ``null`` is: rays pass it without counting a bounce.
        lobed: whether ``sample`` reads ``lobe``, the number that chooses a lobe; otherwise none is drawn.
        delta: whether ``sample`` may give ``pdf = inf``.
        smooth: whether all lobes are deltas: then no light is sampled.
        transmits: whether light passes through. Other models get ``wo.z >= 0`` only: callers flip the frame on the back, or
            make the back black (``two_sided``), and mirror a ``wo`` below the normal.
        refracts: whether ``sample`` returns ``eta``.
        anisotropic: whether the tangent matters.
        conserves: whether it reflects no more than it receives, for all parameters in their ranges. Tests read this attribute
            and the next.
        reciprocal: whether ``f(wo, wi) = f(wi, wo)`` (for refraction: divided by the squared indices).
    """

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec | float | tuple[float, float, float]]] = {
        "two_sided": Flag(
            True, doc="whether the back of an opaque material reflects as the front does; otherwise the back is black"
        ),
        "opacity": fraction(
            1.0, "fraction of the light that meets the surface; the rest passes as if it were not there"
        ),
        "alpha_cutoff": Scalar(None, high=1.0, doc="opacity below this value counts as 0, else as 1"),
        "emission": Color(None, texture=True, doc="radiance leaving the front side: an area light"),
        "emission_strength": Scalar(1.0, doc="factor of `emission`"),
        "normal_map": Normals(
            doc="shading normals in the surface's own frame, `2 c - 1` of the colours c", moves=Moves.RAYS
        ),
        "normal_strength": Scalar(1.0, doc="factor of the tilt of the map's normals", moves=Moves.RAYS),
        "bump_map": Heights(
            doc="heights along the normal, in the scene's units, whose slope tilts the shading normal", moves=Moves.RAYS
        ),
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
        """Check that the subclass can be evaluated; with ``part=True`` it is a mixin of models, which need not be."""
        super().__init_subclass__(**kwargs)
        if not part and cls.eval_pdf is Bsdf.eval_pdf and (cls.eval is Bsdf.eval or cls.pdf is Bsdf.pdf):
            raise TypeError(f"{cls.__name__} has to define eval_pdf, or eval and pdf")

    def has(self, **traits: Any) -> None:
        """Set attributes, such as ``delta``, that depend on fields of the variant. Called from ``__post_init__``."""
        for name, value in traits.items():
            object.__setattr__(self, name, value)  # variants are frozen dataclasses

    @classmethod
    def check(cls, values: Values, given: frozenset[str]) -> None:
        """Refuse values that contradict each other.

        Args:
            values: values of all parameters, defaults filled in.
            given: names of the parameters that the file sets.

        Raises:
            Refused: with the parameter and the accepted values.
        """
        if values["alpha_cutoff"] is not None and "opacity" not in given:
            raise Refused("an opacity beside alpha_cutoff", values["alpha_cutoff"], ("alpha_cutoff",))
        if values["normal_map"] is not None and values["bump_map"] is not None:
            raise Refused("either normal_map or bump_map, not both", "both", ("bump_map",))
        for key, scaled in (("normal_strength", "normal_map"), ("emission_strength", "emission")):
            if key in given and values[scaled] is None:
                raise Refused(f"{'an' if scaled[0] in 'aeiou' else 'a'} {scaled} beside {key}", values[key], (key,))

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """Return the model in the variant for a material, and its values as from :meth:`given`.

        Args:
            values: values of all parameters, None where absent; models in place of inner materials.
        """
        return cls(), cls.given(values)

    @classmethod
    def given(cls, values: Values) -> dict[str, Any]:
        """Return the values that the model itself reads: its own numbers, colours and textures, without None.

        Those that every material has, such as opacity, and those that choose a variant are left out.
        """
        specs = parameters_of(cls)
        return {
            key: value
            for key, value in values.items()
            if value is not None and key not in Bsdf.parameters and (key not in specs or specs[key].differentiable)
        }

    @classmethod
    def energy(cls, values: Values) -> str:
        """Return why the material may reflect more than it receives, or "". Values from textures are not checked."""
        return ""

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """Return the model in each variant that :meth:`of` can return, for tests."""
        return (cls(),)

    def tabulate(self, values: Parameters) -> Parameters:
        """Return tables that :meth:`prepare` reads as further values, computed once a material: integrals over directions."""
        return {}

    def prepare(self, values: Parameters) -> Parameters:
        """Return the parameters that :meth:`eval` and :meth:`sample` read, from those of a material. Differentiable.

        Called once a material (``(3, 1)`` or ``(1,)``), or for all lanes (``(3, N)``, ``(N,)``) where textures give some of
        the values; then ``values`` include the tables of :meth:`tabulate`.
        """
        return dict(values)

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Draw ``wi``.

        Args:
            parameters: values from :meth:`prepare`, per lane.
            wo: ``(3, N)`` local, unit.
            lobe: uniform number ``(N,)`` in [0, 1) that chooses a lobe; None unless ``lobed``.
            u: uniform numbers ``(2, N)`` in [0, 1) that choose the direction.
        """
        raise NotImplementedError

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``f |cos(theta_i)|`` ``(3, N)`` and the probability density ``(N,)`` of ``wi``."""
        return self.eval(parameters, wo, wi), self.pdf(parameters, wo, wi)

    def eval(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> Tensor:
        """Return ``f |cos(theta_i)|`` ``(3, N)``."""
        return self.eval_pdf(parameters, wo, wi)[0]

    def pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> Tensor:
        """Return the probability density ``(N,)`` of ``wi`` under :meth:`sample`, per steradian."""
        return self.eval_pdf(parameters, wo, wi)[1]

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the colour ``(3, N)`` for the albedo AOV."""
        raise NotImplementedError

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return the split-sum material for the integrator ``ibl``; by default diffuse, in the colour of :meth:`albedo`."""
        return diffuse_split_sum(self.albedo(parameters))

    def preview(self, parameters: Parameters, shade: Callable[[SplitSumMaterial], Tensor]) -> Tensor:
        """Return radiance ``(3, N)`` for the integrator ``ibl``; ``shade`` computes it for one split-sum material."""
        return shade(self.split_sum(parameters))

    def weights(self) -> Iterator[Tensor]:
        """Yield the trainable tensors of the ``torch.nn`` modules of the model, which receive gradients."""
        for module in self.held():
            yield from torch.nn.Module.parameters(module)

    def held(self) -> list[torch.nn.Module]:
        """Return the ``torch.nn`` modules of the model: itself if it is one, else those among its fields."""
        if isinstance(self, torch.nn.Module):
            return [self]
        return [value for value in vars(self).values() if isinstance(value, torch.nn.Module)]

    def __str__(self) -> str:
        variants = [key.replace("_", " ") for key, value in vars(self).items() if value is True]
        return f"{self.name} ({', '.join(variants)})" if variants else self.name


def model_and_values(kind: Any, values: Values) -> tuple[Bsdf, dict[str, Any]]:
    """Return model and values as from :meth:`Bsdf.of`; ``kind`` is a class, or an instance that the user passed."""
    return kind.of(values) if isinstance(kind, type) else (kind, kind.given(values))


def diffuse_split_sum(color: Tensor) -> SplitSumMaterial:
    """Return a split-sum material that is diffuse only, of colour ``(3, N)``."""
    zero = torch.zeros_like(color[0])
    return SplitSumMaterial(diffuse=color, f0=zero, f90=zero, roughness=torch.ones_like(zero), over=None)


@dataclass(frozen=True)
class Table:
    """Functions on [0, 1], one a material, tabulated at ``K`` equidistant points and interpolated linearly.

    Attributes:
        values: ``(M K,)``, one function after the other. Flat, so that the gradients of look-ups go to this tensor.
        count: K.
        row: ``(N,)`` the function that each lane reads; None before lanes are known.
    """

    values: Tensor
    count: int
    row: Tensor | None = None

    def at(self, x: Tensor) -> Tensor:
        """Return the values ``(N,)`` at ``x (N,)``, clamped to [0, 1]."""
        last = self.count - 1
        position = x.clamp(0.0, 1.0) * last  # in steps of the table
        below = position.detach().to(torch.int64).clamp_max(last - 1)
        start = below if self.row is None else self.row * self.count + below
        low = take(self.values, start)
        return low + (take(self.values, start + 1) - low) * (position - below)


def gather(rows: Parameters, row: Tensor) -> Parameters:
    """Return a model's parameters per lane: those of :func:`stacked` read at rows ``(N,)``."""

    def per_lane(value: Any) -> Any:
        if value is None:
            return None
        if isinstance(value, dict):
            return gather(value, row)
        if isinstance(value, Table):
            return replace(value, row=row)
        return take(value, row)

    return {name: per_lane(value) for name, value in rows.items()}


def stacked(prepared: Sequence[Parameters], factors: Sequence[str] = Bsdf.factors) -> Parameters:
    """Return the parameters of several materials of one model as rows. Absent values become 0, absent factors 1."""
    out: Parameters = {}
    for name in dict.fromkeys(name for values in prepared for name in values):
        column = [values.get(name) for values in prepared]
        like = next((value for value in column if value is not None), None)
        if like is None:
            out[name] = None
        elif isinstance(like, dict):  # parameters of an inner material of a blend
            out[name] = stacked([value or {} for value in column], factors)
        elif isinstance(like, Table):
            values = torch.cat([torch.zeros_like(like.values) if table is None else table.values for table in column])
            out[name] = Table(values, count=like.count)
        else:
            absent = torch.ones_like(like) if name in factors else torch.zeros_like(like)
            out[name] = torch.cat([absent if value is None else value for value in column], -1)
    return out
