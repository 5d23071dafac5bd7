"""Pictures of one scene by several cameras, by tensor operations: they share waves, and each is the one it is alone."""

from __future__ import annotations

import pytest
import torch

import torchpt
from torchpt.errors import RenderError
from torchpt.forward import crowd

SIZE = {"width": 12, "height": 8}
#: Cameras of several kinds, among them one that looks past everything.
CAMERAS = [
    {"type": "perspective", "origin": [1, 1, 4], "target": [0, 0.5, 0], "fov": 40},
    {"type": "orthographic", "origin": [0, 2, 3], "target": [0, 0.5, 0], "width": 4},
    {"type": "thinlens", "origin": [0, 1, 3], "target": [0, 0, 0], "aperture_radius": 0.1, "focus_distance": 3},
    {"type": "perspective", "origin": [0, 1, 4], "target": [0, 1, 9]},
    {"K": [[15, 0, 6], [0, 15, 4], [0, 0, 1]], "R": [[1, 0, 0], [0, -1, 0], [0, 0, -1]], "t": [0, 1, 4]},
]
PAINT = "materials.paint.reflectance"


def room(**more):
    """Two kinds of materials, one of which refracts, and three of lights."""
    return torchpt.load(
        {
            "camera": CAMERAS[0],
            "film": SIZE,
            "integrator": {"max_depth": 6, "rr_depth": 3},
            "render": {"spp": 3, "device": "cpu", "compile": "off"},
            "materials": {
                "paint": {"type": "diffuse", "reflectance": [0.6, 0.5, 0.4]},
                "glass": {"type": "dielectric"},
            },
            "shapes": {
                "floor": {"type": "rectangle", "material": "paint", "transform": [{"scale": 3}]},
                "ball": {"type": "sphere", "center": [0, 0.6, 0.6], "radius": 0.5, "material": "glass"},
                "lamp": {"type": "sphere", "center": [1, 2, 1], "radius": 0.3, "emission": [5, 4, 3]},
            },
            "lights": {
                "sky": {"type": "constant", "radiance": [0.3, 0.4, 0.5]},
                "spark": {"type": "point", "position": [-1, 2, 1], "intensity": [1, 1, 1]},
            },
            **more,
        }
    )


@pytest.fixture
def scarce(monkeypatch, waves):
    """The same, where there is memory for two renders and no more."""
    take = crowd.take

    def limited(works):
        found = take(works)
        if len(works) > 2:
            raise MemoryError
        return found

    monkeypatch.setattr(crowd, "take", limited)
    return waves


def same(scene, wishes, batch, cameras=CAMERAS, seeds=None):
    """Pictures, layers and facts of a batch are those of single renders."""
    for c, block in enumerate(cameras):
        seed = {} if seeds is None else {"seed": seeds[c]}
        alone, own = torchpt.render(scene.seen_by(block), full=True, **seed, **wishes), batch[0, c]
        assert torch.equal(own.image, alone.image)
        assert own.layers.keys() == alone.layers.keys()
        assert all(torch.equal(own.layers[name], alone.layers[name]) for name in own.layers)
        for fact in (
            "rays",
            "paths",
            "spp",
            "truncated_paths",
            "nonfinite_samples",
            "clamped",
            "stopped_by",
            "complete",
        ):
            assert getattr(own, fact) == getattr(alone, fact), fact
        assert own.rays > 0


@pytest.mark.parametrize(
    "wishes",
    (
        {},
        {"dtype": torch.float64},
        {"film": {"aovs": ["depth", "albedo", "variance"], "filter": "mitchell", "crop": [2, 1, 7, 5]}},
        {"integrator": {"type": "path", "clamp": 0.4, "max_depth": 3}},
        {"integrator": {"type": "path", "light_choice": "tree"}, "sampler": "independent"},
        {"integrator": "ibl"},
        {"integrator": "direct"},
        {"integrator": "aov", "film": {"aovs": ["normal", "object_id"]}},
        {"spp": 70},
    ),
    ids=str,
)
def test_cameras_of_every_kind(wishes, waves):
    scene = room()
    batch = torchpt.render_batch(scene, CAMERAS, full=True, **wishes)
    assert waves == [(len(CAMERAS), 1)]
    same(scene, wishes, batch)


def test_each_with_its_own_seed(waves):
    scene, seeds = room(), [3, 1, 4, 1, 5]
    batch = torchpt.render_batch(scene, CAMERAS, full=True, seed=[seeds])
    assert waves == [(5, 1)]
    same(scene, {}, batch, seeds=seeds)


def test_paths_that_are_cut_are_counted_by_picture(monkeypatch, waves):
    from torchpt.integrators import path

    monkeypatch.setattr(path, "ENDLESS", 4)
    scene = room(integrator={"type": "path", "max_depth": -1, "rr_depth": 99})
    batch = torchpt.render_batch(scene, CAMERAS, full=True)
    assert waves == [(5, 1)]
    assert len({batch[0, c].truncated_paths for c in range(5)}) > 2
    same(scene, {}, batch)


def test_scenes_one_after_another_each_with_its_cameras(waves):
    scenes = [room(), room(film={**SIZE, "filter": "box"}), room()]
    batch = torchpt.render_batch(scenes, CAMERAS, full=True)
    assert waves == [(5, 1), (5, 1), (5, 1)]  # their filters differ
    for s, scene in enumerate(scenes):
        for c, block in enumerate(CAMERAS):
            assert torch.equal(batch[s, c].image, torchpt.render(scene.seen_by(block)))


def test_views_given_as_scenes(waves):
    scene = room()
    views = [scene.seen_by(block) for block in CAMERAS]
    batch = torchpt.render_batch(views, full=True)
    assert waves == [(5, 1)]
    assert all(torch.equal(batch[c, 0].image, torchpt.render(view)) for c, view in enumerate(views))


def test_poses_and_parameters_of_the_camera(waves):
    scene = room()
    poses = scene.params["camera.to_world"].repeat(4, 1, 1)
    poses[:, 0, 3] += 0.2 * torch.arange(4)
    batch = torchpt.render_batch(scene, poses)
    angles = torch.tensor([30.0, 40.0, 50.0])
    zoomed = torchpt.render_batch(scene, params={"camera.fov": angles})
    assert waves == [(4, 1), (3, 1)]
    for picture, pose in zip(batch[0], poses, strict=True):
        assert torch.equal(picture, torchpt.render(scene, params={"camera.to_world": pose}))
    for picture, angle in zip(zoomed[:, 0], angles, strict=True):
        assert torch.equal(picture, torchpt.render(scene, params={"camera.fov": angle}))


def test_gradients_are_those_of_single_renders():
    scene, colour = room(), torch.tensor([0.2, 0.5, 0.7], requires_grad=True)
    wishes = {"params": {PAINT: colour}, "seed_grad": 7}
    together = torchpt.render_batch(scene, CAMERAS[:3], params=[{PAINT: colour}], seed_grad=7)
    alone = torch.stack([torchpt.render(scene.seen_by(block), **wishes) for block in CAMERAS[:3]])
    assert torch.equal(together[0], alone)
    (found,) = torch.autograd.grad(together.square().sum(), colour)
    (expected,) = torch.autograd.grad(alone.square().sum(), colour)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0.0)


@pytest.mark.parametrize(
    "wishes",
    (
        pytest.param({"max_memory": "4GB"}, marks=pytest.mark.slow),
        {"time_limit": 100.0},
        {"pilots": True},
        {"compile": "auto"},  # kernels
    ),
    ids=str,
)
def test_what_keeps_to_itself(wishes, waves):
    scene = room()
    batch = torchpt.render_batch(scene, CAMERAS[:2], **wishes)
    assert waves == []
    for picture, block in zip(batch[0], CAMERAS, strict=False):
        assert torch.equal(picture, torchpt.render(scene.seen_by(block), **wishes))


def test_textures_that_average_over_footprints_keep_to_themselves(waves):
    floor = {"type": "image", "data": torch.rand(8, 8, 3), "filter": "trilinear"}
    scene = room(materials={"paint": {"type": "diffuse", "reflectance": floor}, "glass": {"type": "dielectric"}})
    batch = torchpt.render_batch(scene, CAMERAS[:2])
    assert waves == []
    for picture, block in zip(batch[0], CAMERAS, strict=False):
        assert torch.equal(picture, torchpt.render(scene.seen_by(block)))


def test_a_wave_has_no_more_lanes_than_it_may(monkeypatch, waves):
    monkeypatch.setitem(crowd.LANES, "cpu", 2 * 12 * 8 * 3)
    scene = room()
    batch = torchpt.render_batch(scene, CAMERAS, full=True)
    assert waves == [(2, 1), (2, 1)]  # and the last one alone
    same(scene, {}, batch)


@pytest.mark.slow
def test_where_memory_runs_out_waves_are_halved(monkeypatch, scarce):
    scene = room()
    batch = torchpt.render_batch(scene, CAMERAS * 2, full=True)
    # Ten are too many, and five, and three; what is left over is rendered alone.
    assert scarce == [(10, 1), (5, 1), (2, 1), (3, 1), (2, 1), (5, 1), (2, 1), (3, 1), (2, 1)]
    same(scene, {}, batch, CAMERAS * 2)
    monkeypatch.setattr(crowd, "take", lambda works: (_ for _ in ()).throw(MemoryError))
    same(scene, {}, torchpt.render_batch(scene, CAMERAS, full=True))


def test_waves_stay_small_once_memory_ran_out(monkeypatch, scarce):
    monkeypatch.setitem(crowd.LANES, "cpu", 4 * 12 * 8 * 3)
    torchpt.render_batch([room(), room()], CAMERAS[:4])
    assert scarce == [(4, 1), (2, 1), (2, 1), (2, 1), (2, 1)]


def test_scenes_that_share_no_wave_are_rendered_before_the_next_is_loaded():
    told = []

    def scenes():
        for k in range(3):
            told.append(f"load {k}")
            yield room(integrator={"type": "ibl"})

    torchpt.render_batch(scenes(), CAMERAS[:2], on_progress=lambda done, total: told.append(done))
    assert told == ["load 0", 1, 2, "load 1", 3, 4, "load 2", 5, 6]


def test_pictures_with_kernels_do_not_overtake():
    told = []
    scenes = [room(), room(render={"spp": 3, "device": "cpu"})]
    torchpt.render_batch(iter(scenes), on_progress=lambda done, total: told.append(done))
    assert told == [1, 2]


def test_an_error_is_that_of_its_picture(monkeypatch):
    scene, rays = room(), crowd.Work.rays

    def failing(work):
        if float(work.wave.camera.to_world[0, 3]) > 1.5:
            raise RenderError("broken")
        return rays(work)

    monkeypatch.setattr(crowd.Work, "rays", failing)
    poses = scene.params["camera.to_world"].repeat(3, 1, 1)
    poses[2, 0, 3] = 2.0
    with pytest.raises(RenderError, match=r"^params\[2\]: broken"):
        torchpt.render_batch(scene, params={"camera.to_world": poses})


def test_samples_that_are_not_finite_are_those_of_their_picture(waves):
    scene = room()
    scene.params["lights.sky.radiance"].fill_(float("nan"))
    scene.check_own = lambda: None  # which refuses that
    views = CAMERAS[3:4] + CAMERAS[:1]
    batch = torchpt.render_batch(scene, views, full=True)
    assert waves == [(2, 1)]
    assert batch[0, 0].nonfinite_samples == 12 * 8 * 3 > batch[0, 1].nonfinite_samples > 0
    with pytest.raises(RenderError, match=r"^scenes\[0\]: integrator\.strict: sample 0 of pixel"):
        torchpt.render_batch([scene], views, integrator={"type": "path", "strict": True})


def test_progress_is_told_of_each():
    told = []
    torchpt.render_batch(room(), CAMERAS, on_progress=lambda done, total: told.append((done, total)))
    assert told == [(k, 5) for k in range(1, 6)]
