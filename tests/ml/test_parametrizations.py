"""Poses by axis and angle, quaternions and two points, and the vertices of large steps, with their gradients."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
import torch
import trimesh
from torch import Tensor

import torchpt
from torchpt.core.errors import SceneError
from torchpt.math.transforms import compose, look_at
from torchpt.nn import (
    AdamUniform,
    AxisAnglePose,
    LargeSteps,
    LookAtPose,
    QuaternionPose,
    Renderer,
    axis_angle_pose,
    look_at_pose,
    quaternion_pose,
)

POSES = [AxisAnglePose, QuaternionPose, LookAtPose]
#: A strip of four triangles and a vertex of no face.
STRIP = torch.tensor([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])


def scene() -> torchpt.Scene:
    return torchpt.load(
        {
            "camera": {"origin": [0.0, 1.0, 4.0], "target": [0.0, 0.0, 0.0], "fov": 40.0},
            "film": {"width": 12, "height": 12},
            "shapes": {
                "box": {
                    "type": "cube",
                    "transform": [{"scale": [0.5, 0.3, 0.4]}, {"rotate": {"axis": [0, 1, 0], "angle": 20}}],
                },
                "floor": {
                    "type": "rectangle",
                    "transform": [{"scale": 3}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
                },
            },
            "lights": {"lamp": {"type": "point", "position": [1.0, 3.0, 2.0], "intensity": 20.0}},
        },
        "cpu",
    )


def drawn(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)), dtype=torch.float64)


# ---- Functions: absolute poses


def test_rotations_are_those_of_scene_files() -> None:
    axis, angle, position = [1.0, 2.0, -0.5], 70.0, [0.3, -1.0, 2.0]
    written = [{"rotate": {"axis": axis, "angle": angle}}, {"translate": position}]
    expected = torch.from_numpy(compose(written))
    unit, radians = (
        torch.tensor(axis).double() / torch.tensor(axis).double().norm(),
        torch.tensor(angle).double().deg2rad(),
    )
    place = torch.tensor(position).double()
    torch.testing.assert_close(axis_angle_pose(unit * radians, place), expected)
    quaternion = 3.0 * torch.cat(((radians / 2).cos()[None], (radians / 2).sin() * unit))
    torch.testing.assert_close(quaternion_pose(quaternion, place), expected)


def test_a_look_at_is_that_of_a_camera_in_a_scene_file() -> None:
    made = look_at_pose(torch.tensor([0.0, 1.0, 4.0]), torch.zeros(3))
    torch.testing.assert_close(made, scene().params["camera.to_world"])
    origin, target, up = drawn(3, 3)
    expected = torch.from_numpy(look_at(origin.tolist(), target.tolist(), up.tolist()))
    torch.testing.assert_close(look_at_pose(origin, target, up), expected)


@pytest.mark.parametrize(("make", "numbers"), [(axis_angle_pose, 3), (quaternion_pose, 4), (look_at_pose, 3)])
def test_batches_of_poses_and_their_gradients(make: Any, numbers: int) -> None:
    first, second = drawn(2, 5, numbers), drawn(5, 3)
    poses = make(first, second)
    assert poses.shape == (2, 5, 4, 4)
    torch.testing.assert_close(poses[1, 3], make(first[1, 3], second[3]))
    torch.testing.assert_close(poses[..., :3, :3] @ poses[..., :3, :3].mT, torch.eye(3).double().expand(2, 5, 3, 3))
    torch.autograd.gradcheck(make, (first[0, :2].requires_grad_(), second[:2].requires_grad_()))


def test_rotation_by_nothing_has_a_gradient() -> None:
    torch.autograd.gradcheck(axis_angle_pose, (torch.zeros(3).double().requires_grad_(), drawn(3)))


def test_gradients_reach_the_point_that_a_camera_looks_at() -> None:
    own, target = scene(), torch.tensor([0.2, 0.1, 0.0], requires_grad=True)
    origin = torch.tensor([0.0, 1.0, 4.0], requires_grad=True)
    made = torchpt.render(own, params={"camera.to_world": look_at_pose(origin, target)}, spp=4)
    made.square().mean().backward()
    assert target.grad is not None and bool(target.grad.any()) and origin.grad is not None and bool(origin.grad.any())
    poses = look_at_pose(torch.tensor([[0.0, 1.0, 4.0], [1.0, 1.0, 4.0]]), torch.zeros(3))
    assert torchpt.render_batch(own, poses, spp=1).shape == (1, 2, 12, 12, 3)


def test_poses_of_lists_and_of_mixed_types() -> None:
    made = look_at_pose([0, 1, 4], (0, 0, 0))
    assert made.dtype is torch.float32 and torch.equal(
        made, look_at_pose(torch.tensor([0.0, 1.0, 4.0]), torch.zeros(3))
    )
    assert axis_angle_pose(torch.zeros(3), torch.zeros(3).double()).dtype is torch.float64
    assert quaternion_pose(torch.tensor([1, 0, 0, 0]), [0.5, 0.0, 0.0]).dtype is torch.float32
    assert look_at_pose(torch.zeros(2, 3), [0, 0, 1], drawn(4, 1, 3)).shape == (4, 2, 4, 4)
    height = torch.tensor(1.0, requires_grad=True)
    look_at_pose([0.0, height, 4.0], [0, 0, 0]).sum().backward()
    assert height.grad is not None and float(height.grad) != 0.0
    compiled = torch.compile(look_at_pose, backend="eager", fullgraph=True)
    assert torch.equal(compiled(torch.tensor([0.0, 1.0, 4.0]), [0, 0, 0]), made)


WRONG_POSES: dict[str, tuple[Any, tuple[Any, ...], str]] = {
    "no way": (look_at_pose, ([0, 0, 0], [0, 0, 0]), "^target: expected a point other than the origin, got"),
    "parallel": (
        look_at_pose,
        ([0, 0, 0], [0, 2, 0]),
        r"^up: expected a direction that is not parallel .* \[0.0, 1.0, 0.0\]",
    ),
    "no up": (look_at_pose, ([0, 0, 0], [0, 0, 1], [0, 0, 0]), "^up: expected a direction"),
    "one of many": (
        quaternion_pose,
        (torch.eye(5)[:, :4], [0, 0, 0]),
        "^quaternion: expected numbers that are not all 0",
    ),
    "shape": (
        quaternion_pose,
        ([0, 0, 1], [0, 0, 0]),
        r"^quaternion: expected numbers of shape \(..., 4\), got \(3,\)",
    ),
    "batches": (axis_angle_pose, (torch.zeros(2, 3), torch.zeros(3, 3)), "^rotation, position: expected shapes that"),
    "text": (axis_angle_pose, ("abc", [0, 0, 0]), r"^rotation: expected numbers of shape \(..., 3\), got 'abc'"),
    "rags": (axis_angle_pose, ([0, 0, 0], [[0, 0], [0, 0, 0]]), "^position: expected numbers"),
    "not finite": (axis_angle_pose, ([0, 0, 0], [0, torch.nan, 0]), "^position: expected finite numbers, got"),
}


@pytest.mark.parametrize("case", WRONG_POSES)
def test_poses_that_are_none(case: str) -> None:
    make, arguments, says = WRONG_POSES[case]
    with pytest.raises(SceneError, match=says):
        make(*arguments)


# ---- Parametrizations: poses relative to the initial one


@pytest.mark.parametrize("aim", [[0, 1, 0], [0, -1, 0], [0, 0, 0], [1e-8, 1, 0]])
def test_a_look_at_along_up_and_at_itself_is_a_pose(aim: list[float]) -> None:
    start = torch.eye(4).double()
    kind = LookAtPose(start, 2.0)
    x = torch.tensor([0.5, 0.0, 0.0, *aim], dtype=torch.float64)
    x[3] += 0.5
    pose = kind(x.requires_grad_())
    torch.testing.assert_close(pose[:3, :3] @ pose[:3, :3].T, torch.eye(3).double())
    pose.sum().backward()
    assert x.grad is not None and bool(x.grad.isfinite().all())
    torch.testing.assert_close(kind(kind.inverse(pose.detach())), pose.detach())


def test_a_quaternion_of_zeros_turns_nothing() -> None:
    start = scene().params["camera.to_world"]
    x = torch.zeros(7, requires_grad=True)
    pose = QuaternionPose(start, 2.0)(x)
    torch.testing.assert_close(pose[:3, :3], start[:3, :3])
    pose.sum().backward()
    assert x.grad is not None and bool(x.grad.isfinite().all())


@pytest.mark.parametrize("kind", POSES)
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_pose_comes_back_and_keeps_its_scale(kind: Any, mirrored: bool) -> None:
    start = axis_angle_pose(drawn(3), drawn(1, 3)[0])
    start[:3, :3] = start[:3, :3] @ torch.diag(torch.tensor([-2.0 if mirrored else 2.0, 0.5, 1.5]).double())
    found = kind(start, 4.0)
    x = found.inverse(start)
    torch.testing.assert_close(found(x), start)
    moved = found(x + 0.1 * drawn(len(x)))
    torch.testing.assert_close(found(found.inverse(moved)), moved)
    torch.testing.assert_close(torch.linalg.svdvals(moved[:3, :3]), torch.linalg.svdvals(start[:3, :3]))
    assert bool(torch.linalg.det(moved[:3, :3]) < 0) is mirrored
    torch.autograd.gradcheck(found, x.requires_grad_())


def test_a_look_at_keeps_its_point_and_does_not_roll() -> None:
    start = scene().params["camera.to_world"].double()
    found = LookAtPose(start, 2.0)
    x = found.inverse(start)
    torch.testing.assert_close(2.0 * x[3:], start[:3, 3] + 2.0 * start[:3, 2])
    pose = found(torch.cat((x[:3] + drawn(3), x[3:])))  # moved around the point
    to_point = 2.0 * x[3:] - pose[:3, 3]
    torch.testing.assert_close(pose[:3, 2], to_point / to_point.norm())
    assert abs(float(pose[:3, 0] @ start[:3, 1])) < 1e-9  # left is level
    rolled = start @ torch.from_numpy(compose([{"rotate": {"axis": [0, 0, 1], "angle": 10}}]))
    with pytest.raises(ValueError, match="without roll"):
        found.inverse(rolled)


@pytest.mark.parametrize("kind", POSES)
def test_a_renderer_finds_a_camera(kind: Any) -> None:
    own = scene()
    target = torchpt.render(own, spp=64, seed=9)
    shifted = look_at_pose(torch.tensor([0.4, 1.3, 4.3]), torch.tensor([0.25, 0.1, 0.0]))
    own.params["camera.to_world"] = shifted
    renderer = Renderer(own, "camera.to_world", parametrizations={"camera.*": kind}, spp=16)
    assert isinstance(renderer.ranges[0], kind)
    torch.testing.assert_close(renderer.values()["camera.to_world"].detach(), shifted)
    optimizer = torch.optim.Adam(renderer.parameters(), lr=1e-2)
    losses = []
    for _ in range(20):
        optimizer.zero_grad()
        loss = torchpt.losses.l2(renderer(), target)
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert sum(losses[-3:]) < 0.3 * sum(losses[:3])
    with pytest.raises(SceneError, match=r"params.camera.to_world: expected the pose at first"):
        renderer.assign({"camera.to_world": torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0]))})


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (3, "parametrizations: expected a mapping from names or patterns"),
        ({"shapes.*": QuaternionPose}, "parametrizations: expected one of camera.to_world, camera.fov, or a pattern"),
        (
            {"camera.fov": QuaternionPose},
            "parametrizations.camera.fov: expected a parametrization of values that are no",
        ),
        (
            {"camera.fov": lambda start, length: start},
            "parametrizations.camera.fov: expected a torchpt.nn.Parametrization",
        ),
        ({"camera.fov": LargeSteps(STRIP)}, r"params.camera.fov: expected vertices \(V, 3\) of the mesh"),
        ({"camera.to_world": LargeSteps(STRIP)}, r"params.camera.to_world: expected vertices \(V, 3\) of the mesh"),
    ],
)
def test_parametrizations_that_are_refused(given: Any, says: str) -> None:
    with pytest.raises(SceneError, match=says) as error:
        Renderer(scene(), ["camera.to_world", "camera.fov"], parametrizations=given)
    assert "\n" not in str(error.value)


# ---- Large steps


def dense(faces: Tensor, count: int, weight: float) -> Tensor:
    """Return ``I + λ L`` by a loop over edges."""
    matrix = torch.eye(count).double()
    for i, j in {(min(a, b), max(a, b)) for f in faces.tolist() for a, b in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))}:
        matrix[i, i] += weight
        matrix[j, j] += weight
        matrix[i, j] -= weight
        matrix[j, i] -= weight
    return matrix


@pytest.mark.parametrize("weight", [0.0, 1.0, 19.0, 1000.0])
def test_large_steps_solve_their_system(weight: float) -> None:
    steps, vertices, matrix = LargeSteps(STRIP, weight), drawn(7, 3), dense(STRIP, 7, weight)
    x = steps.inverse(vertices)
    torch.testing.assert_close(x, matrix @ vertices)
    torch.testing.assert_close(steps(x), vertices)
    torch.testing.assert_close(steps(x)[6], x[6])  # the vertex of no face
    torch.testing.assert_close(steps(x.float()).double(), vertices, rtol=1e-4, atol=1e-4)
    cotangent = drawn(3, 7).T
    (gradient,) = torch.autograd.grad(steps(x.requires_grad_()), x, cotangent)
    torch.testing.assert_close(gradient, torch.linalg.solve(matrix, cotangent))


def test_large_steps_of_a_finer_mesh_and_second_derivatives() -> None:
    n = 20
    corner = (torch.arange(n - 1)[:, None] * n + torch.arange(n - 1)).reshape(-1)
    lower, upper = (corner, corner + 1, corner + n + 1), (corner, corner + n + 1, corner + n)
    faces = torch.cat((torch.stack(lower, 1), torch.stack(upper, 1)))
    steps, x = LargeSteps(faces), drawn(n * n, 3)
    torch.testing.assert_close(steps(x), torch.linalg.solve(dense(faces, n * n, 19.0), x))
    small = LargeSteps(STRIP, 2.0)
    torch.autograd.gradcheck(small, drawn(6, 3).requires_grad_())
    torch.autograd.gradgradcheck(lambda x: small(x).square(), drawn(6, 3).requires_grad_())


def test_without_a_sparse_product_the_solution_is_the_same(monkeypatch: Any) -> None:
    x, usual = drawn(7, 3), LargeSteps(STRIP)
    monkeypatch.setattr("torchpt.math.laplacian._sparse_system", lambda *_: None)
    torch.testing.assert_close(LargeSteps(STRIP)(x), usual(x))


def test_a_renderer_with_large_steps() -> None:
    """A gradient at one vertex moves its neighbours too, by less the farther they are."""
    own = torchpt.load(
        {
            "camera": {"origin": [0, 0, 4], "target": [0, 0, 0]},
            "film": {"width": 8, "height": 8},
            "shapes": {
                "m": {"type": "mesh", "faces": STRIP.tolist(), "vertices": [[k // 2, k % 2, 0] for k in range(6)]}
            },
            "lights": {"sky": {"type": "constant"}},
        },
        "cpu",
    )
    name = "shapes.m.vertices"
    renderer = Renderer(own, name, parametrizations={name: LargeSteps(own.faces(name), 5.0)}, spp=1)
    torch.testing.assert_close(renderer.values()[name].detach(), own.params[name])
    assert list(renderer.state_dict()) == ["steps", "free.shapes/m/vertices"]
    for other in (copy.deepcopy(renderer), pickle.loads(pickle.dumps(renderer))):
        assert torch.equal(other(seed=1), renderer(seed=1))
    optimizer = torch.optim.SGD(renderer.parameters(), lr=1.0)
    renderer.values()[name][0, 2].backward()
    optimizer.step()
    moved = own.params[name][:, 2] - renderer.values()[name].detach()[:, 2]
    assert float(moved[0]) > float(moved[2]) > float(moved[4]) > 0.0
    with pytest.raises(SceneError, match=rf"^parametrizations.{name}.lambda_: expected at most .*, got 1e\+30"):
        Renderer(own, name, parametrizations={name: LargeSteps(own.faces(name), 1e30)})
    renderer.assign({name: own.params[name] + 0.5})
    torch.testing.assert_close(renderer.values()[name].detach(), own.params[name] + 0.5)
    assert renderer().shape == (8, 8, 3)


@pytest.mark.parametrize(
    ("faces", "weight", "error", "says"),
    [
        ([[0, 1, 2]], 1.0, TypeError, "^faces: expected a tensor of whole numbers, got 'list'"),
        (STRIP.float(), 1.0, TypeError, "^faces: expected a tensor of whole numbers, got 'torch.float32'"),
        (STRIP[:, :2], 1.0, ValueError, r"^faces: expected a tensor of shape \(F, 3\), got \(4, 2\)"),
        (STRIP - 1, 1.0, ValueError, "^faces: expected indices of vertices, from 0, got -1"),
        (STRIP, -1.0, ValueError, "^lambda_: expected a finite number >= 0, got -1.0"),
        (STRIP, "x", TypeError, "^lambda_: expected a finite number >= 0, got 'x'"),
    ],
)
def test_large_steps_that_are_refused(faces: Any, weight: float, error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says) as refused:
        LargeSteps(faces, weight)
    assert isinstance(refused.value, SceneError)


def test_large_steps_of_too_few_vertices_and_what_print_says() -> None:
    with pytest.raises(SceneError, match=r"^x: expected vertices \(V, 3\) .* V at least 6, got \(5, 3\)"):
        LargeSteps(STRIP)(torch.zeros(5, 3))
    assert repr(LargeSteps(STRIP, 4.5)) == "LargeSteps(lambda_=4.5, 9 edges)"


@pytest.mark.parametrize(
    ("x", "error", "says"),
    [
        (None, TypeError, r"^x: expected a floating tensor of vertices \(V, 3\) .* V at least 6, got 'NoneType'"),
        (torch.zeros(6, 3, dtype=torch.int64), TypeError, "^x: expected a floating tensor .*, got 'torch.int64'"),
        (torch.full((6, 3), torch.nan), ValueError, "^x: expected finite numbers, got nan"),
        (torch.full((6, 3), torch.inf), ValueError, "^x: expected finite numbers, got inf"),
    ],
    ids=["none", "whole", "nan", "inf"],
)
def test_vertices_that_are_refused(x: Any, error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says) as refused:
        LargeSteps(STRIP)(x)
    assert isinstance(refused.value, SceneError) and "\n" not in str(refused.value)
    with pytest.raises(ValueError, match=r"^vertices \(V, 3\) of the mesh"):
        LargeSteps(STRIP).inverse(None)  # type: ignore[arg-type]


def test_gradients_of_vertices_that_are_not_finite_are_an_error() -> None:
    x = drawn(6, 3).requires_grad_()
    with pytest.raises(SceneError, match="^gradient of the solution of x: expected finite numbers, got nan"):
        (LargeSteps(STRIP)(x) * torch.nan).sum().backward()


def test_a_weight_beside_which_vertices_are_lost_in_rounding_is_refused() -> None:
    """Of each dtype the largest one brings vertices back to a few parts of their size, or better."""
    vertices = drawn(6, 3) + 3.0
    for dtype, weight, error in ((torch.float32, 1.6e6, 0.5), (torch.float64, 1.9e9, 1e-4)):
        steps, own = LargeSteps(STRIP, weight), vertices.to(dtype)
        assert float((steps(steps.inverse(own)) - own).abs().max()) < error
        for call in (
            LargeSteps(STRIP, 2.0 * weight),
            LargeSteps(STRIP, 2.0 * weight).inverse,
            LargeSteps(STRIP, 1e308),
        ):
            with pytest.raises(
                ValueError, match=f"^lambda_: expected at most .* for this mesh in {dtype}, got "
            ) as refused:
                call(own)
            assert isinstance(refused.value, SceneError)
    assert torch.equal(LargeSteps(STRIP[:0], 1e30)(vertices), vertices)  # without an edge there is nothing to round


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is:DeprecationWarning")  # of torch's own jvp, at its first call
def test_large_steps_under_transforms() -> None:
    steps, matrix, batch = LargeSteps(STRIP, 5.0), dense(STRIP, 7, 5.0), drawn(4, 7, 3)
    right = torch.linalg.solve(matrix, batch)
    torch.testing.assert_close(torch.func.vmap(steps)(batch), right)
    torch.testing.assert_close(
        torch.func.vmap(steps, in_dims=2, out_dims=1)(batch.permute(1, 2, 0)), right.movedim(0, 1)
    )
    nested = torch.func.vmap(torch.func.vmap(steps))(batch.reshape(2, 2, 7, 3))
    torch.testing.assert_close(nested, right.reshape(2, 2, 7, 3))
    torch.testing.assert_close(torch.func.vmap(steps.inverse)(right), batch)
    torch.testing.assert_close(torch.func.jvp(steps, (batch[0],), (batch[1],))[1], right[1])
    jacobian = torch.einsum("ab,cd->acbd", torch.linalg.inv(matrix), torch.eye(3).double())
    torch.testing.assert_close(torch.func.jacrev(steps)(batch[0]), jacobian)
    torch.testing.assert_close(torch.func.jacfwd(steps)(batch[0]), jacobian)
    hessian = torch.func.hessian(lambda x: steps(x).square().sum())(batch[0])
    torch.testing.assert_close(hessian, 2.0 * torch.einsum("abcd,abef->cdef", jacobian, jacobian))
    with pytest.raises(SceneError, match="^x: expected finite numbers, got nan"):
        torch.func.vmap(steps)(torch.full_like(batch, torch.nan))


# ---- Adam with one scale


def test_first_steps_are_the_gradient_over_its_largest_number() -> None:
    x = torch.zeros(4, 3, dtype=torch.float64, requires_grad=True)
    gradient = drawn(4, 3)
    optimizer = AdamUniform([x], lr=0.1)
    for steps in (1, 2, 3):  # a constant gradient has both moments at once
        x.grad = gradient.clone()
        optimizer.step()
        torch.testing.assert_close(x.detach(), -0.1 * steps * gradient / gradient.abs().max())


def test_moments_are_those_of_adam() -> None:
    """Of one number it is torch's own Adam."""
    ours, theirs = (torch.tensor([2.0], dtype=torch.float64, requires_grad=True) for _ in range(2))
    for optimizer, x in ((AdamUniform([ours], lr=0.05), ours), (torch.optim.Adam([theirs], lr=0.05), theirs)):
        for _ in range(30):
            optimizer.zero_grad()
            (x**4).sum().backward()
            optimizer.step()
    torch.testing.assert_close(ours, theirs)


def test_its_state_is_saved() -> None:
    def run(x: Tensor, optimizer: AdamUniform, steps: int) -> None:
        for _ in range(steps):
            optimizer.zero_grad()
            (x - 1.0).square().sum().backward()
            optimizer.step()

    whole = torch.zeros(5, 3, requires_grad=True)
    run(whole, AdamUniform([whole]), 8)
    first = torch.zeros(5, 3, requires_grad=True)
    before = AdamUniform([first])
    run(first, before, 5)
    later = first.detach().clone().requires_grad_()
    after = AdamUniform([later])
    after.load_state_dict(copy.deepcopy(before.state_dict()))
    run(later, after, 3)
    assert torch.equal(later, whole)


@pytest.mark.parametrize(
    "wrong",
    [
        {"lr": -1.0},
        {"lr": None},
        {"lr": "x"},
        {"lr": torch.nan},
        {"lr": torch.ones(2)},
        {"betas": (0.9, 1.0)},
        {"betas": (0.9, 0.99, 0.999)},
        {"betas": (0.9, None)},
        {"betas": 0.9},
        {"betas": None},
        {"betas": "ab"},
        {"betas": torch.tensor(0.9)},
        {"eps": -1.0},
        {"eps": None},
    ],
    ids=str,
)
def test_settings_of_the_optimizer_that_are_refused(wrong: Any) -> None:
    x, other = (torch.zeros(1, requires_grad=True) for _ in range(2))
    optimizer = AdamUniform([x])
    for call in (
        lambda: AdamUniform([x], **wrong),
        lambda: AdamUniform([{"params": [x], **wrong}]),
        lambda: optimizer.add_param_group({"params": [other], **wrong}),
    ):
        with pytest.raises(ValueError, match=f"^{next(iter(wrong))}: expected ") as refused:
            call()
        assert "\n" not in str(refused.value)
    assert len(optimizer.param_groups) == 1


def test_groups_have_settings_of_their_own_and_empty_tensors_are_left_out() -> None:
    first, other, empty = (torch.zeros(n, requires_grad=True) for n in (1, 1, 0))
    optimizer = AdamUniform([{"params": [first, empty]}, {"params": [other], "lr": 0.2, "betas": [0.5, 0.9]}], lr=0.1)
    for x in (first, other, empty):
        x.grad = torch.ones_like(x)
    optimizer.step()
    assert (float(first.detach()), float(other.detach())) == pytest.approx((-0.1, -0.2))


# ---- A shape from pictures


@pytest.mark.slow
def test_large_steps_find_a_smooth_shape() -> None:
    """A ball becomes a waved ellipsoid, from three views: nearer to it than by Adam on vertices, and without its tangles."""
    ball = trimesh.creation.icosphere(2)
    points, faces = torch.from_numpy(ball.vertices.copy()).float(), torch.from_numpy(ball.faces.copy())
    wanted = points * torch.tensor([1.0, 1.25, 0.8]) * (1.0 + 0.15 * torch.sin(3.0 * points[:, :1]))
    own = torchpt.load(
        {
            "camera": {"origin": [0, 1, 4], "target": [0, 0, 0], "fov": 40.0},
            "film": {"width": 32, "height": 32},
            "integrator": {"type": "path", "max_depth": 2},
            "shapes": {"ball": {"type": "mesh", "vertices": points.numpy(), "faces": faces.numpy()}},
            "lights": {
                "lamp": {"type": "point", "position": [2, 3, 4], "intensity": 40.0},
                "sky": {"type": "constant", "radiance": 0.2},
            },
        },
        "cpu",
    )
    name, seen_from = "shapes.ball.vertices", torch.tensor([[0.0, 1.0, 4.0], [4.0, 1.0, 0.0], [-3.0, 1.0, -3.0]])
    poses = [{"camera.to_world": pose} for pose in look_at_pose(seen_from, torch.zeros(3))]
    targets = [torchpt.render(own, params={name: wanted, **pose}, spp=64, seed=5) for pose in poses]

    def fitted(optimizer: Any, rate: float, **wishes: Any) -> tuple[float, float, float]:
        """Return the last loss, the distance from the vertices wanted, and the consistency of normals."""
        renderer = Renderer(own, name, spp=8, **wishes)
        steps, total = optimizer(renderer.parameters(), lr=rate), 0.0
        for _ in range(30):
            steps.zero_grad()
            losses = [torchpt.losses.l2(renderer(pose), target) for pose, target in zip(poses, targets, strict=True)]
            sum(losses, torch.zeros(())).backward()
            steps.step()
            total = float(sum(loss.detach() for loss in losses))
        found = renderer.values()[name].detach()
        distance = (found - wanted).square().sum(1).mean().sqrt()
        return total, float(distance), float(torchpt.losses.mesh_normal_consistency(found, faces))

    _, plain_distance, plain_normals = fitted(torch.optim.Adam, 0.01)
    loss, distance, normals = fitted(AdamUniform, 0.1, parametrizations={name: LargeSteps(faces)})
    start = float((points - wanted).square().sum(1).mean().sqrt())
    assert loss < 0.6 * 3.0 * 1.36e-3 and distance < 0.85 * start and distance < 0.85 * plain_distance
    assert normals < 1.5 * float(torchpt.losses.mesh_normal_consistency(wanted, faces)) < 0.3 * plain_normals
