"""``torchpt.nn.Renderer``: ranges, seeds, state, copies, and a thousand steps."""

from __future__ import annotations

import copy
import gc
import io
import pickle
from typing import Any

import pytest
import torch
from scene_makers import room
from torch import Tensor

import torchpt
from torchpt.compiler import cpu
from torchpt.core.errors import SceneError
from torchpt.core.memory import MemoryMeter, release_memory
from torchpt.nn import Renderer
from torchpt.nn.parametrizations import AxisAnglePose, Bounded, LowerBounded, Unbounded, parametrization_of
from torchpt.spec import Angle, Color, Index, Scalar

WALL = "materials.wall.reflectance"
LAMP = "shapes.lamp.emission"
WISHES: dict[str, Any] = {"spp": 2, "threads": 1}


@pytest.fixture(scope="module")
def scene() -> torchpt.Scene:
    return torchpt.load(room(1), "cpu")


@pytest.fixture
def renderer(scene) -> Renderer:
    return Renderer(scene, [WALL, "shapes.*.emission", "camera.to_world"], **WISHES)


# -- ranges

ENDS = {
    "albedo": (Color(high=1.0), [0.0, 0.5, 1.0], Bounded),
    "albedo of a third": (Color(high=1.0), [1 / 3, 1e-6, 1 - 1e-6], Bounded),
    "radiance": (Color(), [17.0, 0.0, 1e-3], LowerBounded),
    "bright radiance": (Color(), [1e6, 2e6, 0.0], LowerBounded),
    "black radiance": (Color(), [0.0, 0.0, 0.0], LowerBounded),
    "radius": (Scalar(above=0.0), 1e-4, LowerBounded),
    "index": (Index(), 1.5, LowerBounded),
    "angle of view": (Angle(above=0.0, below=180.0), 179.0, Bounded),
    "anything": (Color(low=None), [-5.0, 0.0, 1e9], Unbounded),
}


@pytest.mark.parametrize("kind", ENDS)
def test_a_value_comes_back_and_no_step_leaves_the_range(kind):
    spec, numbers, expected = ENDS[kind]
    value = torch.tensor(numbers)
    found = parametrization_of(spec, value)
    assert type(found) is expected
    x = found.inverse(value)
    assert torch.isfinite(x).all()
    scale = float(value.abs().max()) or 1.0
    torch.testing.assert_close(found(x), value, rtol=2e-6, atol=2e-7 * scale)
    spec.check(found(x))
    for step in (-1e3, -10.0, 10.0, 1e3, 1e12):
        spec.check(found(x + step))


@pytest.mark.parametrize(("end", "inward"), [(0.0, -1.0), (1.0, 1.0)])
def test_an_albedo_at_an_end_can_leave_it_and_is_not_driven_beyond(end, inward):
    found = parametrization_of(Color(high=1.0), torch.full((3,), end))
    x = found.inverse(torch.full((3,), end)).requires_grad_()
    middle = torch.zeros(3, requires_grad=True)
    slope = torch.autograd.grad(inward * found(x).sum(), x)[0].abs()
    assert (slope > 0.1 * torch.autograd.grad(found(middle).sum(), middle)[0]).all()
    beyond = (x.detach() * 1.5).requires_grad_()
    assert torch.equal(torch.autograd.grad(-inward * found(beyond).sum(), beyond)[0], torch.zeros(3))
    assert (torch.autograd.grad(inward * found(beyond).sum(), beyond)[0].abs() > 0).all()


def test_a_pose_stays_rigid_and_comes_back():
    start = torch.tensor([[0.0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
    found = AxisAnglePose(start)
    x = found.inverse(start)
    assert torch.equal(found(x), start)
    moved = found(x + torch.tensor([0.3, -0.2, 2.0, 1.0, 0.0, 0.0]))
    torch.testing.assert_close(moved[:3, :3] @ moved[:3, :3].T, 4 * torch.eye(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(moved[:, 3], torch.tensor([2.0, 2, 3, 1]))
    torch.testing.assert_close(found(found.inverse(moved)), moved)
    with pytest.raises(ValueError, match="turned and moved"):
        found.inverse(start * 1.5)
    torch.autograd.gradcheck(AxisAnglePose(start.double()), x.double().requires_grad_())


@pytest.mark.parametrize("name", ["material_row", "env_teapot", "noise", "thin_lens"])
def test_every_parameter_of_a_scene_comes_back_in_range(name):
    scene = torchpt.load(name, "cpu")
    found = Renderer(scene, list(scene.params))
    assert set(found.names) == set(scene.params)
    values = {name: value.detach() for name, value in found.values().items()}
    scene.check(values)
    for key, value in values.items():
        scale = float(scene.params[key].abs().max()) or 1.0
        torch.testing.assert_close(
            value, scene.params[key], rtol=1e-5, atol=1e-6 * scale, msg=lambda m, k=key: f"{k}: {m}"
        )


# -- rendering


def test_it_renders_what_render_does(scene, renderer):
    assert renderer.names == tuple(name for name in scene.params if name in (WALL, LAMP, "camera.to_world"))
    expected = torchpt.render(scene, params=renderer.values(), seed=5, **WISHES)
    assert torch.equal(renderer(seed=5), expected)
    assert renderer(seed=5, film={"width": 4}).shape == (3, 4, 3)
    assert renderer(seed=5, full=True, film={"aovs": ["depth"]})["depth"].shape == (8, 10, 1)
    dark = renderer({LAMP: torch.zeros(3)}, seed=5)
    assert float(dark.detach().abs().max()) == 0


def test_gradients_reach_all_parameters(renderer):
    renderer(seed=1).square().mean().backward()
    assert len(list(renderer.parameters())) == 3
    for name, value in renderer.named_parameters():
        assert value.grad is not None and float(value.grad.abs().max()) > 0, name


def test_each_step_draws_other_samples_and_evaluation_the_same(renderer):
    with torch.no_grad():
        steps = [renderer() for _ in range(3)]
        assert int(renderer.steps) == 3
        assert not any(torch.equal(steps[i], steps[j]) for i, j in ((0, 1), (1, 2), (0, 2)))
        assert all(torch.equal(step, renderer(seed=k)) for k, step in enumerate(steps))
        renderer.eval()
        assert torch.equal(renderer(), renderer()) and torch.equal(renderer(), steps[0])
        assert int(renderer.steps) == 3


def test_ranks_draw_different_samples(renderer, monkeypatch):
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_rank", lambda: 1)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 4)
    with torch.no_grad():
        first, second = renderer(), renderer()
        assert torch.equal(first, renderer(seed=1)) and torch.equal(second, renderer(seed=5))


def test_values_are_assigned_and_written(scene):
    own = copy.deepcopy(scene)
    renderer = Renderer(own, WALL, **WISHES)
    colour = torch.tensor([0.0, 1.0, 0.25])
    renderer.assign({WALL: colour})
    torch.testing.assert_close(renderer.values()[WALL].detach(), colour, rtol=1e-6, atol=1e-7)
    assert not torch.allclose(own.params[WALL], colour)
    renderer.write()
    torch.testing.assert_close(own.params[WALL], colour, rtol=1e-6, atol=1e-7)
    assert not own.params[WALL].requires_grad
    with pytest.raises(SceneError, match=f"params.{WALL}: expected .*0..1"):
        renderer.assign({WALL: colour + 1})
    with pytest.raises(SceneError, match=f"params.{LAMP}"):
        renderer.assign({LAMP: colour})


@pytest.mark.parametrize("values", [None, torch.ones(3), [WALL]], ids=["none", "tensor", "names"])
def test_what_is_assigned_is_a_mapping(renderer, values):
    with pytest.raises(SceneError, match="^values: expected a mapping from names .*, got ") as refused:
        renderer.assign(values)
    assert "\n" not in str(refused.value)


BEAM, CUTOFF, PLACE, AIM = (f"lights.s.{name}" for name in ("beam_width", "cutoff_angle", "position", "target"))


def lit_by_a_spot() -> Renderer:
    """By a cone of 20 degrees whose beam is 15 wide."""
    spot = {"type": "spot", "position": [0, 0, 3], "target": [0, 0, 0], "cutoff_angle": 20.0}
    return Renderer(torchpt.load({**room(1), "lights": {"s": spot}}, "cpu"), "lights.s.*", **WISHES)


@pytest.mark.parametrize("names", [(BEAM, CUTOFF), (CUTOFF, BEAM)])
def test_values_that_go_together_are_assigned_together(names):
    renderer = lit_by_a_spot()
    renderer.assign({name: torch.tensor({BEAM: 30.0, CUTOFF: 40.0}[name]) for name in names})
    found = {name: value.detach() for name, value in renderer.values().items()}
    assert float(found[BEAM]) == pytest.approx(30, rel=1e-5) and float(found[CUTOFF]) == pytest.approx(40, rel=1e-5)
    renderer.assign({BEAM: torch.tensor(35.0)})  # right with the module's own cutoff, wrong with the scene's
    with pytest.raises(SceneError, match="beam_width: expected an angle of at most cutoff_angle"):
        renderer.assign({CUTOFF: torch.tensor(30.0)})


@pytest.mark.parametrize("last", [{BEAM: torch.tensor(45.0)}, {PLACE: torch.zeros(3)}, {WALL: torch.ones(3)}])
def test_what_is_refused_changes_nothing(last):
    renderer = lit_by_a_spot()
    before = copy.deepcopy(renderer.state_dict())
    with pytest.raises(SceneError):
        renderer.assign({CUTOFF: torch.tensor(40.0), **last})
    assert all(torch.equal(value, before[name]) for name, value in renderer.state_dict().items())


def test_a_pose_that_is_not_reached_is_refused_before_anything_changes(renderer):
    before = copy.deepcopy(renderer.state_dict())
    mirrored = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0]))
    with pytest.raises(SceneError, match="params.camera.to_world: expected the pose at first, turned and moved"):
        renderer.assign({WALL: torch.ones(3), "camera.to_world": mirrored})
    assert all(torch.equal(value, before[name]) for name, value in renderer.state_dict().items())


@pytest.mark.parametrize(
    ("arguments", "wishes", "key"),
    [
        (["materials.wal.reflectance"], {}, "names"),
        (["lights.*"], {}, "names"),
        ([WALL], {"seed": -1}, "seed"),
        ([WALL], {"params": {}}, "params"),
    ],
)
def test_arguments_that_are_not_accepted(scene, arguments, wishes, key):
    with pytest.raises(SceneError, match=f"^{key}: expected"):
        Renderer(scene, arguments, **wishes)


def test_poses_as_they_are(scene):
    found = Renderer(scene, "shapes.back.to_world", rigid=False)
    assert next(found.parameters()).shape == (4, 4)
    assert next(Renderer(scene, "shapes.back.to_world").parameters()).shape == (6,)
    # Steps along 16 numbers would shear a camera, which is refused.
    assert next(Renderer(scene, "camera.to_world", rigid=False).parameters()).shape == (6,)


# -- state


def moved(renderer: Renderer) -> Renderer:
    """After a step of an optimizer."""
    optimizer = torch.optim.SGD(renderer.parameters(), 0.1)
    renderer().mean().backward()
    optimizer.step()
    optimizer.zero_grad()
    return renderer


def test_its_state_goes_through_a_file(scene, renderer):
    moved(renderer)
    file = io.BytesIO()
    torch.save(renderer.state_dict(), file)
    file.seek(0)
    fresh = Renderer(scene, renderer.names, **WISHES)
    assert not torch.equal(fresh(seed=1), renderer(seed=1))
    fresh.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(fresh(seed=1), renderer(seed=1)) and torch.equal(fresh.steps, renderer.steps)
    assert torch.equal(fresh(), renderer())


def test_the_state_of_a_scene_that_began_elsewhere_means_the_same(scene, renderer):
    moved(renderer)
    other = copy.deepcopy(scene)
    other.params[LAMP].mul_(10)
    other.params["camera.to_world"][2, 3] += 1
    fresh = Renderer(other, renderer.names, **WISHES)
    fresh.load_state_dict(renderer.state_dict())
    for name, value in renderer.values().items():
        assert torch.equal(fresh.values()[name], value)


def test_copies_and_pickles_are_independent(renderer):
    before = renderer(seed=1).detach()
    for twin in (copy.deepcopy(renderer), pickle.loads(pickle.dumps(renderer))):
        assert torch.equal(twin(seed=1).detach(), before) and twin.scene is not renderer.scene
        moved(twin)
        assert torch.equal(renderer(seed=1).detach(), before) and int(renderer.steps) == 0


def test_to_moves_the_scene(renderer):
    scene = renderer.scene
    assert renderer.to("cpu") is renderer and renderer.scene is scene
    assert renderer.double()(seed=1).dtype == torch.float32  # the lanes' own type: a wish of render
    assert renderer.float().names


@pytest.mark.gpu
def test_to_cuda(renderer):
    renderer.to("cuda")
    assert renderer.scene.device.type == "cuda" and moved(renderer)(seed=1).device.type == "cuda"


def test_inside_another_module_and_by_functional_call(renderer):
    whole = torch.nn.Sequential(renderer, torch.nn.Flatten(0))
    assert {name for name, _ in whole.named_parameters()} == {f"0.{name}" for name, _ in renderer.named_parameters()}
    assert "0.free.materials/wall/reflectance" in dict(whole.named_parameters())
    x = {name: value.detach() for name, value in renderer.named_parameters()}

    def loss(x: dict[str, Tensor]) -> Tensor:
        return torch.func.functional_call(renderer, x, (), {"seed": 3}).mean()

    found = torch.func.grad(loss)(x)
    renderer(seed=3).mean().backward()
    for name, value in renderer.named_parameters():
        torch.testing.assert_close(found[name], value.grad)


def test_functional_call_in_training_mode_counts_a_step(renderer):
    x = {name: value.detach() for name, value in renderer.named_parameters()}

    def loss(x: dict[str, Tensor]) -> Tensor:
        return torch.func.functional_call(renderer, x).mean()

    found = torch.func.grad(loss)(x)
    assert int(renderer.steps) == 1
    renderer.steps.zero_()
    renderer().mean().backward()
    for name, value in renderer.named_parameters():
        assert torch.equal(found[name], value.grad)


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is:DeprecationWarning")  # of torch's own jvp, at its first call
def test_forward_mode_and_second_derivatives_go_through_ranges(scene):
    renderer = Renderer(scene, [WALL, LAMP], spp=8, threads=1, film=(8, 8)).eval()
    x = {name: value.detach() for name, value in renderer.named_parameters()}
    tangents = {name: torch.ones_like(value) for name, value in x.items()}

    def loss(x: dict[str, Tensor]) -> Tensor:
        return torch.func.functional_call(renderer, x, (), {"seed_grad": 0}).mean()  # of the picture's own samples

    change = torch.func.jvp(loss, (x,), (tangents,))[1]
    grads = torch.func.grad(loss)(x)
    torch.testing.assert_close(change, torch.stack([grad.sum() for grad in grads.values()]).sum(), rtol=1e-3, atol=0.0)
    (key, _) = x
    hessian = torch.func.hessian(lambda wall: loss({**x, key: wall}))(x[key])
    assert hessian.shape == (3, 3) and bool(hessian.diagonal().abs().min() > 0)


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is:DeprecationWarning")  # of torch's own jvp, at its first call
def test_a_tangent_passes_within_the_range_and_ends_beyond_it():
    kind = parametrization_of(Color(high=1.0), torch.full((3,), 0.5))
    x = torch.tensor([-9.0, 0.0, 9.0])
    tangent = torch.func.jvp(kind, (x,), (torch.ones(3),))[1]
    assert (tangent != 0).tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("wishes", "says"),
    [
        ({"spp": 0}, "render.spp: expected a whole number"),
        ({"film": "x"}, "film: expected"),
        ({"integrator": "pth"}, "integrator.type: expected"),
        ({"full": 1}, "full: expected True or False"),
        ({"edges": False, "edge_guide": torchpt.EdgeGuide()}, "edge_guide: expected None"),
    ],
)
def test_options_are_checked_when_it_is_made(scene, wishes, says):
    with pytest.raises(SceneError, match=f"^{says}"):
        Renderer(scene, WALL, **wishes)


def test_a_tensor_in_place_of_params(renderer):
    with pytest.raises(SceneError, match=r"^params: expected a mapping .*, got tensor"):
        renderer(torch.ones(3))


def test_layers_may_be_asked_for_by_a_call(scene):
    renderer = Renderer(scene, film={"width": 4, "height": 4, "aovs": ["depth"]}, spp=1)
    assert renderer(full=True).layers["depth"].shape == (4, 4, 1)


def test_in_data_parallel_training(renderer, tmp_path):
    distributed = torch.distributed
    distributed.init_process_group("gloo", init_method=f"file://{tmp_path}/store", rank=0, world_size=1)
    try:
        moved(torch.nn.parallel.DistributedDataParallel(renderer))  # pyright: ignore[reportArgumentType]
    finally:
        distributed.destroy_process_group()
    assert int(renderer.steps) == 1


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")  # torch's own, while it compiles
@pytest.mark.filterwarnings("ignore:The .grad attribute")  # torch 2.13's, at any break that such a tensor crosses
@pytest.mark.slow
def test_in_compiled_code(renderer):
    torch.compiler.reset()
    expected = copy.deepcopy(renderer)
    compiled = torch.compile(lambda: renderer(seed=3).square().mean(), backend="aot_eager", fullgraph=True)
    compiled().backward()
    expected(seed=3).square().mean().backward()
    for found, right in zip(renderer.parameters(), expected.parameters(), strict=True):
        torch.testing.assert_close(found.grad, right.grad, rtol=1e-4, atol=1e-7)
    counting = torch.compile(lambda: renderer().mean() * 2, backend="aot_eager")  # reads its counter between two graphs
    for _ in range(3):
        torch.testing.assert_close(counting(), expected().mean() * 2)
    torch.compiler.reset()


def test_what_print_says(renderer):
    assert WALL in repr(renderer)


# -- optimization


def optimized(steps: int, size: int, spp: int, seen: Any = None) -> tuple[float, float, Renderer]:
    """Loss of evaluation before and after; an albedo and a lamp are to become those of a target."""
    wishes: dict[str, Any] = {"film": {"width": size, "height": size}, "threads": 1, "spp": spp}
    goal = torchpt.load(room(3), "cpu")
    goal.params[LAMP].mul_(0.7)
    many: dict[str, Any] = {**wishes, "spp": 256}
    target = torchpt.render(goal, seed=1000, **many)
    renderer = Renderer(torchpt.load(room(1), "cpu"), [WALL, LAMP], **wishes)
    optimizer = torch.optim.Adam(renderer.parameters(), 0.05)

    def loss(**more: Any) -> float:
        with torch.no_grad():
            return float(torchpt.losses.l2(renderer(seed=5, **more), target))

    before = loss(spp=64)
    for step in range(steps):
        optimizer.zero_grad()
        torchpt.losses.l2(renderer(), target).backward()
        optimizer.step()
        if seen is not None:
            seen(step)
    return before, loss(spp=64), renderer


def tensors() -> int:
    """How many tensors are alive."""
    gc.collect()
    return sum(1 for thing in gc.get_objects() if type(thing) in (Tensor, torch.nn.Parameter))


def test_thirty_steps_bring_the_loss_down_and_compile_once():
    made: list[tuple[int, int]] = []
    alive: list[int] = []

    def seen(step: int) -> None:
        made.append(cpu.counts())
        if step in (9, 29):
            alive.append(tensors())

    before, after, renderer = optimized(30, 16, 2, seen)
    assert after < 0.1 * before
    assert int(renderer.steps) == 30
    assert made[1] == made[-1]
    assert alive[1] <= alive[0]


@pytest.mark.slow
def test_a_thousand_steps_take_no_more_memory_than_a_hundred():
    meter = MemoryMeter(torch.device("cpu"))
    held: list[int] = []
    made: list[tuple[int, int]] = []

    def seen(step: int) -> None:
        made.append(cpu.counts())
        if step >= 300 and step % 20 == 0:
            gc.collect()
            release_memory()  # what the allocator keeps for later is no growth
            held.append(meter.now())

    before, after, _ = optimized(1000, 32, 4, seen)
    assert after < 0.01 * before
    assert made[1] == made[-1]
    memory = torch.tensor(held, dtype=torch.float64)
    step = 20.0 * (torch.arange(len(held), dtype=torch.float64) - (len(held) - 1) / 2)
    slope = float((step * memory).sum() / step.square().sum())
    spread = float((memory - memory.mean() - slope * step).std())
    print(f"slope {slope:.0f} bytes a step, spread {spread / 1e3:.0f} KB, loss {before:.5f} -> {after:.7f}")
    assert slope < 1000  # one picture of 32 x 32 takes twelve times that
