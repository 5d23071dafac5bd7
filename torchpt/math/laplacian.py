"""Edges and Laplacians of triangle meshes, and a solver for ``(I + λ L) x = b``.

A mesh has V vertices and F triangles ``faces (F, 3)``. The combinatorial Laplacian is ``L = D - A``: A has a 1 for each pair of
vertices with a common edge, the diagonal matrix D their numbers.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.core.errors import ArgumentValueError

__all__ = ["TOLERANCE", "LaplacianSystem", "adjacent_faces", "cotangent_weights", "mesh_edges", "neighbour_sums"]

#: Largest residual of a solution, relative to the right side.
TOLERANCE = 1e-10
#: Iterations between two checks of the residual, each of which waits for a GPU.
CHECK_EVERY = 16
#: Smallest area of a face in cotangents, over the square of its longest edge.
SMALLEST_AREA = 1e-12


def mesh_edges(faces: Tensor) -> Tensor:
    """Return the edges of a mesh, each once: indices of vertices ``(E, 2)`` int64, the smaller first."""
    pairs = torch.cat((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])).long()
    return torch.unique(pairs.sort(1).values, dim=0)


def neighbour_sums(edges: Tensor, values: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the sum of the neighbours' values ``(V, C)`` at each vertex, times the weights ``(E,)`` of edges."""
    i, j = edges.unbind(1)
    to_i, to_j = values[j], values[i]
    if weights is not None:
        to_i, to_j = to_i * weights[:, None], to_j * weights[:, None]
    return torch.zeros_like(values).index_add(0, i, to_i).index_add(0, j, to_j)


def cotangent_weights(vertices: Tensor, faces: Tensor, edges: Tensor) -> Tensor:
    """Return ``cot a + cot b`` of each edge ``(E,)``, with a and b the angles opposite to it, without gradients.

    Pinkall and Polthier, *Computing Discrete Minimal Surfaces and Their Conjugates* (1993), eq. 3, without their factor 1/2.
    """
    with torch.no_grad():
        corners = vertices[faces.long()]  # (F, 3, 3)
        e = [corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3] for k in range(3)]  # opposite to corner k
        squares = torch.stack([x.square().sum(1) for x in e])
        areas = 0.5 * torch.linalg.vector_norm(torch.linalg.cross(e[0], e[1]), dim=1)
        areas = torch.maximum(areas, SMALLEST_AREA * squares.amax(0)).clamp(min=torch.finfo(areas.dtype).tiny)
        found = vertices.new_zeros(len(edges))
        for k in range(3):
            # cos a = (b^2 + c^2 - a^2) / 2bc and sin a = 2 area / bc
            cotangent = (squares[(k + 1) % 3] + squares[(k + 2) % 3] - squares[k]) / (4.0 * areas)
            pair = torch.stack((faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]), 1).long()
            found.index_add_(0, _edge_numbers(edges, pair), cotangent)
    return found


def adjacent_faces(faces: Tensor) -> tuple[Tensor, Tensor]:
    """Return the pairs of faces with a common edge.

    Returns:
        Edge of each pair ``(P, 2)``, and the vertices of its two faces opposite to it ``(P, 2)``. An edge of k faces has
        k (k - 1) / 2 pairs.
    """
    pairs = torch.cat((faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]])).long()
    opposite = torch.cat((faces[:, 0], faces[:, 1], faces[:, 2])).long()
    edges, number = torch.unique(pairs.sort(1).values, dim=0, return_inverse=True)
    order = torch.argsort(number, stable=True)
    number, opposite = number[order], opposite[order]
    found_edges, found_opposite = [edges[:0]], [edges[:0]]
    # In the order of edges, faces of one edge are neighbours: at distance 1 for two, at 1 and 2 for three, and so on.
    for distance in range(1, len(faces)):
        alike = number[distance:] == number[:-distance]
        if not bool(alike.any()):
            break
        found_edges.append(edges[number[distance:][alike]])
        found_opposite.append(torch.stack((opposite[:-distance][alike], opposite[distance:][alike]), 1))
    return torch.cat(found_edges), torch.cat(found_opposite)


def _edge_numbers(edges: Tensor, pairs: Tensor) -> Tensor:
    """Return the number ``(N,)`` of each pair of vertices ``(N, 2)`` among sorted edges."""
    size = int(edges.max()) + 1 if len(edges) else 1
    low, high = pairs.sort(1).values.unbind(1)
    return torch.searchsorted(edges[:, 0] * size + edges[:, 1], low * size + high)


def _sparse_system(edges: Tensor, degrees: Tensor, weight: float) -> Tensor | None:
    """Return ``I + λ L`` as a sparse matrix; None where this build of torch cannot multiply by one."""
    count = len(degrees)
    diagonal = torch.arange(count, device=edges.device)
    rows, columns = torch.cat((diagonal, edges[:, 0], edges[:, 1])), torch.cat((diagonal, edges[:, 1], edges[:, 0]))
    values = torch.cat((1.0 + weight * degrees, degrees.new_full((2 * len(edges),), -weight)))
    order = torch.argsort(rows * count + columns)
    ends = torch.bincount(rows, minlength=count).cumsum(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch calls its CSR matrices beta
        try:
            matrix = torch.sparse_csr_tensor(
                torch.cat((ends.new_zeros(1), ends)),
                columns[order],
                values[order],
                (count, count),
                check_invariants=False,
            )
            _ = matrix @ values.new_zeros(count, 3)
        except RuntimeError:
            return None
    return matrix


@dataclass(frozen=True)
class LaplacianSystem:
    """The matrix ``I + λ L`` of a mesh, with the combinatorial Laplacian L.

    It is symmetric, and no eigenvalue is below 1, so conjugate gradients converge in some ``sqrt(1 + 2 λ d)`` iterations times
    the digits wanted, with d the largest number of neighbours.

    Attributes:
        edges: ``(E, 2)`` int64.
        degrees: number of neighbours ``(V,)`` float64.
        weight: λ.
        matrix: the matrix ``(V, V)``, sparse (CSR) and float64; None where this build of torch multiplies none.
    """

    edges: Tensor
    degrees: Tensor
    weight: float
    matrix: Tensor | None

    @classmethod
    def of(cls, edges: Tensor, vertices: int, weight: float) -> LaplacianSystem:
        """Return the system of a mesh by its edges, number of vertices and λ."""
        degrees = torch.bincount(edges.reshape(-1), minlength=vertices).double()
        return cls(edges, degrees, weight, _sparse_system(edges, degrees, weight))

    def apply(self, x: Tensor) -> Tensor:
        """Return ``(I + λ L) x`` of ``x (V, C)``."""
        degrees = self.degrees.to(x)[:, None]
        return x + self.weight * (degrees * x - neighbour_sums(self.edges, x))

    def solve(self, b: Tensor, key: str) -> Tensor:
        """Return ``(I + λ L)^-1 b`` of ``b (V, C)``, in the dtype of ``b``, computed in float64; ``key``: its name in errors.

        Derivatives of both modes and of all orders, and ``vmap``, go through it.

        Raises:
            SceneError: ``b`` is not finite; also a ``ValueError``.
            RuntimeError: λ is so large that the solution is lost in rounding.
        """
        solution = _Solve.apply(self, b, key)
        assert isinstance(solution, Tensor)
        return solution

    def _conjugate_gradients(self, b: Tensor, key: str) -> Tensor:
        """Solve by conjugate gradients with the diagonal as preconditioner, each column on its own."""
        finite = torch.isfinite(b)
        if not bool(finite.all()):
            raise ArgumentValueError(key, float(b[~finite][0]), "finite numbers")
        b64 = b.double()
        inverse_diagonal = 1.0 / (1.0 + self.weight * self.degrees)[:, None]
        x = torch.zeros_like(b64)
        residual = b64.clone()
        z = inverse_diagonal * residual
        direction, rz = z, (residual * z).sum(0)
        threshold = TOLERANCE * torch.linalg.vector_norm(b64, dim=0)
        for iteration in range(1, 10 * len(b) + CHECK_EVERY + 1):
            image = self.apply(direction) if self.matrix is None else self.matrix @ direction
            curvature = (direction * image).sum(0)
            step = torch.where(curvature > 0, rz / curvature, 0.0)  # 0 once a column is solved exactly
            x = x + step * direction
            residual = residual - step * image
            if iteration % CHECK_EVERY == 0 and bool((torch.linalg.vector_norm(residual, dim=0) <= threshold).all()):
                return x.to(b)
            z = inverse_diagonal * residual
            before, rz = rz, (residual * z).sum(0)
            direction = z + torch.where(before > 0, rz / before, 0.0) * direction
        raise RuntimeError(
            f"conjugate gradients did not converge for {len(b)} vertices and a weight of {self.weight:g}"
        )


class _Solve(torch.autograd.Function):
    """``(I + λ L)^-1 b``: linear, so its derivative is the same solve, in both modes as the matrix is symmetric."""

    @staticmethod
    def forward(system: LaplacianSystem, b: Tensor, key: str) -> Tensor:
        return system._conjugate_gradients(b, key)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[LaplacianSystem, Tensor, str], output: Tensor) -> None:
        ctx.system, _, ctx.key = inputs

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[None, Tensor, None]:
        return None, ctx.system.solve(cotangents[0], f"gradient of the solution of {ctx.key}"), None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        return ctx.system.solve(tangents[1], f"tangent of {ctx.key}")

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Tensor, int]:
        system, b, key = args
        columns = b.movedim(in_dims[1], -1)  # (V, C, B)
        return system.solve(columns.flatten(1), key).reshape(columns.shape), 2
