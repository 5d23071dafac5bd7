"""Losses of meshes against closed forms and against loops over vertices, edges and faces."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.core.errors import SceneError
from torchpt.losses import mesh_edge_loss, mesh_laplacian_smoothing, mesh_normal_consistency
from torchpt.math.laplacian import cotangent_weights, mesh_edges

#: A regular tetrahedron with edges of length 2 sqrt(2), and an octahedron with edges of length sqrt(2).
TETRAHEDRON = (
    torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]),
    torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
)
OCTAHEDRON = (
    torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]),
    torch.tensor([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]),
)


def grid(n: int) -> tuple[Tensor, Tensor]:
    """Return a flat grid of n x n vertices, its squares split along one diagonal."""
    y, x = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
    vertices = torch.stack((x, y, torch.zeros_like(x)), 2).reshape(-1, 3).float()
    corner = (torch.arange(n - 1)[:, None] * n + torch.arange(n - 1)).reshape(-1)
    faces = torch.cat(
        (torch.stack((corner, corner + 1, corner + n + 1), 1), torch.stack((corner, corner + n + 1, corner + n), 1))
    )
    return vertices, faces


def bumpy() -> tuple[Tensor, Tensor]:
    vertices, faces = grid(5)
    return vertices.double() + 0.3 * torch.randn(25, 3, generator=torch.Generator().manual_seed(3)).double(), faces


def edges_by_loop(faces: Tensor) -> list[tuple[int, int]]:
    return sorted({(min(p), max(p)) for face in faces.tolist() for p in itertools.combinations(face, 2)})


def test_edge_lengths_of_regular_bodies() -> None:
    assert float(mesh_edge_loss(*TETRAHEDRON)) == pytest.approx(8.0)
    assert float(mesh_edge_loss(*OCTAHEDRON, target_length=1.0)) == pytest.approx((math.sqrt(2.0) - 1.0) ** 2)
    vertices, faces = bumpy()
    expected = [float((vertices[i] - vertices[j]).norm() - 0.5) ** 2 for i, j in edges_by_loop(faces)]
    assert float(mesh_edge_loss(vertices, faces, 0.5)) == pytest.approx(sum(expected) / len(expected))


@pytest.mark.parametrize("method", ["uniform", "cot"])
def test_smoothing_of_regular_bodies(method: str) -> None:
    """Neighbours of a vertex of a tetrahedron have their mean at -1/3 of it, those of an octahedron at 0."""
    assert float(mesh_laplacian_smoothing(*TETRAHEDRON, method)) == pytest.approx(4.0 / 3.0 * math.sqrt(3.0))
    assert float(mesh_laplacian_smoothing(*OCTAHEDRON, method)) == pytest.approx(1.0)


def offsets(vertices: Tensor, faces: Tensor, method: str) -> Tensor:
    """Return each vertex's way to the weighted mean of its neighbours, by a loop over edges."""
    edges = mesh_edges(faces)
    weights = cotangent_weights(vertices, faces, edges).tolist() if method == "cot" else [1.0] * len(edges)
    sums, total = torch.zeros_like(vertices), torch.zeros(len(vertices), 1, dtype=vertices.dtype)
    for (i, j), weight in zip(edges.tolist(), weights, strict=True):
        for a, b in ((i, j), (j, i)):
            sums[a] += weight * vertices[b]
            total[a] += weight
    return sums / total - vertices


@pytest.mark.parametrize("method", ["uniform", "cot"])
def test_smoothing_is_the_mean_of_offsets(method: str) -> None:
    vertices, faces = bumpy()
    expected = offsets(vertices, faces, method).norm(dim=1).mean()
    torch.testing.assert_close(mesh_laplacian_smoothing(vertices, faces, method), expected)


def test_inside_a_plane_cotangents_leave_vertices_where_they_are() -> None:
    vertices, faces = grid(5)
    vertices = vertices.double()
    vertices[12, 0] += 0.3
    inside = torch.tensor([6, 7, 8, 11, 12, 13, 16, 17, 18])
    assert float(offsets(vertices, faces, "cot")[inside].abs().max()) < 1e-9
    assert float(offsets(vertices, faces, "uniform")[12].abs().max()) == pytest.approx(0.3)


def test_cotangents_are_those_of_angles() -> None:
    vertices, faces = bumpy()
    expected = dict.fromkeys(edges_by_loop(faces), 0.0)
    for face in faces.tolist():
        for k in range(3):
            a, b, c = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
            u, v = vertices[b] - vertices[a], vertices[c] - vertices[a]
            angle = math.acos(float(u @ v / u.norm() / v.norm()))
            expected[min(b, c), max(b, c)] += 1.0 / math.tan(angle)
    found = cotangent_weights(vertices, faces, mesh_edges(faces))
    assert found.tolist() == pytest.approx(list(expected.values()))


def test_normals_of_regular_bodies() -> None:
    """Normals of neighbouring faces: cos = -1/3 on a tetrahedron, 1/3 on an octahedron, 1 in a plane."""
    assert float(mesh_normal_consistency(*TETRAHEDRON)) == pytest.approx(4.0 / 3.0)
    assert float(mesh_normal_consistency(*OCTAHEDRON)) == pytest.approx(2.0 / 3.0)
    vertices, faces = grid(4)
    assert float(mesh_normal_consistency(vertices, faces)) == pytest.approx(0.0, abs=1e-6)
    faces[3] = faces[3].flip(0)  # another order of vertices is the same face
    assert float(mesh_normal_consistency(vertices, faces)) == pytest.approx(0.0, abs=1e-6)


def test_an_edge_of_three_faces_has_three_pairs() -> None:
    """Three half-planes at 0, 90 and 180 degrees about the z axis."""
    vertices = torch.tensor([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    assert float(mesh_normal_consistency(vertices, faces)) == pytest.approx((1.0 + 1.0 + 0.0) / 3.0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("scale", [1.0, 1e-12, 1e12])
@pytest.mark.parametrize("corner", [[2.0, 0, 0], [1.0, 0, 0], [0.3, 1e-17, 0], [0.3, 0, 1e-17]], ids=str)
def test_a_face_without_area_is_perpendicular_and_has_no_gradient(
    dtype: torch.dtype, scale: float, corner: list[float]
) -> None:
    """Of the two pairs one is in a plane, the other has a face whose corners are on a line, within rounding."""
    points = [[0.0, 0, 0], [1, 0, 0], corner, [0, 1, 0], [-1, 1, 0]]
    vertices = (scale * torch.tensor(points, dtype=dtype)).requires_grad_()
    faces = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 3, 4]])
    loss = mesh_normal_consistency(vertices, faces)
    (gradient,) = torch.autograd.grad(loss, vertices)
    assert float(loss.detach()) == pytest.approx(0.5)
    assert float(scale * gradient.abs().max()) < 10.0 and not bool(gradient[2].any())


def test_the_consistency_of_normals_has_no_unit_of_length() -> None:
    vertices, faces = bumpy()
    expected = mesh_normal_consistency(vertices, faces)
    for scale in (1e-15, 1e-4, 1e15):
        torch.testing.assert_close(
            mesh_normal_consistency(scale * vertices.float(), faces).double(), expected, rtol=1e-4, atol=0
        )
    assert bool(mesh_normal_consistency(vertices * torch.nan, faces).isnan())


@pytest.mark.parametrize(
    "loss", [mesh_edge_loss, mesh_normal_consistency, mesh_laplacian_smoothing], ids=lambda loss: loss.__name__
)
def test_gradients(loss: Any) -> None:
    vertices, faces = bumpy()
    torch.autograd.gradcheck(lambda x: loss(x, faces), vertices.requires_grad_())
    flat = grid(3)[0].requires_grad_()
    loss(flat, grid(3)[1]).backward()
    assert flat.grad is not None and bool(torch.isfinite(flat.grad).all())
    none = torch.zeros(0, 3, dtype=torch.int64)
    alone = torch.rand(4, 3, requires_grad=True)
    loss(alone, none).backward()
    assert alone.grad is not None and not bool(alone.grad.any())


@pytest.mark.parametrize(
    ("vertices", "faces", "error", "says"),
    [
        (torch.zeros(4, 3, dtype=torch.int64), TETRAHEDRON[1], TypeError, "vertices: expected a tensor of floating"),
        (TETRAHEDRON[0], TETRAHEDRON[1].float(), TypeError, "faces: expected a tensor of whole numbers"),
        (TETRAHEDRON[0], [[0, 1, 2]], TypeError, "faces: expected a tensor of whole numbers, got list"),
        (TETRAHEDRON[0][:, :2], TETRAHEDRON[1], ValueError, r"vertices: expected shape \(N, 3\), got \(4, 2\)"),
        (TETRAHEDRON[0][:3], TETRAHEDRON[1], ValueError, r"expected indices of vertices in 0..2, got 0..3"),
    ],
)
def test_meshes_that_are_refused(vertices: Any, faces: Any, error: type[Exception], says: str) -> None:
    for loss in (mesh_edge_loss, mesh_laplacian_smoothing, mesh_normal_consistency):
        with pytest.raises(error, match=says) as refused:
            loss(vertices, faces)
        assert isinstance(refused.value, SceneError)
    with pytest.raises(ValueError, match="method: expected uniform or cot, got 'cotan'"):
        mesh_laplacian_smoothing(*TETRAHEDRON, method="cotan")


@pytest.mark.parametrize(
    ("length", "error"),
    [
        (None, TypeError),
        ("x", TypeError),
        (True, TypeError),
        (torch.ones(6), TypeError),
        (torch.nan, ValueError),
        (torch.inf, ValueError),
        (-1.0, ValueError),
        (torch.tensor(torch.nan), ValueError),
    ],
    ids=str,
)
def test_lengths_that_are_refused(length: Any, error: type[Exception]) -> None:
    with pytest.raises(error, match=r"^target_length: expected a finite number >= 0.*, got ") as refused:
        mesh_edge_loss(*TETRAHEDRON, target_length=length)
    assert isinstance(refused.value, SceneError) and "\n" not in str(refused.value)


def test_a_length_may_be_a_tensor_of_one_number() -> None:
    length = torch.tensor([1.0], requires_grad=True)
    mesh_edge_loss(*OCTAHEDRON, target_length=length).backward()
    assert float(length.grad) == pytest.approx(-2.0 * (math.sqrt(2.0) - 1.0))  # type: ignore[arg-type]
    lengths = torch.tensor([0.0, 1.0])
    found = torch.func.vmap(lambda length: mesh_edge_loss(*OCTAHEDRON, target_length=length))(lengths)
    torch.testing.assert_close(found, (math.sqrt(2.0) - lengths).square())


def test_a_scene_has_the_faces_of_its_meshes() -> None:
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 0, 4], "target": [0, 0, 0]},
            "shapes": {
                "t": {"type": "mesh", "vertices": TETRAHEDRON[0].tolist(), "faces": TETRAHEDRON[1].tolist()},
                "ball": {"type": "sphere"},
            },
            "lights": {"sky": {"type": "constant"}},
        },
        "cpu",
    )
    name = "shapes.t.vertices"
    assert torch.equal(scene.faces(name), TETRAHEDRON[1]) and torch.equal(scene.faces("shapes.t"), TETRAHEDRON[1])
    assert float(mesh_edge_loss(scene.params[name], scene.faces(name))) == pytest.approx(8.0)
    with pytest.raises(SceneError, match=r"name: expected one of shapes.t, got 'shapes.ball'"):
        scene.faces("shapes.ball")
