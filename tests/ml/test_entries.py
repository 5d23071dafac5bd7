"""What the entries of the Python API say to arguments of the wrong kind: one line with the argument and what is expected."""

# pyright: reportArgumentType=false, reportCallIssue=false
# Wrong arguments are what is handed over here.

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import torchpt
from torchpt import cameras, losses
from torchpt.core.errors import SceneError
from torchpt.data import RenderDataset, RenderStream
from torchpt.nn import Renderer

PAINT = "materials.m.reflectance"
PLACE = {"origin": [0, 0, 4], "target": [0, 0, 0]}


def block(reflectance: Any = 0.5, **camera: Any) -> dict[str, Any]:
    return {
        "camera": {**PLACE, **camera},
        "film": {"width": 4, "height": 4},
        "materials": {"m": {"type": "diffuse", "reflectance": reflectance}},
        "shapes": {"ball": {"type": "sphere", "material": "m"}},
        "lights": {"sky": {"type": "constant", "radiance": 1.0}},
    }


@pytest.fixture(scope="module")
def scene() -> torchpt.Scene:
    return torchpt.load(block(), "cpu")


def pictures(scene: Any, **wishes: Any) -> Any:
    every: dict[str, Any] = {"spp": 1, "threads": 1, **wishes}
    return torchpt.render(scene, **every)


def batch(scenes: Any, *more: Any, **wishes: Any) -> Any:
    every: dict[str, Any] = {"spp": 1, "threads": 1, **wishes}
    return torchpt.render_batch(scenes, *more, **every)


def loaded(**camera: Any) -> torchpt.Scene:
    return torchpt.load(block(**camera), "cpu")


def items(scene: Any, **changes: Any) -> RenderDataset:
    return RenderDataset(lambda _: scene, 1, **{"spp": 1, **changes})


def made(scene: Any, **own: Any) -> Any:
    return RenderDataset(lambda _: (scene, own), 1, spp=1)[0]


def under(transform: Callable[..., Any], work: Callable[..., Any]) -> Any:
    return transform(work)(torch.tensor([30.0]) if transform is torch.func.vmap else torch.tensor(30.0))


def pushed(work: Callable[..., Any]) -> Callable[..., Any]:
    return lambda v: torch.func.jvp(work, (v,), (torch.ones(()),))


OF_LOAD = "expected a scene from torchpt.load"
OF_FUNC = r"camera.fov: expected plain numbers: hand tensors under torch.func to render\(params=...\)"
#: What is done with a scene, and what is said.
REFUSED: dict[str, tuple[Callable[[torchpt.Scene], Any], str]] = {
    # no scene
    "render a dict": (lambda s: pictures(block()), f"scene: {OF_LOAD}"),
    "render a name": (lambda s: pictures("cornell_box"), f"scene: {OF_LOAD}"),
    "render none": (lambda s: pictures(None), f"scene: {OF_LOAD}, got None"),
    "batch of a name": (lambda s: batch("cornell_box"), f"scenes: {OF_LOAD}"),
    "batch of a dict": (lambda s: batch(block()), f"scenes: {OF_LOAD}"),
    "batch of dicts": (lambda s: batch([block()]), rf"scenes\[0\]: {OF_LOAD}"),
    "batch with none": (lambda s: batch([s, None]), rf"scenes\[1\]: {OF_LOAD}, got None"),
    "batch of an iterator": (lambda s: batch(iter([s, 3])), rf"scenes\[1\]: {OF_LOAD}, got 3"),
    "module of a dict": (lambda s: Renderer(block(), PAINT), f"scene: {OF_LOAD}"),
    # arguments of render
    "params a number": (lambda s: pictures(s, params=3), "params: expected a mapping from names"),
    "params a list": (lambda s: pictures(s, params=[1]), "params: expected a mapping from names"),
    "params by number": (lambda s: pictures(s, params={3: torch.ones(3)}), "params: expected names of scene.params"),
    "params on meta": (
        lambda s: pictures(s, params={PAINT: torch.empty(3, device="meta")}),
        f"params.{PAINT}: expected a floating tensor .* on the device meta",
    ),
    "ranks a number": (lambda s: pictures(s, ranks=2), "ranks: expected a torchpt.ranks.Group, got 2"),
    "edges a word": (lambda s: pictures(s, edges="no"), "edges: expected True or False, got 'no'"),
    "full a word": (lambda s: pictures(s, full="yes"), "full: expected True or False, got 'yes'"),
    # devices
    "device gpu": (
        lambda s: torchpt.load(block(), "gpu"),
        "render.device: expected auto, cpu, cuda or cuda:N, got 'gpu'",
    ),
    "scene to meta": (lambda s: s.to("meta"), "render.device: expected auto, cpu, cuda or cuda:N, got 'meta'"),
    # modules
    "names a number": (lambda s: Renderer(s, 3), "names: expected a name"),
    "names with a number": (lambda s: Renderer(s, [3]), "names: expected a name"),
    "no names": (lambda s: Renderer(s, []), "names: expected one name at least"),
    # data sets
    "make a number": (lambda s: RenderDataset(3, 4), "make: expected a function"),
    "make gives none": (lambda s: RenderDataset(lambda i: None, 2)[0], r"make\(0\): expected a scene"),
    "make gives a name": (lambda s: RenderDataset(lambda i: "cornell_box", 2)[1], r"make\(1\): expected a scene"),
    "make gives three": (lambda s: RenderDataset(lambda i: (s, {}, 1), 2)[1], r"make\(1\): expected a scene"),
    "a block for a data set": (
        lambda s: RenderDataset(lambda i: s, 1, cameras=[{"fov": 30}]),
        r"cameras\[0\]: expected names of scene.params such as camera.fov; a whole camera block is for render_batch",
    ),
    "cameras of a data set none": (lambda s: items(s, cameras=None), "cameras: expected a sequence of poses"),
    "cameras of a data set a word": (lambda s: items(s, cameras="x"), "cameras: expected a sequence of poses"),
    "a word for a pose": (lambda s: items(s, cameras=["x"]), r"cameras\[0\]: expected numbers"),
    "one pose for many": (
        lambda s: items(s, cameras=torch.eye(4)),
        r"cameras: expected a sequence of poses \(4, 4\) .*, got \(4, 4\)",
    ),
    "a word for a parameter": (
        lambda s: items(s, cameras=[{"camera.fov": "wide"}])[0],
        "params.camera.fov: expected numbers",
    ),
    "layers a word": (lambda s: items(s, layers="depth"), "layers: expected a sequence"),
    "layers none": (lambda s: items(s, layers=None), "layers: expected a sequence"),
    "film a word": (lambda s: items(s, film="x"), r"film: expected \(width, height\), or a mapping of film settings"),
    "layers in the film": (lambda s: items(s, film={"aovs": ["depth"]}), "film.aovs: expected none: use layers"),
    "denoised items": (lambda s: items(s, film={"denoise": True}), "film.denoise: expected false"),
    "a stream of them": (
        lambda s: RenderStream(lambda i: s, film={"aovs": ["depth"]}),
        "film.aovs: expected none: use layers",
    ),
    "made layers": (lambda s: made(s, film={"aovs": ["depth"]}), r"make\(0\).film.aovs: expected none: use layers"),
    "made denoised": (lambda s: made(s, film={"denoise": True}), r"make\(0\).film.denoise: expected false"),
    "made film a word": (lambda s: made(s, film="x"), r"make\(0\).film: expected \(width, height\), or a mapping"),
    "made full": (lambda s: made(s, full=True), r"make\(0\).full: expected none"),
    "made params a list": (lambda s: made(s, params=[1]), r"make\(0\).params: expected a mapping from names"),
    "made params a word": (lambda s: made(s, params={PAINT: "red"}), f"params.{PAINT}: expected numbers"),
    "made params unknown": (lambda s: made(s, params={"pain": 1.0}), "params.pain: expected a parameter of this scene"),
    # batches
    "a number for a batch": (lambda s: batch(s, [{"fov": 30}]), r"cameras\[0\]: expected a whole camera block.*params"),
    "a name for a batch": (lambda s: batch(s, [{"camera.fov": 3.0}]), r"cameras\[0\]: expected a whole camera block"),
    "params for other scenes": (
        lambda s: batch([s, s], params={PAINT: torch.rand(3)}),
        "params: expected as many as there are scenes, 2, along the first dimension of each tensor, got 3",
    ),
    "params for one scene": (
        lambda s: batch(s, params={PAINT: torch.rand(3)}),
        rf"params.{PAINT}: expected a first dimension that is the number of scenes, before those of \(3,\), got \(3,\)",
    ),
    # cameras
    "from_kornia": (lambda s: cameras.from_kornia(3), "camera: expected kornia's PinholeCamera, got 3"),
    "frames of scenes": (lambda s: cameras.write_transforms("no.json", [s]), "frames.0: expected a Frame"),
    "no frames": (lambda s: cameras.write_transforms("no.json", []), "frames: expected one frame at least"),
    # arrays
    "a small matrix": (
        lambda s: torchpt.load({**block(), "camera": {"to_world": np.eye(3)}}, "cpu"),
        r"camera.to_world: .* got an array of shape \(3, 3\)",
    ),
    "channels first": (lambda s: torchpt.load(block(torch.rand(3, 8, 8)), "cpu"), r"texels \(H, W, C\), channels last"),
    # torch.func through what is loaded
    "grad of a dict": (lambda s: under(torch.func.grad, lambda v: pictures(loaded(fov=v)).mean()), OF_FUNC),
    "vmap of a dict": (lambda s: under(torch.func.vmap, lambda v: pictures(loaded(fov=v)).mean()), OF_FUNC),
    "jvp of a dict": (lambda s: under(pushed, lambda v: pictures(loaded(fov=v)).mean()), OF_FUNC),
    "grad of a view": (
        lambda s: under(torch.func.grad, lambda v: pictures(s.seen_by({**PLACE, "fov": v})).mean()),
        OF_FUNC,
    ),
}


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is:DeprecationWarning")  # of torch's own jvp, at its first call
@pytest.mark.parametrize("case", REFUSED)
def test_what_is_of_the_wrong_kind_is_refused_in_a_line(scene, tmp_path, monkeypatch, case):
    monkeypatch.chdir(tmp_path)
    work, said = REFUSED[case]
    with pytest.raises(SceneError, match=said) as error:
        work(scene)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


UNKNOWN: dict[str, tuple[Callable[[torchpt.Scene], Any], str]] = {
    "spp of a batch": (lambda s: batch(s, ssp=1), r"render_batch\(\) .* 'ssp'. Did you mean 'spp'\?"),
    "full of a batch": (lambda s: batch(s, ful=True), r"render_batch\(\) .* 'ful'. Did you mean 'full'\?"),
    "cameras of a batch": (lambda s: batch(s, camera=[]), r"render_batch\(\) .* 'camera'. Did you mean 'cameras'\?"),
    "nothing like it": (lambda s: batch(s, qqqq=1), r"render_batch\(\) got an unexpected keyword argument 'qqqq'$"),
    "module": (lambda s: Renderer(s, PAINT, sp=1), r"Renderer\(\) .* 'sp'. Did you mean 'spp'\?"),
    "data set": (
        lambda s: RenderDataset(lambda i: s, 1, thread=1),
        r"RenderDataset\(\) .* 'thread'. Did you mean 'threads'\?",
    ),
    "stream": (
        lambda s: RenderStream(lambda i: s, 1, thread=1),
        r"RenderStream\(\) .* 'thread'. Did you mean 'threads'\?",
    ),
    "made": (lambda s: RenderDataset(lambda i: (s, {"sp": 1}), 1)[0], r"render\(\) .* 'sp'. Did you mean 'spp'\?"),
    "loss of a rendering": (
        lambda s: losses.l2(pictures(s, full=True), torch.zeros(4, 4, 3)),
        "got Rendering; hand over its .image",
    ),
    "loss of a list": (lambda s: losses.l1([1.0], torch.zeros(1)), "picture: expected a tensor, got list$"),
    "one index": (lambda s: batch(s, full=True)[1], r"expected renderings\[s, c\].* got renderings\[1\]"),
}


@pytest.mark.parametrize("case", UNKNOWN)
def test_arguments_that_nobody_knows_are_type_errors(scene, case):
    work, said = UNKNOWN[case]
    with pytest.raises(TypeError, match=said):
        work(scene)


def test_a_module_stays_where_it_is_if_it_cannot_go(scene):
    module = Renderer(scene, PAINT, spp=1, threads=1)
    with pytest.raises(SceneError, match="render.device: expected auto, cpu, cuda or cuda:N, got 'meta'"):
        module.to("meta")
    assert all(value.device.type == "cpu" for value in (*module.parameters(), *module.buffers()))
    assert torch.isfinite(module()).all()


def test_a_module_without_names_renders_the_scene(scene):
    module = Renderer(scene, spp=1, threads=1, seed=3)
    assert not list(module.parameters())
    assert torch.equal(module(), pictures(scene, seed=3))
