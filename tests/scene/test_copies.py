"""A scene can be copied, moved, pickled and sent to other processes; each copy is a scene of its own."""

from __future__ import annotations

import copy
import io
import multiprocessing
import pickle
from itertools import product
from typing import Any

import pytest
import torch
from few import few
from torch import Tensor

import torchpt
from torchpt.core.errors import SceneError
from torchpt.math.sampling import cosine_hemisphere
from torchpt.physics import bsdfs, cameras, lights, shapes, textures
from torchpt.physics.bsdfs.records import BsdfSample
from torchpt.physics.textures.atlas import Atlas
from torchpt.spec import parameters_of

RED = "materials.red.reflectance"
SCENE: dict[str, Any] = {
    "camera": {"type": "perspective", "origin": [0, 0.4, 4], "target": [0, 0, 0], "fov": 40},
    "film": {"width": 12, "height": 10},
    "integrator": {"type": "path", "max_depth": 4},
    "render": {"spp": 4, "threads": 1},
    "textures": {"squares": {"type": "checkerboard", "color0": [0.1, 0.1, 0.1], "color1": [0.8, 0.8, 0.8]}},
    "materials": {
        "red": {"type": "diffuse", "reflectance": [0.7, 0.1, 0.1]},
        "tiles": {"type": "diffuse", "reflectance": {"texture": "squares"}},
    },
    "shapes": {
        "ball": {"type": "sphere", "radius": 0.8, "material": "red"},
        "floor": {
            "type": "mesh",
            "vertices": [[-3, -1, -3], [3, -1, -3], [3, -1, 3], [-3, -1, 3]],
            "uvs": [[0, 0], [1, 0], [1, 1], [0, 1]],
            "faces": [[0, 2, 1], [0, 3, 2]],
            "material": "tiles",
        },
    },
    "lights": {
        "sky": {"type": "constant", "radiance": 0.5},
        "spot": {"type": "spot", "position": [2, 3, 2], "target": [0, 0, 0], "intensity": 20},
    },
}


class Grey(torchpt.Bsdf):
    """A model of the user's own that holds a weight."""

    name = "grey"

    def __init__(self) -> None:
        self.own = torch.nn.ParameterDict({"shade": torch.tensor(0.5)})

    @property
    def shade(self) -> Tensor:
        return self.own["shade"]

    def eval(self, parameters: Any, wo: Tensor, wi: Tensor) -> Tensor:
        return (self.shade / torch.pi * wi[2].clamp_min(0.0) * (wo[2] > 0)).expand(3, -1)

    def pdf(self, parameters: Any, wo: Tensor, wi: Tensor) -> Tensor:
        return wi[2].clamp_min(0.0) / torch.pi * (wo[2] > 0)

    def sample(self, parameters: Any, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        wi = cosine_hemisphere(u)
        pdf = self.pdf(parameters, wo, wi)
        return BsdfSample(wi, pdf, self.shade.expand(3, wo.shape[1]) * (pdf > 0))


COPIES = {
    "pickle": lambda scene: pickle.loads(pickle.dumps(scene)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
    "torch.save": lambda scene: _saved(scene),
}


def _saved(scene: torchpt.Scene) -> torchpt.Scene:
    file = io.BytesIO()
    torch.save(scene, file)
    file.seek(0)
    return torch.load(file, weights_only=False)


@pytest.mark.parametrize(("how", "rendered"), few(product(COPIES, [False, True]), 4))
def test_a_copy_renders_the_same_and_goes_its_own_way(how, rendered):
    scene = torchpt.load(SCENE, "cpu")
    if rendered:
        torchpt.render(scene)
    scene.params[RED].mul_(0.5)
    made = COPIES[how](scene)
    before = torchpt.render(scene)
    assert torchpt.render(made).equal(before)
    assert made.params.keys() == scene.params.keys() and repr(made.description) == repr(scene.description)
    made.params[RED] = torch.tensor([0.0, 1.0, 0.0])
    assert not torchpt.render(made).equal(before)
    assert torchpt.render(scene).equal(before)


def test_a_world_reads_texels_of_its_scene_and_pickles_hold_each_once():
    image, white = (torch.full((64, 64, 3), value).numpy() for value in (0.25, 1.0))
    blocks = {name: {"type": "image", "data": texels} for name, texels in (("a", image), ("b", white))}
    materials = {name: {"type": "diffuse", "reflectance": block} for name, block in blocks.items()}
    floor = SCENE["shapes"]["floor"]
    meshes = {name: {**floor, "material": name} for name in blocks}
    scene = torchpt.load({**SCENE, "textures": {}, "materials": materials, "shapes": meshes}, "cpu")
    world, _ = scene.world(torch.float32)
    (atlas,) = world.textures.tables
    one, other = (scene.params[f"materials.{name}.reflectance"] for name in blocks)
    assert (
        isinstance(atlas, Atlas)
        and atlas.texels.data_ptr() == one.data_ptr()
        and atlas.texels.numel() == 2 * 3 * 64 * 64
    )
    version, before = other._version, torchpt.render(scene)
    one.fill_(0.75)
    assert other._version == version and not torchpt.render(scene).equal(before)
    # The description has the arrays, the build and the parameters have tensors.
    assert len(pickle.dumps(scene)) < 3.5 * atlas.texels.nbytes
    made = pickle.loads(pickle.dumps(scene))
    assert torchpt.render(made).equal(torchpt.render(scene))


def test_a_copy_shares_tensors_and_a_deep_copy_does_not():
    scene = torchpt.load(SCENE, "cpu")
    assert copy.copy(scene).params[RED] is scene.params[RED]
    deep = copy.deepcopy({"a": scene, "b": scene})
    assert deep["a"] is deep["b"] and deep["a"].params[RED] is not scene.params[RED]
    scene.params[RED].requires_grad_()
    assert copy.deepcopy(scene).params[RED].requires_grad
    assert pickle.loads(pickle.dumps(scene)).params[RED].requires_grad


def test_moving_to_where_it_is_does_nothing():
    scene = torchpt.load(SCENE, "cpu")
    assert scene.to("cpu") is scene and scene.to(torch.device("cpu")) is scene
    with pytest.raises(torchpt.RenderError):
        scene.to("cuda:99")


@pytest.mark.parametrize("how", few(["pickle", "deepcopy", "torch.save"], 1))
def test_models_of_ones_own_are_copied_with_it(how):
    grey = Grey()
    own = {**SCENE, "materials": {**SCENE["materials"], "red": {"type": "grey"}}}
    own["render"] = {**SCENE["render"], "compile": "off"}
    scene = torchpt.load(own, "cpu", bsdfs={"grey": grey})
    with torch.no_grad():
        made = COPIES[how](scene)
        before = torchpt.render(made)
        grey.shade.fill_(0.1)
        assert torchpt.render(made).equal(before)
        assert not torchpt.render(scene).equal(before)
        made.own_models[0].shade.fill_(0.1)
        assert torchpt.render(made).equal(torchpt.render(scene))
    torchpt.render(made).sum().backward()
    assert made.own_models[0].shade.grad is not None and grey.shade.grad is None


def _rendered(scene: torchpt.Scene, queue: Any) -> None:
    queue.put(torchpt.render(scene).numpy())


@pytest.mark.slow
def test_a_spawned_worker_gets_it():
    scene = torchpt.load(SCENE, "cpu")
    expected = torchpt.render(scene)
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    worker = context.Process(target=_rendered, args=(scene, queue))
    worker.start()
    found = torch.from_numpy(queue.get(timeout=240))
    worker.join(60)
    assert worker.exitcode == 0 and found.equal(expected)


def test_parameters_that_require_gradients_are_differentiated_as_they_are():
    scene = torchpt.load(SCENE, "cpu")
    given = scene.params[RED].clone().requires_grad_()
    torchpt.render(scene, params={RED: given}).sum().backward()
    own = scene.params[RED].requires_grad_()
    torchpt.render(scene).sum().backward()
    assert given.grad is not None and own.grad is not None and own.grad.equal(given.grad)
    with torch.no_grad():
        assert not torchpt.render(scene).requires_grad
    fixed = scene.params[RED].detach().clone()
    assert not torchpt.render(scene, params={RED: fixed}).requires_grad


def test_layers_are_not_lost_in_silence():
    scene = torchpt.load(SCENE, "cpu")
    with pytest.raises(SceneError, match=r"film.aovs: .*full=True"):
        torchpt.render(scene, film={"aovs": ["normal"]})
    assert torchpt.render(scene, film={"aovs": ["normal"]}, full=True).layers["normal"].shape == (10, 12, 3)


def test_whatever_a_scene_may_hold_can_be_pickled():
    for kinds in (bsdfs.KINDS, lights.KINDS, shapes.KINDS, textures.KINDS, cameras.KINDS):
        for kind in kinds.values():
            for name, spec in parameters_of(kind).items():
                if spec.differentiable:
                    assert type(pickle.loads(pickle.dumps(spec))) is type(spec), (kind, name)
