"""Map unconstrained numbers to the ranges of parameters, so that an optimizer may take any step.

``renderer.py`` chooses a map for each parameter by its spec, the declaration of its range (:func:`parametrization_of`). ``x``
are the numbers that are optimized, ``low`` and ``high`` the ends of the range.

=================  =======================================  =============================================================
map                range                                   parameter
=================  =======================================  =============================================================
``Bounded``        two ends: albedos, roughnesses, angles  ``low + (high - low) ((1 + 2 e) sigmoid(x) - e)``, clamped
``LowerBounded``   one end: radiances, radii, indices      ``low + s (softplus(x) - e)``, clamped
``Unbounded``      none: points, directions, vertices      ``x``
``AxisAnglePose``  poses                                   ``exp(w)`` times the initial pose, at ``l t``; ``x = (w, t)``
=================  =======================================  =============================================================

In a rigid motion ``w`` is a rotation as axis times angle, ``exp(w)`` its matrix, ``l`` a length of the scene, ``t`` a position.
Others are chosen by ``Renderer(parametrizations=...)``: ``QuaternionPose``, ``LookAtPose``, and ``LargeSteps`` for vertices.

A plain sigmoid never reaches 0 or 1, and is flat near them: an albedo of 0 would be ``x`` of minus infinity, and stay there.
So it is stretched by ``e = 0.05`` at each closed end, which is then reached at a finite ``x`` with a sixth of the slope in
the middle. Beyond an end the parameter is clamped, and only gradients that lead back pass (a projected gradient). Open ends
(a radius above 0) are not stretched. ``s`` is the mean distance of the initial value from ``low`` (1 if that is 0), so that a
step of ``x`` is relative to the parameter's scale, for a lamp of 0.01 as for one of 1,000.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from torchpt.core.errors import ArgumentTypeError, ArgumentValueError
from torchpt.math.laplacian import TOLERANCE, LaplacianSystem, mesh_edges
from torchpt.nn.poses import PARALLEL, axis_angle_matrix, look_at_matrix, pose_of, quaternion_matrix
from torchpt.spec import Pose, Spec

__all__ = [
    "AxisAnglePose",
    "Bounded",
    "LargeSteps",
    "LookAtPose",
    "LowerBounded",
    "Parametrization",
    "PoseParametrization",
    "QuaternionPose",
    "Unbounded",
    "parametrization_of",
]

#: Overshoot of a closed end, as a share of the range.
OVERSHOOT = 0.05
#: Closest distance to an open end, as a share of the range.
OPEN_END_MARGIN = 1e-6
#: A range that is wider than the initial value by more than this factor counts as one without an upper end: a sigmoid would be
#: flat there.
OPEN_ENDED_FACTOR = 100.0


class _ProjectedClamp(torch.autograd.Function):
    """``clamp`` that passes gradients beyond an end if they lead back into the range."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, low: float, high: float) -> Tensor:
        return x.clamp(low, high)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        x, ctx.low, ctx.high = inputs
        ctx.save_for_backward(x)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> Any:
        (x,), (cotangent,) = ctx.saved_tensors, cotangents
        outward = ((x <= ctx.low) & (cotangent > 0)) | ((x >= ctx.high) & (cotangent < 0))
        return torch.where(outward, 0.0, cotangent), None, None


class _ProjectedClampWithJvp(_ProjectedClamp):
    """The same, with forward mode.

    A tangent has no loss by which it could lead back: it passes within the range, ends included.
    """

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _ProjectedClamp.setup_context(ctx, inputs, output)
        ctx.save_for_forward(inputs[0])

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        (x,) = ctx.saved_tensors
        return torch.where((x >= ctx.low) & (x <= ctx.high), tangents[0], 0.0)


def _projected_clamp(x: Tensor, low: float, high: float) -> Any:
    # Graphs of torch.compile hold no function with a jvp of its own.
    function = _ProjectedClamp if torch.compiler.is_compiling() else _ProjectedClampWithJvp
    return function.apply(x, low, high)


class Parametrization(nn.Module):
    """Map of one parameter: ``forward`` computes it from the optimized numbers ``x``, ``inverse`` computes ``x``.

    Both keep the device and dtype of their argument. Buffers hold what depends on the initial value.
    """

    def inverse(self, value: Tensor) -> Tensor:
        """Return ``x`` of a value of the parameter."""
        raise NotImplementedError


class Unbounded(Parametrization):
    """The identity, for parameters without bounds."""

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        return x

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        return value


class Bounded(Parametrization):
    """A range between two ends; ``open_low`` and ``open_high``: True for an end that is excluded.

    A *share* is the parameter's place in the range: 0 at ``low``, 1 at ``high``.
    """

    def __init__(self, low: float, high: float, *, open_low: bool, open_high: bool) -> None:
        super().__init__()
        self.low, self.high = low, high
        self.overshoot_low, self.overshoot_high = (0.0 if open_end else OVERSHOOT for open_end in (open_low, open_high))
        self.lowest_share, self.highest_share = (
            (OPEN_END_MARGIN if open_low else 0.0),
            1.0 - (OPEN_END_MARGIN if open_high else 0.0),
        )

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        share = _projected_clamp(
            (1.0 + self.overshoot_low + self.overshoot_high) * x.sigmoid() - self.overshoot_low,
            self.lowest_share,
            self.highest_share,
        )
        return self.low + (self.high - self.low) * share

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        share = ((value.double() - self.low) / (self.high - self.low)).clamp(self.lowest_share, self.highest_share)
        return ((share + self.overshoot_low) / (1.0 + self.overshoot_low + self.overshoot_high)).logit().to(value)


class LowerBounded(Parametrization):
    """A range above an end, and up to a distant one; ``start``: initial value of the parameter."""

    scale: Tensor

    def __init__(self, low: float, high: float, *, open_low: bool, start: Tensor) -> None:
        super().__init__()
        self.low, self.high = low, high
        self.overshoot_low, self.lowest_share = (0.0, OPEN_END_MARGIN) if open_low else (OVERSHOOT, 0.0)
        scale = (start.double() - low).abs().mean()
        self.register_buffer("scale", (scale if scale > 0 else torch.ones_like(scale)).to(start))

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        above = _projected_clamp(nn.functional.softplus(x) - self.overshoot_low, self.lowest_share, math.inf)
        return _projected_clamp(self.low + self.scale * above, -math.inf, self.high)

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        # The inverse of softplus is log(exp(y) - 1), written so that neither large nor small y lose digits.
        y = ((value.double() - self.low) / self.scale.double()).clamp(min=self.lowest_share) + self.overshoot_low
        return (y + torch.log(-torch.expm1(-y))).to(value)


class PoseParametrization(Parametrization):
    """Base class of maps to poses; ``start``: the initial pose, ``length``: the unit of positions, such as ``scene.length``."""

    def __init__(self, start: Tensor, length: float = 1.0) -> None:
        super().__init__()
        self.length = length


class _RelativePose(PoseParametrization):
    """A pose turned about its own origin from the initial one, and moved; scale and shear are kept.

    ``x`` is a rotation from the initial pose, then the position of the origin in units of ``length``, so that steps of both
    change the picture alike.
    """

    frame: Tensor

    def __init__(self, start: Tensor, length: float = 1.0) -> None:
        super().__init__(start, length)
        self.register_buffer("frame", start.detach()[:3, :3].clone())  # rotation, scale and shear of the initial pose

    @staticmethod
    def matrix(rotation: Tensor, /) -> Tensor:
        """Return the rotation ``(3, 3)`` float64 of its numbers."""
        raise NotImplementedError

    @staticmethod
    def numbers(matrix: Tensor, /) -> Tensor:
        """Return the numbers of a rotation ``(1, 3, 3)``, with a first dimension of 1."""
        raise NotImplementedError

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        rotated = (self.matrix(x[:-3]) @ self.frame.double()).to(x.dtype)
        return pose_of(rotated, self.length * x[-3:])

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`.

        Raises:
            ValueError: the pose is no rigid motion of the initial one.
        """
        rotation = value[:3, :3].double() @ torch.linalg.inv(self.frame.double())
        if not _is_rotation(rotation):
            raise ValueError("the pose at first, turned and moved (rigid=False takes any)")
        return torch.cat((self.numbers(rotation[None])[0].to(value), value[:3, 3] / self.length))


class AxisAnglePose(_RelativePose):
    """A rigid motion of a pose: ``x (6,)`` is axis times angle in radians, then the position over ``length``."""

    matrix = staticmethod(axis_angle_matrix)

    @staticmethod
    def numbers(matrix: Tensor, /) -> Tensor:
        """Return the rotation vector of a rotation."""
        from kornia.geometry.conversions import rotation_matrix_to_axis_angle

        return rotation_matrix_to_axis_angle(matrix)


class QuaternionPose(_RelativePose):
    """A rigid motion of a pose: ``x (7,)`` is a quaternion, real part first, then the position over ``length``.

    The quaternion turns the initial pose, and is ``(1, 0, 0, 0)`` at first. It may have any length; 0 stands for no turn.
    """

    @staticmethod
    def matrix(rotation: Tensor) -> Tensor:
        """Return the rotation of a quaternion."""
        none = torch.zeros_like(rotation)
        none[0] = 1.0
        return quaternion_matrix(torch.where((rotation != 0).any(), rotation, none))

    @staticmethod
    def numbers(matrix: Tensor, /) -> Tensor:
        """Return the unit quaternion of a rotation."""
        from kornia.geometry.conversions import rotation_matrix_to_quaternion

        return rotation_matrix_to_quaternion(matrix)


class LookAtPose(PoseParametrization):
    """A pose aimed at a point: ``x (6,)`` is the position of the origin and the point, both over ``length``.

    The +z axis points to it, as a camera's does, and the initial +y axis stays in the upper half: no roll about the axis. At
    first the point lies at distance ``length``. Scale and shear are kept. Where the point lies along the initial +y axis,
    another axis stays in the upper half, and an origin that is the point looks along such an axis: all finite ``x`` are poses.
    """

    up: Tensor
    frame: Tensor

    def __init__(self, start: Tensor, length: float = 1.0) -> None:
        super().__init__(start, length)
        linear = start.detach()[:3, :3].double()
        axes = look_at_matrix(torch.zeros_like(linear[:, 2]), linear[:, 2], linear[:, 1])
        self.register_buffer("up", start.detach()[:3, 1].clone())
        self.register_buffer("frame", (axes.T @ linear).to(start))  # scale and shear of the initial pose

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        axes = self._axes(x[3:].double() - x[:3].double())
        return pose_of((axes @ self.frame.double()).to(x.dtype), self.length * x[:3])

    def _axes(self, direction: Tensor) -> Tensor:
        """Return the axes that look in a direction ``(3,)`` float64; another up or direction stands in where there are none."""
        up = self.up.double()
        beside = nn.functional.one_hot(up.abs().argmin(), 3).to(up)  # the axis of the world that is furthest from up
        direction = torch.where((direction != 0).any(), direction, beside)
        sine = torch.linalg.vector_norm(
            torch.linalg.cross(nn.functional.normalize(up, dim=0), nn.functional.normalize(direction, dim=0))
        )
        return look_at_matrix(torch.zeros_like(direction), direction, torch.where(sine > PARALLEL, up, beside))

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`.

        Raises:
            ValueError: the pose is not the initial one, aimed elsewhere and moved.
        """
        axes = value[:3, :3].double() @ torch.linalg.inv(self.frame.double())
        aimed = self._axes(axes[:, 2])
        if not _is_rotation(axes) or not torch.allclose(axes, aimed, atol=1e-4):
            raise ValueError("the pose at first, aimed elsewhere and moved, without roll")
        origin = value[:3, 3].double() / self.length
        return torch.cat((origin, origin + axes[:, 2])).to(value)


def _is_rotation(matrix: Tensor) -> bool:
    """Return True for a rotation ``(3, 3)``, within tolerance."""
    orthogonal = torch.allclose(matrix @ matrix.T, torch.eye(3).to(matrix), atol=1e-4)
    return orthogonal and bool(torch.linalg.det(matrix) > 0)


class LargeSteps(Parametrization):
    """Vertices ``v (V, 3)`` of a mesh as ``(I + λ L)^-1 x``, so that steps of an optimizer move smooth regions together.

    Nicolet, Jacobson and Jakob, *Large Steps in Inverse Rendering of Geometry* (2021): L is the combinatorial Laplacian. A
    gradient step in ``x`` is one in ``v`` smoothed twice, so meshes stay free of tangles at large learning rates. ``backward``,
    the transforms of ``torch.func`` (``vmap`` and ``jvp`` too) and derivatives of any order go through both directions.

    Args:
        faces: ``(F, 3)`` indices of vertices, such as ``scene.faces("shapes.NAME")``.
        lambda_: weight λ of smoothness, from 0; the paper takes 19 for most meshes, more for finer ones. In float32 a million
            is about the most: of larger ones ``I`` is lost in rounding beside ``λ L``.

    Raises:
        SceneError: faces are no tensor ``(F, 3)`` of indices, or λ is no number from 0; also a ``TypeError`` or ``ValueError``.
    """

    edges: Tensor

    def __init__(self, faces: Tensor, lambda_: float = 19.0) -> None:
        super().__init__()
        if (
            not isinstance(faces, Tensor)
            or faces.is_floating_point()
            or faces.is_complex()
            or faces.dtype == torch.bool
        ):
            found = str(faces.dtype) if isinstance(faces, Tensor) else type(faces).__name__
            raise ArgumentTypeError("faces", found, "a tensor of whole numbers")
        if faces.dim() != 2 or faces.shape[1] != 3:
            raise ArgumentValueError("faces", tuple(faces.shape), "a tensor of shape (F, 3)")
        if faces.numel() and int(faces.min()) < 0:
            raise ArgumentValueError("faces", int(faces.min()), "indices of vertices, from 0")
        if isinstance(lambda_, bool) or not isinstance(lambda_, int | float):
            raise ArgumentTypeError("lambda_", lambda_, "a finite number >= 0")
        if not 0.0 <= lambda_ < math.inf:
            raise ArgumentValueError("lambda_", lambda_, "a finite number >= 0")
        self.lambda_ = float(lambda_)
        self.register_buffer("edges", mesh_edges(faces), persistent=False)
        self.vertex_count = int(faces.max()) + 1 if faces.numel() else 0  # at least
        self.most_neighbours = int(torch.bincount(self.edges.reshape(-1)).max()) if len(self.edges) else 0
        self._system: LaplacianSystem | None = None

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`.

        Raises:
            SceneError: no floating tensor, also a ``TypeError``; not as many numbers as the mesh has, numbers that are not
                finite, or a weight λ that is too large for their dtype, also a ``ValueError``.
        """
        if not isinstance(x, Tensor) or not x.is_floating_point():
            found = str(x.dtype) if isinstance(x, Tensor) else type(x).__name__
            raise ArgumentTypeError("x", found, f"a floating tensor of {self._expected()}")
        if not self._fits(x):
            raise ArgumentValueError("x", tuple(x.shape), self._expected())
        self._check_weight(x.dtype)
        return self._system_of(x).solve(x, "x")

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`.

        Raises:
            ValueError: the value is not of vertices of these faces, or the weight λ too large for its dtype.
        """
        if not isinstance(value, Tensor) or not value.is_floating_point() or not self._fits(value):
            raise ValueError(self._expected())
        self._check_weight(value.dtype)
        return self._system_of(value).apply(value.double()).to(value)

    def _fits(self, vertices: Tensor) -> bool:
        return vertices.dim() == 2 and vertices.shape[1] == 3 and len(vertices) >= self.vertex_count

    def _check_weight(self, dtype: torch.dtype) -> None:
        """Raise ArgumentValueError if rounding of ``λ L v``, in a dtype and by the solver, is as large as ``v``."""
        rounding = max(torch.finfo(dtype).eps, TOLERANCE) * self.most_neighbours
        if self.lambda_ * rounding > 1.0:
            expected = f"at most {1.0 / rounding:.2g} for this mesh in {dtype}"
            raise ArgumentValueError("lambda_", self.lambda_, expected)

    def _expected(self) -> str:
        return f"vertices (V, 3) of the mesh whose faces LargeSteps was given, V at least {self.vertex_count}"

    def extra_repr(self) -> str:
        """Return the weight and the number of edges, for ``print``."""
        return f"lambda_={self.lambda_:g}, {len(self.edges)} edges"

    def _system_of(self, vertices: Tensor) -> LaplacianSystem:
        system = self._system
        if system is None or system.edges is not self.edges or len(system.degrees) != len(vertices):
            system = self._system = LaplacianSystem.of(self.edges, len(vertices), self.lambda_)
        return system

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_system": None}  # made again where it is needed


def parametrization_of(spec: Spec, start: Tensor, *, rigid: bool = True, length: float = 1.0) -> Parametrization:
    """Return the map for a parameter.

    Args:
        spec: declaration of the parameter.
        start: its initial value.
        rigid: True: poses move rigidly. False: only those whose spec says that they must keep angles or lengths.
        length: size of the scene, the unit of a pose's position.
    """
    if isinstance(spec, Pose):
        return AxisAnglePose(start, length) if rigid or spec.angles or spec.rigid else Unbounded()
    low, high = getattr(spec, "low", None), getattr(spec, "high", None)
    above, below = getattr(spec, "above", None), getattr(spec, "below", None)  # open ends
    # Of a closed and an open end, the tighter one counts.
    open_low = above is not None and (low is None or above >= low)
    open_high = below is not None and (high is None or below <= high)
    low, high = above if open_low else low, below if open_high else high
    if low is None:
        return Unbounded()
    largest = float((start.double() - low).abs().max()) if start.numel() else 0.0
    if high is None or high - low > OPEN_ENDED_FACTOR * max(largest, 1.0):
        return LowerBounded(low, math.inf if high is None else high, open_low=open_low, start=start)
    return Bounded(low, high, open_low=open_low, open_high=open_high)
