"""What a light is: whatever emits, and the lights that are no surfaces."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import luminance, take
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
    "Cone",
    "Emitter",
    "Environment",
    "EnvironmentImage",
    "Light",
    "Row",
    "Setting",
    "bright",
    "sort_key",
    "taken",
]  # fmt: skip

#: Columns of the table that every row has.
COLUMNS = ("p0", "e1", "e2", "normal", "flip", "area", "bound", "radiance")


def taken(lights: Lights, row: Tensor | None) -> Lights:
    """Lane values of the table at ``row``; with a single row (None) the table itself, which broadcasts."""
    bent = lights.quadrics
    if bent is not None:
        assert lights.quadric is not None
        bent = rows_of(bent, lights.quadric if row is None else take(lights.quadric, row))
    if row is None:
        return lights if bent is None else replace(lights, quadrics=bent)
    covered = None if lights.opacity is None else take(lights.opacity, row)
    columns = {name: take(getattr(lights, name), row) for name in COLUMNS}
    return replace(lights, opacity=covered, quadrics=bent, **columns)


@dataclass(frozen=True)
class Cone:
    """Where K lights shine to, about ``Lights.normal``, and how brightly; see :func:`torchpt.physics.lights.tree.build`."""

    cos_o: Tensor | float  # (K,)
    cos_e: Tensor | float  # (K,)
    intensity: Tensor  # (K,)


class Emitter:
    """Whatever has rows in the table of lights.

    Attributes:
        name: of the kind.
        distant: whether it is infinitely far.
        environment: whether it surrounds the scene, of which there may be one.
        code: of the shape that :mod:`torchpt.physics.lights.solid_angle` draws by its solid angle; else ``OTHER``.
    """

    name: ClassVar[str] = ""
    distant: ClassVar[bool] = False
    environment: ClassVar[bool] = False
    code: ClassVar[int] = OTHER

    @classmethod
    def bounds(cls, at: Lights, intensity: Tensor) -> Cone:
        """Where rows of the kind shine to: no light leaves them outside. Of distant kinds nothing asks.

        Args:
            at: K rows of the table, float64, detached.
            intensity: power over pi ``(K,)``: what a flat face sends straight ahead.
        """
        # All directions; what is convex shows a quarter of its area on average.
        return Cone(-1.0, 0.0, intensity * 0.25)


@dataclass(frozen=True)
class Setting:
    """What a light is told of its scene when its row is made.

    Attributes:
        given: its own parameters by key, as the scene holds them.
        values: of its parameters as it was loaded: flags, choices and whole numbers, which are no tensors.
        place: from a point ``(3,)`` of the scene to the lanes' coordinates, float64.
        unit: how long the lanes' unit is in the scene's.
        reach: ``()`` float64 radius of the scene in the lanes' unit.
        dtype: of the lanes.
    """

    given: Callable[[str], Tensor]
    values: Mapping[str, Any]
    place: Callable[[Tensor], Tensor]
    unit: float
    reach: Tensor
    dtype: torch.dtype

    def __getitem__(self, key: str) -> Tensor:
        """A parameter in float64."""
        return self.given(key).double()

    def point(self, key: str) -> Tensor:
        """A parameter that is a point, in the lanes' coordinates."""
        return self.place(self[key])

    def intensity(self, key: str) -> Tensor:
        """A parameter that is a power per solid angle, in the lanes' unit: what arrives at a distance is the same.

        Raises:
            Refused: more than float32 holds.
        """
        scaled = self[key] / self.unit**2
        if not bool(torch.isfinite(scaled.float()).all()):
            most = torch.finfo(torch.float32).max * self.unit**2
            expected = f"at most {most:.3g} in a scene this small: what arrives is beyond float32"
            raise Refused(expected, self[key].tolist(), (key,))
        return scaled


@dataclass(frozen=True)
class Row:
    """A light's columns of the table, float64; what is None is zero.

    Attributes:
        radiance: ``(3,)`` or whatever else its :meth:`Light.sample` reads there.
        power: ``()`` that it sends out, in luminance, detached: lights are chosen by it.
        p0: ``(3,)`` where it is, unless it is distant.
        e1: ``(3,)`` free for the kind's own numbers.
        e2: ``(3,)`` the same.
        normal: unit ``(3,)``, the axis that :meth:`Emitter.bounds` is about.
        environment: record of tensors that its :class:`Environment` methods are given.
    """

    radiance: Tensor
    power: Tensor
    p0: Tensor | None = None
    e1: Tensor | None = None
    e2: Tensor | None = None
    normal: Tensor | None = None
    environment: Any = None


class Light(Emitter):
    """A kind of light that is no surface.

    Rays do not meet such lights, unless they are the :class:`Environment`; a light that no ray meets has an infinite
    density, whatever it is drawn by, so that light sampling counts whole.

    Attributes:
        name: its ``type`` in a scene file.
        parameters: what it declares.
        places: names of those of them that are points which the lanes hold; so are their distances from the scene.
    """

    parameters: ClassVar[Mapping[str, Spec]] = {}
    places: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse values that do not go together.

        Raises:
            Refused: says which, and what is accepted.
        """

    @classmethod
    def files(
        cls, values: Mapping[str, Any], find: Callable[[str], Path]
    ) -> dict[str, tuple[NDArray[np.float32], Spec]]:
        """Arrays that its files hold, and their specs, by the names under which they become parameters.

        Args:
            values: of its parameters.
            find: the file that a parameter, by its key, names.

        Raises:
            Refused: numbers that the light cannot have.
            AssetError: a file that is missing or malformed.
        """
        return {}

    @classmethod
    def row(cls, scene: Setting) -> Row:
        """Its row of the table; differentiable in the parameters.

        Raises:
            Refused: numbers that the lanes cannot hold.
        """
        raise NotImplementedError

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor, mis: bool) -> LightSample:
        """A point on the light, or a direction toward it, for lanes that drew it.

        Args:
            at: the lanes' rows of the table.
            x: reference points ``(3, N)``.
            u: ``(2, N)`` in [0, 1).
            mis: whether BSDF sampling shares the work.

        Returns:
            ``wi``, ``target`` (``wi`` where it is distant), ``radiance``, ``pdf`` and ``weight``, without the choice of the
            light. Of a light that no ray meets ``weight`` is what ``radiance`` is to be multiplied by.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class EnvironmentImage:
    """An environment as a picture of all directions, laid out as :mod:`torchpt.physics.lights.kinds.envmap` says.

    Attributes:
        texels: ``(H, W, 3)`` radiance.
        turn: ``(3, 3)`` from the world to the picture's own space; None where they are the same.
        even: whether all texels are one.
    """

    texels: Tensor
    turn: Tensor | None = None
    even: bool = False


class Environment(Light):
    """A light that surrounds the scene. Its functions are given what its :attr:`Row.environment` was."""

    distant = True
    environment = True

    @classmethod
    def radiance_pdf(cls, around: Any, d: Tensor, mis: bool) -> tuple[Tensor, Tensor]:
        """Radiance ``(3, N)`` from unit directions ``d (3, N)``, and the density ``(N,)`` with which they are drawn."""
        raise NotImplementedError

    @classmethod
    def environment_image(cls, around: Any) -> EnvironmentImage:
        """The same as a picture; differentiable."""
        raise NotImplementedError

    @classmethod
    def info(cls, around: Any) -> dict[str, Any]:
        """What ``torchpt info`` tells of it."""
        return {}


def bright(color: Tensor) -> Tensor:
    """Luminance of colours ``(3, ...)`` of either sign, float64, detached: what powers are made of."""
    return luminance(color.detach().double().abs())


#: The kinds of lights that are no surfaces.
KINDS: Kinds[Light] = Kinds("torchpt.physics.lights.kinds", ("point", "spot", "directional", "constant", "envmap"))


def sort_key(name: str) -> tuple[bool, bool, str]:
    """By which the rows of lights are sorted: those somewhere, those infinitely far, the environment last."""
    kind = KINDS[name]
    return kind.environment, kind.distant, name
