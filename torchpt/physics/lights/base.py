"""Base classes of lights: all emitters, lights without a surface, environments.

All lights of a scene lie in one table (:class:`Lights`), a row for each. Lights with a surface have a row for each primitive
that emits; :class:`Light`, here, is the base of the others (point, spot, ...). While a world is built, :meth:`Light.row`
makes the row from the parameters in the scene file; while paths are traced, :meth:`Light.sample` reads it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from torchpt.math.sampling import concentric_disk, uniform_sphere
from torchpt.math.vectors import Frame, luminance, safe_reciprocal, take
from torchpt.math.vectors import rows as rows_of
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.physics.lights.solid_angle import OTHER
from torchpt.spec import Kinds, Refused, Spec

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = [
    "COLUMNS",
    "KINDS",
    "BoundingSphere",
    "Cone",
    "EmittedRay",
    "Emitter",
    "Environment",
    "EnvironmentImage",
    "Light",
    "Row",
    "Setting",
    "bright",
    "lane_rows",
    "sort_key",
]  # fmt: skip

#: Columns of the table that every row has, fields of :class:`Lights` by name; ``flip`` is -1 where a sphere emits inward.
COLUMNS = ("p0", "e1", "e2", "normal", "flip", "area", "bound", "radiance")


def lane_rows(lights: Lights, row: Tensor | None) -> Lights:
    """Return the rows ``row (N,)`` of the table, one a lane; for None the table itself, whose single row broadcasts."""
    quadrics = lights.quadrics
    if quadrics is not None:
        assert lights.quadric is not None
        if row is not None:
            quadrics = rows_of(quadrics, take(lights.quadric, row))
        elif quadrics.e3.shape[1] > 1:  # a look-up of one column for all lanes has no derivative by kernels
            quadrics = rows_of(quadrics, lights.quadric)
    if row is None:
        return lights if quadrics is None else replace(lights, quadrics=quadrics)
    opacity = None if lights.opacity is None else take(lights.opacity, row)
    columns = {name: take(getattr(lights, name), row) for name in COLUMNS}
    return replace(lights, opacity=opacity, quadrics=quadrics, **columns)


@dataclass(frozen=True)
class Cone:
    """Cones that bound the emission of K lights, for the light tree; their axes are ``Lights.normal``."""

    cos_o: Tensor | float  # (K,) cosine of the half angle of the cone that holds all normals; -1: all directions
    cos_e: Tensor | float  # (K,) cosine of the largest angle between a normal and emitted light; 0: its hemisphere
    intensity: Tensor  # (K,) largest radiant intensity in any direction, up to a factor common to all lights


class Emitter:
    """Anything with rows in the table of lights.

    Attributes:
        name: name of the kind.
        distant: whether the light is infinitely far away.
        environment: whether the light is the environment. A scene has at most one.
        code: shape code of :mod:`torchpt.physics.lights.solid_angle` if points are sampled by solid angle; else ``OTHER``.
    """

    name: ClassVar[str] = ""
    distant: ClassVar[bool] = False
    environment: ClassVar[bool] = False
    code: ClassVar[int] = OTHER

    @classmethod
    def bounds(cls, at: Lights, intensity: Tensor) -> Cone:
        """Return cones that bound the emission of K rows of this kind. Not called for distant kinds.

        Args:
            at: K rows of the table, float64, detached.
            intensity: power over pi ``(K,)``: the intensity of a flat emitter along its normal.
        """
        # All directions; the mean projected area of a convex surface is a quarter of its area.
        return Cone(cos_o=-1.0, cos_e=0.0, intensity=intensity * 0.25)


@dataclass(frozen=True)
class Setting:
    """Parameters of a light and properties of its scene, from which :meth:`Light.row` makes a row.

    Attributes:
        given: function that returns a parameter of the light by its key, in the scene's coordinates.
        values: parameters as loaded, for those that are no tensors: flags, choices, integers.
        place: function that maps a point ``(3,)`` of the scene to world coordinates, float64.
        unit: length of the world unit in scene units.
        reach: ``()`` float64 radius of the scene in world units; the power of a distant light grows with its square.
        dtype: dtype of the world.
        alone: True where lights are sampled alone, not combined with BSDF sampling by MIS.
    """

    given: Callable[[str], Tensor]
    values: Mapping[str, Any]
    place: Callable[[Tensor], Tensor]
    unit: float
    reach: Tensor
    dtype: torch.dtype
    alone: bool

    def __getitem__(self, key: str) -> Tensor:
        """Return a parameter in float64."""
        return self.given(key).double()

    def point(self, key: str) -> Tensor:
        """Return a parameter that is a point, in world coordinates."""
        return self.place(self[key])

    def intensity(self, key: str) -> Tensor:
        """Return a parameter that is a radiant intensity, in world units: its irradiance at a distance is unchanged.

        Raises:
            Refused: the value is beyond float32.
        """
        scaled = self[key] / self.unit**2
        if not bool(torch.isfinite(scaled.float()).all()):
            largest = torch.finfo(torch.float32).max * self.unit**2
            expected = f"at most {largest:.3g} in a scene this small: what arrives is beyond float32"
            raise Refused(expected, self[key].tolist(), (key,))
        return scaled


@dataclass(frozen=True)
class Row:
    """The row of one light in the table, float64; None counts as zero.

    Attributes:
        radiance: ``(3,)`` radiance, or the quantity that :meth:`Light.sample` of the kind reads in this column.
        power: ``()`` emitted power as luminance, detached. Lights are chosen by it.
        p0: ``(3,)`` position, unless distant.
        e1: ``(3,)`` free for numbers of the kind.
        e2: ``(3,)`` free for numbers of the kind.
        normal: unit ``(3,)``, the axis of the cone of :meth:`Emitter.bounds`.
        environment: record of tensors, the first argument of the methods of :class:`Environment`.
    """

    radiance: Tensor
    power: Tensor
    p0: Tensor | None = None
    e1: Tensor | None = None
    e2: Tensor | None = None
    normal: Tensor | None = None
    environment: Any = None


@dataclass(frozen=True)
class BoundingSphere:
    """A ball around all surfaces of a scene, through which light of distant lights is sent.

    Attributes:
        centre: ``(3,)``.
        radius: ``()``.
    """

    centre: Tensor
    radius: Tensor

    def density(self) -> Tensor:
        """Return the density ``()`` of points on a disk as wide as the ball, across the light."""
        return safe_reciprocal(self.radius * self.radius * math.pi)

    def origins(self, d: Tensor, u: Tensor) -> Tensor:
        """Return origins ``(3, N)`` of rays along unit ``d (3, N)``: on disks that touch the ball; ``u (2, N)`` in [0, 1)."""
        frame, (x, y) = Frame.about(d), concentric_disk(u).to(d.dtype)
        return self.centre[:, None] + (frame.s * x + frame.t * y - d) * self.radius


@dataclass(frozen=True)
class EmittedRay:
    """Rays that leave lights of a kind without a surface, N lanes.

    Attributes:
        o: origins ``(3, N)``.
        d: unit directions ``(3, N)``.
        radiance: ``(3, N)`` along the ray; intensity or irradiance of a light without extent.
        density: ``(N,)`` of the ray, see :mod:`torchpt.physics.lights.emission`.
        pdf: ``(N,)`` density of the direction ``-d`` under :meth:`Light.sample`; 1 for lights without extent.
    """

    o: Tensor
    d: Tensor
    radiance: Tensor
    density: Tensor
    pdf: Tensor


class Light(Emitter):
    """A kind of light without a surface.

    Rays hit none of them but the :class:`Environment`. The others return an infinite density, so that MIS gives light
    sampling the whole weight.

    Attributes:
        name: the ``type`` in a scene file.
        parameters: specs of the parameters.
        places: names of parameters that are points; the world unit is chosen so that they too stay within float32.
    """

    parameters: ClassVar[Mapping[str, Spec]] = {}
    places: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse values that contradict each other; ``given`` are the names of the parameters that the scene file sets.

        Raises:
            Refused: with the parameter and the accepted values.
        """

    @classmethod
    def files(
        cls, values: Mapping[str, Any], find: Callable[[str], Path]
    ) -> dict[str, tuple[NDArray[np.float32], Spec]]:
        """Return arrays read from files, with their specs, by the names of the parameters that they become.

        Args:
            values: values of the parameters.
            find: returns the path of the file that a parameter names, by its key.

        Raises:
            Refused: numbers that the light does not accept.
            AssetError: a missing or malformed file.
        """
        return {}

    @classmethod
    def row(cls, scene: Setting) -> Row:
        """Return the row of the table; differentiable in the parameters.

        Raises:
            Refused: numbers beyond the world's dtype.
        """
        raise NotImplementedError

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor, mis: bool) -> LightSample:
        """Sample a point on the light or a direction toward it.

        Args:
            at: rows of the table, one a lane, as from :func:`lane_rows`.
            x: points to be lit ``(3, N)``.
            u: ``(2, N)`` in [0, 1).
            mis: whether the sample is combined with BSDF sampling by MIS.

        Returns:
            ``wi``, ``target`` (``wi`` if distant), ``radiance``, ``pdf`` and ``weight``, without the probability of the light.
            For a delta light ``weight`` is the factor of ``radiance``.
        """
        raise NotImplementedError

    @classmethod
    def emit(cls, at: Lights, u: Tensor, v: Tensor, sphere: BoundingSphere, mis: bool) -> EmittedRay:
        """Sample rays that leave the light.

        Here those of a distant light, whose directions :meth:`sample` draws, or of a point, evenly in all directions.

        Args:
            at: rows of the table, one a lane.
            u: ``(2, N)`` in [0, 1), chooses the direction.
            v: ``(2, N)`` in [0, 1), chooses the point.
            sphere: a ball around the scene.
            mis: as for :meth:`sample`.
        """
        if not cls.distant:
            d = uniform_sphere(v).to(at.p0.dtype)
            drawn = cls.sample(at, at.p0 + d, u, mis)  # what arrives at a distance of 1
            density = cls.emission_density(at, torch.ones_like(drawn.pdf), sphere)
            return EmittedRay(at.p0.expand_as(d), d, drawn.radiance, density, torch.ones_like(drawn.pdf))
        drawn = cls.sample(at, sphere.centre[:, None].expand(3, u.shape[1]), u, mis)
        d = -drawn.wi
        pdf = drawn.pdf if cls.environment else torch.ones_like(drawn.pdf)
        return EmittedRay(sphere.origins(d, v), d, drawn.radiance, cls.emission_density(at, pdf, sphere), pdf)

    @classmethod
    def emission_density(cls, at: Lights, pdf: Tensor, sphere: BoundingSphere) -> Tensor:
        """Return the density ``(N,)`` of rays under :meth:`emit`: of a point by solid angle alone.

        Args:
            at: rows of the table, one a lane.
            pdf: density ``(N,)`` of their directions under :meth:`sample`; not read for lights without extent.
            sphere: a ball around the scene.
        """
        if not cls.distant:
            return torch.full_like(pdf, 0.25 / math.pi)
        across = sphere.density()
        return pdf * across if cls.environment else across.expand_as(pdf)


@dataclass(frozen=True)
class EnvironmentImage:
    """An environment as an image of all directions, in the layout of :mod:`torchpt.physics.lights.kinds.envmap`.

    Attributes:
        texels: ``(H, W, 3)`` radiance.
        turn: ``(3, 3)`` from the world to the image's own space; None for the identity.
        even: whether all texels are equal, so that the radiance is constant.
    """

    texels: Tensor
    turn: Tensor | None = None
    even: bool = False


class Environment(Light):
    """A light that surrounds the scene. Methods take as ``around`` the :attr:`Row.environment` that :meth:`row` returned."""

    distant = True
    environment = True

    @classmethod
    def radiance_pdf(cls, around: Any, d: Tensor, mis: bool) -> tuple[Tensor, Tensor]:
        """Return radiance ``(3, N)`` from unit directions ``d (3, N)``, and their density ``(N,)`` under :meth:`sample`."""
        raise NotImplementedError

    @classmethod
    def environment_image(cls, around: Any) -> EnvironmentImage:
        """Return the environment as an image; differentiable."""
        raise NotImplementedError

    @classmethod
    def info(cls, around: Any) -> dict[str, Any]:
        """Return what ``torchpt info`` prints about the environment, by name."""
        return {}


def bright(color: Tensor) -> Tensor:
    """Return the luminance of the magnitude of colours ``(3, ...)``, float64, detached."""
    return luminance(color.detach().double().abs())


#: The kinds of lights without a surface.
KINDS: Kinds[Light] = Kinds(
    "torchpt.physics.lights.kinds", ("point", "spot", "directional", "constant", "envmap", "sky")
)


def sort_key(name: str) -> tuple[bool, bool, str]:
    """Return the sort key of rows of lights: local lights first, then distant ones, the environment last."""
    kind = KINDS[name]
    return kind.environment, kind.distant, name
