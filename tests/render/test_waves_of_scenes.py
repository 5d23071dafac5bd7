"""Pictures of several scenes, by tensor operations: scenes of one form share waves, and each picture is the one it is alone."""

from __future__ import annotations

import gc
import math
import weakref
from typing import ClassVar

import pytest
import torch
import trimesh

import torchpt
from torchpt import union
from torchpt.errors import RenderError
from torchpt.forward import crowd, shared
from torchpt.forward.run import Run
from torchpt.forward.waves import say_once
from torchpt.math.warps import cosine_hemisphere
from torchpt.records import BsdfSample

FLOOR = {
    "type": "rectangle",
    "material": "paint",
    "transform": [{"scale": 3}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
}
LAMP = {"type": "rectangle", "transform": [{"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 3, 0]}]}
PAINT = {"type": "diffuse", "reflectance": [0.6, 0.5, 0.4]}
CAMERA = {"type": "perspective", "origin": [1, 1, 4], "target": [0, 0.5, 0], "fov": 40}


def scene(blocks):
    """A scene of 12 x 8 pixels, by tensor operations, of these blocks."""
    base = {
        "camera": CAMERA,
        "film": {"width": 12, "height": 8},
        "integrator": {"max_depth": 5, "rr_depth": 3},
        "render": {"spp": 3, "device": "cpu", "compile": "off"},
    }
    return torchpt.load(base | blocks)


def pixels(k, channels=3, size=4):
    """A picture that depends on ``k``, in size too."""
    return torch.rand(size + k, size + 2 * k, channels, generator=torch.Generator().manual_seed(k))


def grid(k):
    """A bumpy mesh with texture coordinates; of more triangles where ``k`` is larger."""
    n = 3 + k
    side = torch.linspace(-1, 1, n)
    x, y = (a.reshape(-1) for a in torch.meshgrid(side, side, indexing="ij"))
    z = 0.3 * torch.sin(3 * x + k) * torch.cos(2 * y)
    place = torch.arange(n * n).view(n, n)
    quads = torch.stack((place[:-1, :-1], place[1:, :-1], place[1:, 1:], place[:-1, 1:]), -1).reshape(-1, 4)
    faces = torch.cat((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]))
    return {
        "type": "mesh",
        "vertices": torch.stack((x, 0.8 + z, y), 1),
        "faces": faces,
        "uvs": torch.stack((x, y), 1),
    }


def with_colours(k):
    """The same with colours of its vertices in place of texture coordinates."""
    mesh = grid(k)
    colours = torch.rand(len(mesh["vertices"]), 3, generator=torch.Generator().manual_seed(k))
    made = trimesh.Trimesh(
        mesh["vertices"].numpy(), mesh["faces"].numpy(), vertex_colors=colours.numpy(), process=False
    )
    return {"type": "mesh", "mesh": made}


def plain(k):
    """Every kind of primitive, as many as ``k`` says, and two models."""
    balls = {
        f"ball{j}": {
            "type": "sphere",
            "center": [0.4 * j - 0.6, 0.5, 0.5],
            "radius": 0.2 + 0.02 * k,
            "material": "glass",
        }
        for j in range(1 + k)
    }
    return {
        "materials": {
            "paint": {"type": "diffuse", "reflectance": [0.6, 0.5, 0.1 * k]},
            "glass": {"type": "dielectric"},
        },
        "shapes": {
            "floor": FLOOR,
            "mesh": {**grid(k), "material": "paint"},
            "disk": {"type": "disk", "material": "paint", "transform": [{"translate": [0, 1 + 0.1 * k, -1]}]},
            "tin": {"type": "cylinder", "center": [1, 0.5, 0], "radius": 0.2, "height": 0.3 + 0.1 * k},
            "cone": {"type": "cone", "apex": [-1, 1, 0], "height": 0.8, "slope": 0.3 + 0.05 * k},
            **balls,
            "lamp": {**LAMP, "emission": [5, 4, 3 + k]},
        },
    }


def lit(k):
    """Lights of all kinds that are somewhere, among them surfaces that are met, and quadrics."""
    lamps = {
        f"lamp{j}": {
            "type": "sphere",
            "center": [j - 1, 2 + 0.1 * k, 0.5],
            "radius": 0.1,
            "emission": [3, 2 + j, 1 + k],
        }
        for j in range(2 + k)
    }
    return {
        "materials": {"paint": PAINT},
        "shapes": {
            "floor": FLOOR,
            "tin": {"type": "cylinder", "center": [1, 0.5, 0], "radius": 0.2, "height": 0.3, "emission": [1, 1, k]},
            "ring": {"type": "cone", "apex": [-1, 1, 0], "height": 0.8, "slope": 0.4},
            "glow": {**grid(k), "emission": [0.2, 0.1, 0.1 * k]},
            **lamps,
        },
        "lights": {
            "spark": {"type": "point", "position": [-1, 2, 1], "intensity": [1, 1, k]},
            "beam": {"type": "spot", "position": [0, 3, 0], "target": [0.1 * k, 0, 0], "intensity": 4},
            "sun": {"type": "directional", "direction": [0.1 * k, -1, -1], "irradiance": 0.5},
        },
    }


def under_the_sky(k):
    """One environment map each, of its own size and turn, beside a lamp."""
    turn = [{"rotate": {"axis": [0, 1, 0.2], "angle": 40 * k}}]
    return {
        "materials": {"paint": PAINT},
        "shapes": {"floor": FLOOR, "lamp": {**LAMP, "emission": [1, 2, k]}},
        "lights": {"sky": {"type": "envmap", "data": 4 * pixels(k) ** 4, "scale": 1 + 0.1 * k, "transform": turn}},
    }


def under_the_sky_alone(k):
    """The same with no other light, which is then not chosen."""
    found = under_the_sky(k)
    del found["shapes"]["lamp"]
    return found


def grey(k):
    """One constant environment each."""
    shapes = {"floor": FLOOR, "ball": {"type": "sphere", "center": [0, 0.5, 0], "radius": 0.5 + 0.01 * k}}
    return {
        "materials": {"paint": PAINT},
        "shapes": shapes,
        "lights": {"sky": {"type": "constant", "radiance": [0.5, 0.4, 0.2 * k]}},
    }


def textured(k):
    """Textures of all kinds in all kinds of slots."""
    image = {"type": "image", "data": pixels(k), "uv_transform": {"scale": 1 + k}}
    checks = {"type": "checkerboard", "color0": 0.1 * (1 + k), "color1": [0.9, 0.5, 0.1], "scale": 3 + k}
    heights = {"type": "image", "data": 0.1 * pixels(k, 1), "filter": "nearest", "wrap": "mirror"}
    normals = {"type": "image", "data": 0.4 + 0.4 * pixels(k)}
    return {
        "textures": {"photo": image},
        "materials": {
            "paint": {"type": "diffuse", "reflectance": {"texture": "photo"}},
            "tiles": {"type": "principled", "base_color": checks, "roughness": {"texture": "photo", "channel": "g"}},
            "veil": {"type": "diffuse", "opacity": {"type": "image", "data": pixels(k, 1)}},
            "bumpy": {"type": "plastic", "bump_map": heights},
            "dented": {"type": "roughconductor", "alpha": 0.3, "normal_map": normals},
            "coloured": {"type": "diffuse", "reflectance": {"type": "vertex_color"}},
            "screen": {"type": "diffuse", "emission": {"type": "image", "data": 9 * pixels(k)}},
            "sign": {"type": "diffuse", "emission": {**checks, "scale": 2}},
        },
        "shapes": {
            "floor": FLOOR,
            "mesh": {**with_colours(k), "material": "coloured"},
            "curtain": {"type": "rectangle", "material": "veil", "transform": [{"translate": [0, 1, 1.5]}]},
            "bumps": {"type": "sphere", "center": [0.8, 1, 0], "radius": 0.3, "material": "bumpy"},
            "dents": {"type": "sphere", "center": [-0.8, 1, 0], "radius": 0.3, "material": "dented"},
            "tiled": {"type": "disk", "material": "tiles", "transform": [{"translate": [0, 1, -1]}]},
            "lamp": {**LAMP, "material": "screen"},
            "second": {**LAMP, "transform": [{"translate": [0, 1, 5]}], "material": "sign"},
        },
    }


def copied(k):
    """Instances of two meshes, more of them where ``k`` is larger; some are covered in part."""
    copies = {
        f"copy{j}": {
            "type": "instance",
            "of": "mesh" if j % 2 else "other",
            "material": "veil" if j == 1 else "paint",
            "transform": [{"scale": 0.4}, {"translate": [0.7 * j - 1, 0.3 * k, 0.8]}],
        }
        for j in range(2 + k)
    }
    return {
        "materials": {"paint": PAINT, "veil": {"type": "diffuse", "opacity": 0.5}},
        "shapes": {
            "floor": FLOOR,
            "mesh": {**grid(k), "material": "paint"},
            "other": {**grid(k + 1), "material": "paint", "transform": [{"translate": [0, 0.6, -1]}]},
            "lamp": {**LAMP, "emission": [5, 4, 3 + k]},
            **copies,
        },
    }


def many_models(k):
    """Models with tables, factors, nested ones, and one-sided surfaces."""
    return {
        "materials": {
            "paint": {"type": "diffuse", "reflectance": [0.6, 0.5, 0.4], "two_sided": False},
            "lacquer": {"type": "roughplastic", "alpha": 0.1 + 0.05 * k, "nonlinear": True},
            "cloth": {
                "type": "principled",
                "base_color": [0.5, 0.1 * k, 0.2],
                "sheen": 0.5,
                "clearcoat": 0.2 + 0.1 * k,
            },
            "gold": {"type": "roughconductor", "material": "Au", "alpha": 0.2},
            "mixed": {"type": "blend", "a": "lacquer", "b": "gold", "weight": 0.2 + 0.1 * k},
            "sieve": {"type": "blend", "a": "cloth", "b": {"type": "null"}, "weight": 0.3},
            "pane": {"type": "thindielectric"},
        },
        "shapes": {
            "floor": FLOOR,
            **{
                name: {"type": "sphere", "center": [0.5 * j - 1, 0.6, 0.1 * k], "radius": 0.25, "material": name}
                for j, name in enumerate(("lacquer", "cloth", "mixed", "sieve", "pane"))
            },
            **({"more": {"type": "sphere", "center": [0, 1.4, 0], "radius": 0.2, "material": "gold"}}),
            "lamp": {**LAMP, "emission": [5, 4, 3 + k]},
        },
    }


KINDS = [plain, lit, under_the_sky, under_the_sky_alone, grey, textured, copied, many_models]


def same(alone, own):
    """A picture of a batch is that of a single render, with layers and facts."""
    assert torch.equal(own.image, alone.image)
    assert own.layers.keys() == alone.layers.keys()
    assert all(torch.equal(own.layers[name], alone.layers[name]) for name in own.layers)
    for fact in ("rays", "paths", "spp", "truncated_paths", "nonfinite_samples", "clamped", "complete"):
        assert getattr(own, fact) == getattr(alone, fact), fact
    assert own.rays > 0
    assert float(own.image.detach().sum()) > 0


@pytest.mark.parametrize("accel", ("torch", "auto"))
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_scenes_of_one_form(kind, accel, waves):
    scenes = [scene(kind(k)) for k in range(3)]
    batch = torchpt.render_batch(scenes, full=True, accel=accel)
    assert waves == [(3, 3)]
    for s, each in enumerate(scenes):
        same(torchpt.render(each, full=True, accel=accel), batch[s, 0])
    assert not torch.equal(batch.image[0], batch.image[1])


@pytest.mark.parametrize(
    "wishes",
    (
        {"dtype": torch.float64},
        {"integrator": {"type": "path", "light_choice": "tree"}},
        {"integrator": {"type": "path", "light_choice": "uniform", "strategy": "light"}},
        {"integrator": {"type": "path", "strategy": "bsdf", "clamp": 0.4}},
        {"integrator": "direct", "film": {"aovs": ["depth", "albedo", "position", "variance"], "filter": "mitchell"}},
        {"integrator": "aov", "film": {"aovs": ["normal", "object_id", "uv"]}},
        {"sampler": "independent", "spp": 70},
    ),
    ids=str,
)
@pytest.mark.parametrize(
    "kind", (plain, *(pytest.param(kind, marks=pytest.mark.slow, id=kind.__name__) for kind in (lit, textured)))
)
def test_whatever_is_wished(kind, wishes, waves):
    scenes = [scene(kind(k)) for k in range(3)]
    batch = torchpt.render_batch(scenes, full=True, accel="torch", **wishes)
    assert waves == [(3, 3)]
    for s, each in enumerate(scenes):
        same(torchpt.render(each, full=True, accel="torch", **wishes), batch[s, 0])


def test_cameras_and_seeds_too(waves):
    scenes, cameras = [scene(plain(k)) for k in range(2)], [CAMERA, {**CAMERA, "origin": [-2, 1, 3]}]
    seeds = [[1, 2], [3, 1]]
    batch = torchpt.render_batch(scenes, cameras, seed=seeds, full=True)
    assert waves == [(4, 2)]
    for s, each in enumerate(scenes):
        for c, block in enumerate(cameras):
            same(torchpt.render(each.seen_by(block), full=True, seed=seeds[s][c]), batch[s, c])


def test_parameters_of_one_scene(waves):
    each = scene(plain(1))
    poses = each.params["shapes.ball0.to_world"].repeat(3, 1, 1)
    poses[:, 1, 3] += torch.tensor([0.0, 0.1, 0.3])
    params = {"shapes.ball0.to_world": poses, "materials.paint.reflectance": torch.rand(3, 3)}
    batch = torchpt.render_batch(each, params=params, full=True)
    assert waves == [(3, 3)]
    for s in range(3):
        same(torchpt.render(each, params={name: value[s] for name, value in params.items()}, full=True), batch[s, 0])


def test_gradients_are_those_of_single_renders():
    each, colours = scene(plain(1)), torch.rand(2, 3, requires_grad=True)
    batch = torchpt.render_batch(each, params={"materials.paint.reflectance": colours}, seed_grad=7)
    alone = [torchpt.render(each, params={"materials.paint.reflectance": c}, seed_grad=7) for c in colours]
    (found,) = torch.autograd.grad(batch.square().sum(), colours)
    (expected,) = torch.autograd.grad(torch.stack(alone).square().sum(), colours)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0.0)


def test_scenes_of_other_forms_go_apart(waves):
    flat = plain(1)
    flat["shapes"]["mesh"]["face_normals"] = True
    scenes = [scene(each) for each in (plain(0), plain(1), flat, grey(0), grey(1), plain(2))]
    batch = torchpt.render_batch(scenes, full=True)
    assert waves == [(2, 2), (2, 2)]  # and the third and the last alone
    for s, each in enumerate(scenes):
        same(torchpt.render(each, full=True), batch[s, 0])


@pytest.mark.parametrize("far", ([1e6, 0, 0], [0, 0, 0]), ids=("far", "near"))
def test_scenes_with_coordinates_of_their_own_go_apart(far, waves):
    def moved(k):
        shift = [{"translate": [x + 100 * k for x in far]}] if any(far) else []
        floor = {**FLOOR, "transform": FLOOR["transform"] + shift}
        lamp = {**LAMP, "transform": LAMP["transform"] + shift, "emission": 4}
        eye = [a + b + 100 * k if any(far) else a for a, b in zip(CAMERA["origin"], far, strict=True)]
        aim = [a + b + 100 * k if any(far) else a for a, b in zip(CAMERA["target"], far, strict=True)]
        return {
            "camera": {**CAMERA, "origin": eye, "target": aim},
            "materials": {"paint": PAINT},
            "shapes": {"floor": floor, "lamp": lamp},
        }

    scenes = [scene(moved(k)) for k in range(2)]
    batch = torchpt.render_batch(scenes, full=True)
    assert waves == ([] if any(far) else [(2, 2)])
    for s, each in enumerate(scenes):
        same(torchpt.render(each, full=True), batch[s, 0])


def test_what_asks_for_one_scene_in_advance_goes_apart(waves):
    scenes = [scene(under_the_sky(k)) for k in range(2)]
    batch = torchpt.render_batch(scenes, [CAMERA, CAMERA], integrator="ibl", full=True)
    assert waves == [(2, 1), (2, 1)]
    for s, each in enumerate(scenes):
        same(torchpt.render(each, integrator="ibl", full=True), batch[s, 1])


def test_joined_worlds_have_room(waves, monkeypatch):
    scenes = [scene(plain(k)) for k in (0, 0, 1, 1)]
    room = crowd.room_of(wave_of(scenes[3]))
    monkeypatch.setattr(crowd, "ROOM", 2 * room)
    torchpt.render_batch(scenes)
    assert waves == [(2, 2), (2, 2)]
    waves.clear()
    monkeypatch.setattr(shared, "ROOM", room)  # half of it for one
    torchpt.render_batch(scenes)
    assert waves == []
    monkeypatch.setattr(crowd, "ROOM", room - 1)  # which cameras of one scene do not ask for
    torchpt.render_batch(scenes[3], [CAMERA] * 3)
    assert waves == [(3, 1)]


class Netted(torchpt.Bsdf):
    """Diffuse reflection of a colour that a network holds."""

    name = "netted"
    parameters: ClassVar = {}
    delta = transmits = refracts = anisotropic = False

    def __init__(self, colour):
        self.net = torch.nn.Linear(1, 3, bias=False)
        self.set(colour)

    def set(self, colour):
        """Another colour."""
        with torch.no_grad():
            self.net.weight.copy_(torch.tensor(colour)[:, None])

    def eval(self, parameters, wo, wi):
        """Lambert's."""
        return self.net.weight.expand(3, wo.shape[1]) * (wi[2].clamp_min(0) / math.pi) * (wo[2] > 0)

    def pdf(self, parameters, wo, wi):
        """By the cosine."""
        return wi[2].clamp_min(0) / math.pi * (wo[2] > 0)

    def sample(self, parameters, wo, lobe, u):
        """Likewise."""
        wi = cosine_hemisphere(u)
        pdf = self.pdf(parameters, wo, wi)
        weight = self.eval(parameters, wo, wi) / torch.where(pdf > 0, pdf, 1.0)
        return BsdfSample(wi, pdf, weight)


def netted(model):
    """A floor of a model of one's own."""
    blocks = plain(0)
    blocks["materials"]["paint"] = {"type": "netted"}
    base = {
        "camera": CAMERA,
        "film": {"width": 12, "height": 8},
        "render": {"spp": 3, "device": "cpu", "compile": "off"},
    }
    return torchpt.load(base | blocks, bsdfs={"netted": model})


def test_models_of_ones_own_go_apart(waves):
    models = [Netted([0.9, 0.5, 0.1]), Netted([0.1, 0.5, 0.9])]
    scenes = [netted(model) for model in models]
    batch = torchpt.render_batch(scenes, [CAMERA] * 2, full=True)
    assert waves == [(2, 1), (2, 1)]
    for s, each in enumerate(scenes):
        same(torchpt.render(each, full=True), batch[s, 0])


def test_weights_may_change_from_scene_to_scene(waves):
    model, colours = Netted([0.0, 0.0, 0.0]), ([0.9, 0.5, 0.1], [0.1, 0.5, 0.9])

    def scenes():
        for colour in colours:
            model.set(colour)
            yield netted(model)

    batch = torchpt.render_batch(scenes())
    for s, colour in enumerate(colours):
        assert torch.equal(batch[s, 0], torchpt.render(netted(Netted(colour))))


def test_where_memory_runs_out_for_the_next_those_that_wait_are_done_first(waves, monkeypatch):
    scenes, alive, begin = [scene(plain(k)) for k in range(5)], weakref.WeakSet(), Run._begin

    def scarce(run):
        alive.add(run)
        gc.collect()
        if len(alive) > 2:
            raise MemoryError
        begin(run)

    monkeypatch.setattr(Run, "_begin", scarce)
    batch = torchpt.render_batch(scenes, full=True)
    assert waves == [(2, 2), (2, 2)]
    monkeypatch.undo()
    for s, each in enumerate(scenes):
        same(torchpt.render(each, full=True), batch[s, 0])


def test_a_wave_that_fails_by_itself_is_told(monkeypatch, capsys):
    say_once.cache_clear()
    monkeypatch.setattr(union, "joined_world", lambda worlds: 1 / 0)
    scenes = [scene(plain(k)) for k in range(2)]
    batch = torchpt.render_batch(scenes, full=True)
    assert "could share a wave were rendered one by one: ZeroDivisionError" in capsys.readouterr().err
    for s, each in enumerate(scenes):
        same(torchpt.render(each, full=True), batch[s, 0])


def wave_of(each):
    """The wave of a scene as a batch makes it."""
    from torchpt.forward.wave import make_wave
    from torchpt.orders import ordered

    order = ordered(each, False)
    with torch.no_grad():
        return make_wave(each, order.settings, None, torch.float32)


def test_where_memory_runs_out_waves_are_halved(waves, monkeypatch):
    take = crowd.take

    def limited(works):
        if len(works) > 2:
            raise MemoryError
        return take(works)

    monkeypatch.setattr(crowd, "take", limited)
    scenes = [scene(plain(k)) for k in range(4)]
    batch = torchpt.render_batch(scenes, full=True)
    assert waves == [(2, 2), (2, 2)]
    for s, each in enumerate(scenes):
        same(torchpt.render(each, full=True), batch[s, 0])


def test_as_many_are_loaded_as_fill_a_wave(monkeypatch):
    monkeypatch.setitem(crowd.LANES, "cpu", 2 * 12 * 8 * 3)
    told = []

    def scenes():
        for k in range(5):
            told.append(f"load {k}")
            yield scene(plain(k))

    torchpt.render_batch(scenes(), on_progress=lambda done, total: told.append(done))
    assert told == ["load 0", "load 1", "load 2", 1, 2, "load 3", "load 4", 3, 4, 5]


def test_an_error_is_that_of_its_scene(monkeypatch):
    scenes, rays = [scene(plain(k)) for k in range(3)], crowd.Work.rays

    def failing(work):
        if work.wave.stages.world.geometry.counts[3] == 2:
            raise RenderError("broken")
        return rays(work)

    monkeypatch.setattr(crowd.Work, "rays", failing)
    with pytest.raises(RenderError, match=r"^scenes\[1\]: broken"):
        torchpt.render_batch(scenes)


def test_samples_that_are_not_finite_are_those_of_their_scene(waves):
    scenes = [scene(grey(k)) for k in range(3)]
    scenes[1].params["lights.sky.radiance"].fill_(float("nan"))
    scenes[1].check_own = lambda: None  # which refuses that
    batch = torchpt.render_batch(scenes, full=True)
    assert waves == [(3, 3)]
    assert [batch[s, 0].nonfinite_samples > 0 for s in range(3)] == [False, True, False]
    with pytest.raises(RenderError, match=r"^scenes\[1\]: integrator\.strict: sample 0 of pixel"):
        torchpt.render_batch(scenes, integrator={"type": "path", "strict": True})
