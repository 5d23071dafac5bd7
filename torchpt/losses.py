"""Losses between noisy pictures, for any two tensors of one shape such as ``(H, W, 3)``, and losses of meshes.

``l1 l2 relmse smape`` compare a picture with its target, ``unbiased_squared_error`` and ``unbiased_relmse`` two independent
renders of one scene with it. A backward pass of ``torchpt.render`` draws its own samples, so the gradient of a loss that is
quadratic in the picture is unbiased with one render. Its *value* is biased by the variance of the noise; two renders remove
that. docs/guides/ml.md has the details.

``mesh_edge_loss mesh_laplacian_smoothing mesh_normal_consistency`` keep meshes smooth; names and values are those of
PyTorch3D's functions for a single mesh. They take ``vertices (V, 3)`` in any space and ``faces (F, 3)``, indices of vertices
such as ``Scene.faces`` returns.
"""

from __future__ import annotations

from numbers import Real

import torch
from torch import Tensor

from torchpt.core.autograd import is_transformed
from torchpt.core.errors import ArgumentTypeError, ArgumentValueError
from torchpt.images.metrics import FLOOR, relative, symmetric
from torchpt.math.laplacian import adjacent_faces, cotangent_weights, mesh_edges, neighbour_sums

__all__ = [
    "l1",
    "l2",
    "mesh_edge_loss",
    "mesh_laplacian_smoothing",
    "mesh_normal_consistency",
    "relmse",
    "smape",
    "unbiased_relmse",
    "unbiased_squared_error",
]

#: Twice the area of a face that has no normal, at most, over the square of its longest edge; in rounding errors of its dtype.
_FLAT_FACE = 8.0


def _check_pictures(*pictures: Tensor) -> None:
    """Raise unless all pictures are floating tensors of one shape, so that none is broadcast."""
    for picture in pictures:
        if not isinstance(picture, Tensor):
            hint = "; hand over its .image" if hasattr(picture, "image") else ""
            raise ArgumentTypeError(f"picture: expected a tensor, got {type(picture).__name__}{hint}")
        if not picture.is_floating_point():
            expected = "a tensor of floating numbers, linear as renders are"
            raise ArgumentTypeError(f"picture: expected {expected}, got one of {picture.dtype}")
    shapes = {tuple(picture.shape) for picture in pictures}
    if len(shapes) > 1:
        raise ArgumentValueError(f"pictures: expected one shape, got {' and '.join(map(str, sorted(shapes)))}")


def l2(image: Tensor, target: Tensor) -> Tensor:
    """Return the mean of ``(x - t)²``.

    Raises:
        SceneError: the shapes differ, also a ``ValueError`` (all losses raise it); no floating tensor, for example a
            :class:`torchpt.Rendering`, also a ``TypeError``.
    """
    _check_pictures(image, target)
    return (image - target).square().mean()


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Return the mean of ``|x - t|``. For a noisy picture its gradient points to the median of a pixel, not to its mean."""
    _check_pictures(image, target)
    return (image - target).abs().mean()


def relmse(image: Tensor, target: Tensor, floor: float = FLOOR) -> Tensor:
    """Return the mean of ``(x - t)² / (t² + floor)``: dark pixels count as much as bright ones.

    The denominator has the target alone, so this is quadratic in the picture (Rousselle et al. 2011, section 4.2).
    """
    _check_pictures(image, target)
    return relative((image - target).square(), target, floor).mean()


def smape(image: Tensor, target: Tensor, floor: float = FLOOR) -> Tensor:
    """Return the mean of ``|x - t| / (|x| + |t| + floor)``: bounded, so fireflies count little; biased for noisy pictures."""
    _check_pictures(image, target)
    return symmetric(image, target, floor).mean()


def unbiased_squared_error(a: Tensor, b: Tensor, target: Tensor) -> Tensor:
    """Return the mean of ``(a - t)(b - t)`` of two renders of one scene with different seeds.

    As the renders are independent, its expectation is ``(E x - t)²``, and its gradient is an unbiased estimate of the gradient
    of that. It may be negative.
    """
    _check_pictures(a, b, target)
    return ((a - target) * (b - target)).mean()


def unbiased_relmse(a: Tensor, b: Tensor, target: Tensor, scale: Tensor | None = None, floor: float = FLOOR) -> Tensor:
    """Return the mean of ``(a - t)(b - t) / (s² + floor)`` of two renders of one scene with different seeds.

    Args:
        a: one render.
        b: another one, with another seed.
        target: the target.
        scale: ``s``, by default the target, without a gradient. If the target is a noisy render, pass a less noisy picture or
            other samples, such as the denoised target: the target's noise in the denominator would bias the weights of pixels.
        floor: keeps black pixels finite.
    """
    scale = target if scale is None else scale
    _check_pictures(a, b, target, scale)
    return relative((a - target) * (b - target), scale.detach(), floor).mean()


def _check_mesh(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return faces on the device of the vertices.

    Raises:
        SceneError: vertices are no floating tensor, or faces no tensor of whole numbers, also a ``TypeError``; a wrong shape,
            or a face with a vertex that is not there, also a ``ValueError``.
    """
    if not isinstance(vertices, Tensor) or not vertices.is_floating_point():
        found = vertices.dtype if isinstance(vertices, Tensor) else type(vertices).__name__
        raise ArgumentTypeError(f"vertices: expected a tensor of floating numbers, got {found}")
    if not isinstance(faces, Tensor) or faces.is_floating_point() or faces.is_complex() or faces.dtype == torch.bool:
        found = faces.dtype if isinstance(faces, Tensor) else type(faces).__name__
        raise ArgumentTypeError(f"faces: expected a tensor of whole numbers, got {found}")
    for name, value in (("vertices", vertices), ("faces", faces)):
        if value.dim() != 2 or value.shape[1] != 3:
            raise ArgumentValueError(f"{name}: expected shape (N, 3), got {tuple(value.shape)}")
    if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices):
        expected = f"indices of vertices in 0..{len(vertices) - 1}"
        raise ArgumentValueError(f"faces: expected {expected}, got {int(faces.min())}..{int(faces.max())}")
    return faces.to(vertices.device)


def _check_length(key: str, value: float | Tensor) -> None:
    """Raise ArgumentTypeError or ArgumentValueError unless a value is a finite number from 0, also as a tensor of one."""
    expected = "a finite number >= 0"
    if isinstance(value, Tensor):
        if value.numel() != 1 or value.is_complex() or value.dtype == torch.bool:
            raise ArgumentTypeError(key, (tuple(value.shape), value.dtype), f"{expected}, also as a tensor of one")
        if is_transformed(value):  # its number is not known
            return
        value = float(value.detach())
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ArgumentTypeError(key, value, expected)
    if not 0.0 <= value < float("inf"):
        raise ArgumentValueError(key, value, expected)


def mesh_edge_loss(vertices: Tensor, faces: Tensor, target_length: float | Tensor = 0.0) -> Tensor:
    """Return the mean of ``(length - target_length)²`` over the edges of a mesh; 0 without edges.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        target_length: a finite number from 0, also as a tensor of one, to which gradients flow.

    Raises:
        SceneError: vertices are no floating tensor, faces no tensor of whole numbers (all losses of meshes raise it), or the
            length no number, also a ``TypeError``; a wrong shape, an index that is out of range, or a length that is, also a
            ``ValueError``.
    """
    faces = _check_mesh(vertices, faces)
    _check_length("target_length", target_length)
    if not len(faces):
        return 0.0 * vertices.sum()
    i, j = mesh_edges(faces).unbind(1)
    lengths = torch.linalg.vector_norm(vertices[i] - vertices[j], dim=1)
    return (lengths - target_length).square().mean()


def mesh_laplacian_smoothing(vertices: Tensor, faces: Tensor, method: str = "uniform") -> Tensor:
    """Return the mean distance of vertices from the weighted mean of their neighbours; 0 without faces.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        method: ``uniform``: neighbours count alike (Taubin 1995). ``cot``: by the cotangents of the angles opposite to their
            edge (Desbrun et al., *Implicit Fairing*, 1999), so that the position of vertices within the surface matters less;
            the weights have no gradients.
    """
    faces = _check_mesh(vertices, faces)
    if method not in ("uniform", "cot"):
        raise ArgumentValueError("method", method, "uniform or cot")
    if not len(faces):
        return 0.0 * vertices.sum()
    edges = mesh_edges(faces)
    weights = cotangent_weights(vertices, faces, edges) if method == "cot" else vertices.new_ones(len(edges))
    total = vertices.new_zeros(len(vertices)).index_add(0, edges.reshape(-1), weights.repeat_interleave(2))
    sums, known = neighbour_sums(edges, vertices, weights), total > 0
    # Vertices without neighbours, and those whose cotangents do not sum to a positive number, count as 0.
    offsets = torch.where(known[:, None], sums / torch.where(known, total, 1.0)[:, None] - vertices, 0.0)
    return torch.linalg.vector_norm(offsets, dim=1).mean()


def mesh_normal_consistency(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return the mean of ``1 - cos(angle between normals)`` over pairs of faces with a common edge; 0 without such pairs.

    The normals of a pair are those on one side of it, whatever the order of the faces' vertices. Faces without area, within
    rounding, count as perpendicular to all others, and have no gradient.
    """
    faces = _check_mesh(vertices, faces)
    edges, opposite = adjacent_faces(faces)
    if not len(edges):
        return 0.0 * vertices.sum()
    start, end, a, b = (vertices[index] for index in (*edges.unbind(1), *opposite.unbind(1)))
    (first, first_is_flat), (second, second_is_flat) = (_unit_normals(end - start, apex - start) for apex in (a, b))
    cosines = torch.where(first_is_flat | second_is_flat, 0.0, -(first * second).sum(1))
    return (1.0 - cosines).mean()


def _unit_normals(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Return the normals ``(N, 3)`` of triangles with edges u and v, and whether they have no area ``(N,)``.

    A triangle without area has another normal, without a gradient.
    """
    with torch.no_grad():  # in units of the triangle: a square of small numbers would be 0
        size = torch.cat((u, v), 1).abs().amax(1, keepdim=True)
        size = torch.where(size > 0, size, 1.0)
    u, v = u / size, v / size
    normals = torch.linalg.cross(u, v)
    with torch.no_grad():
        longest = torch.stack([edge.square().sum(1) for edge in (u, v, v - u)]).amax(0)
        twice_areas = torch.linalg.vector_norm(normals, dim=1)
        is_flat = twice_areas <= _FLAT_FACE * torch.finfo(u.dtype).eps * longest
    normals = torch.where(is_flat[:, None], torch.ones_like(normals), normals)
    return normals / torch.linalg.vector_norm(normals, dim=1, keepdim=True), is_flat
