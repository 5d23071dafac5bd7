"""Samples that are not finite: counted by cause in all ways in which renders run, and found again by the eager stages."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.core.errors import RenderError
from torchpt.paths.nonfinite import KEPT, NonFinite, SampleId
from torchpt.paths.wave import PixelSet
from torchpt.physics.bsdfs.kinds.diffuse import Diffuse
from torchpt.physics.bsdfs.records import BsdfSample
from torchpt.physics.samplers import Randomizations
from torchpt.rendering.api import Rendering, render_scene
from torchpt.scene.formats.description import settings

#: How a render may run: by tensor operations, as the loop with the search inside its stages, as the loop with a tree.
WAYS = {"eager": ("off", "auto"), "packets": ("on", "brute"), "numba": ("on", "numba")}


def scene_of(bsdfs: Any = None, **blocks: Any) -> torchpt.Scene:
    """A ball above another one, before the camera, with models ``own``; blocks of the scene file in place of its own."""
    plain: dict[str, Any] = {
        "camera": {"origin": [0, 0, -4], "target": [0, 0, 0]},
        "materials": {"white": {"type": "diffuse"}},
        "shapes": {
            "ball": {"type": "sphere", "material": "white"},
            "ground": {"type": "sphere", "center": [0, -101, 0], "radius": 100, "material": "white"},
        },
        "film": {"width": 16, "height": 12, "filter": "box"},
        "render": {"spp": 4},
    }
    return torchpt.load({**plain, **blocks}, "cpu", bsdfs=bsdfs)


def rendered(
    scene: torchpt.Scene, way: str = "eager", integrator: Any = None, film: Any = None, **render: Any
) -> Rendering:
    compile, accel = WAYS[way]
    wish = {
        "integrator": integrator or {},
        "film": film or {},
        "render": {"compile": compile, "accel": accel, **render},
    }
    return render_scene(scene, settings(scene.description, wish))


#: A light so near to the ball that its density overflows there.
NEAR = {"lights": {"near": {"type": "point", "position": [0, 0, -1.01], "intensity": 3e38}}}
#: One that overflows nearly everywhere on the ball, where that is of the model below.
GLARING = {"lights": {"glare": {"type": "point", "position": [0, 0, -3], "intensity": 1e20}}}


class Strong(Diffuse):
    """Reflects far more than it gets."""

    name = "strong"
    by = 1e30

    def eval_pdf(self, parameters: Any, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        value, pdf = super().eval_pdf(parameters, wo, wi)
        return value * self.by, pdf

    def sample(self, parameters: Any, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        drawn = super().sample(parameters, wo, lobe, u)
        return replace(drawn, weight=drawn.weight * self.by)


class Lame(Diffuse):
    """Draws some directions with a weight that is NaN."""

    name = "lame"

    def sample(self, parameters: Any, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        drawn = super().sample(parameters, wo, lobe, u)
        return replace(drawn, weight=torch.where(u[0] < 0.1, torch.nan, drawn.weight))


class Broken(Diffuse):
    """Has no value for light from straight above."""

    name = "broken"

    def eval_pdf(self, parameters: Any, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        value, pdf = super().eval_pdf(parameters, wo, wi)
        return torch.where(wi[2] > 0.9, torch.nan, value), pdf


def strong(**blocks: Any) -> torchpt.Scene:
    return scene_of({"own": Strong()}, **{"materials": {"white": {"type": "own"}}, **blocks})


@pytest.mark.parametrize("way", WAYS)
def test_a_light_that_overflows_is_the_cause(way):
    found = rendered(scene_of(**NEAR), way)
    assert 0 < found.nonfinite_samples < KEPT
    assert found.nonfinite_causes == {"infinite light": found.nonfinite_samples}
    assert re.fullmatch(
        r"sample \d of pixel \(\d+, \d+\): infinite light at depth 1 \(shape ball, material white\)",
        found.nonfinite_first,
    )
    assert bool(torch.isfinite(found.image).all())


@pytest.mark.parametrize("way", WAYS)
def test_a_model_without_a_value_is_the_cause(way):
    sun = {"lights": {"sun": {"type": "directional", "direction": [0, 0, 1], "irradiance": 1}}}
    found = rendered(scene_of({"own": Broken()}, materials={"white": {"type": "own"}}, **sun), way, spp=1)
    assert found.nonfinite_causes == {"nan bsdf": found.nonfinite_samples} and found.nonfinite_samples
    assert found.nonfinite_first.endswith("nan bsdf at depth 1 (shape ball, material white)")


@pytest.mark.parametrize("light", ["constant", "directional"])
@pytest.mark.parametrize("way", WAYS)
def test_a_path_does_not_end_unseen(way, light):
    """NaN is greater than nothing, so a path that carries it ends: not as if it carried no light."""
    values = {"radiance": 1} if light == "constant" else {"irradiance": 1, "direction": [0, -1, 1]}
    scene = scene_of({"own": Lame()}, materials={"white": {"type": "own"}}, lights={"light": {"type": light, **values}})
    found, eager = rendered(scene, way, spp=1), rendered(scene, spp=1)
    assert found.nonfinite_causes == {"nan bsdf": found.nonfinite_samples}
    assert found.nonfinite_samples == eager.nonfinite_samples > 5


@pytest.mark.parametrize("way", WAYS)
def test_all_ways_find_the_same_samples(way):
    eager, other = rendered(scene_of(**NEAR)), rendered(scene_of(**NEAR), way)
    assert (other.nonfinite_samples, other.nonfinite_first) == (eager.nonfinite_samples, eager.nonfinite_first)


@pytest.mark.parametrize("way", WAYS)
def test_only_the_first_ones_are_traced_again(way):
    found = rendered(strong(**GLARING), way, film={"width": 48, "height": 40})
    assert found.nonfinite_samples > 2 * KEPT
    assert sum(found.nonfinite_causes.values()) == found.nonfinite_samples
    traced = {name: count for name, count in found.nonfinite_causes.items() if "not traced" not in name}
    assert sum(traced.values()) == KEPT and traced == {"infinite light": KEPT}


def test_threads_keep_the_same_ones():
    one, two = (rendered(strong(**GLARING), "packets", film={"width": 64, "height": 48}, threads=n) for n in (1, 2))
    assert one.nonfinite_causes == two.nonfinite_causes and one.nonfinite_first == two.nonfinite_first


def test_what_the_path_carries_may_overflow():
    found = rendered(strong(lights={"sky": {"type": "constant", "radiance": 1e-20}}), spp=1)
    assert found.nonfinite_causes.keys() == {"infinite throughput", "infinite light"}
    assert "at depth 2" in found.nonfinite_first


def test_light_that_is_met_may_overflow():
    around = {"lights": {"sky": {"type": "constant", "radiance": 1e10}}}
    found = rendered(strong(**around), integrator={"max_depth": 2, "strategy": "bsdf"}, spp=1, film={"width": 8})
    assert found.nonfinite_causes == {"infinite environment": found.nonfinite_samples} and found.nonfinite_samples
    lamp = {"type": "sphere", "center": [0, 0, 0], "radius": 50, "flip_normals": True, "material": "glow"}
    shapes = {"ball": {"type": "sphere", "material": "white"}, "lamp": lamp}
    materials = {"white": {"type": "own"}, "glow": {"type": "diffuse", "emission": 1e10}}
    scene = strong(shapes=shapes, materials=materials)
    found = rendered(scene, integrator={"max_depth": 2, "strategy": "bsdf"}, spp=1, film={"width": 8, "height": 8})
    assert found.nonfinite_causes == {"infinite emission": found.nonfinite_samples} and found.nonfinite_samples
    assert found.nonfinite_first.endswith("infinite emission at depth 2 (shape lamp, material glow)")


def test_a_texture_may_be_the_cause():
    texture = {"type": "checkerboard", "color0": 0.5, "color1": 0.25, "scale": 8}
    materials = {"white": {"type": "diffuse", "reflectance": {"texture": "squares"}}}
    scene = scene_of(
        textures={"squares": texture}, materials=materials, lights={"sky": {"type": "constant", "radiance": 1}}
    )
    scene.params["textures.squares.color1"].fill_(torch.nan)
    found = rendered(scene, spp=1, film={"width": 8})
    assert found.nonfinite_causes == {"nan texture": found.nonfinite_samples} and found.nonfinite_samples


def test_a_sum_may_overflow():
    shapes = {"ball": {"type": "sphere", "material": "glow"}}
    materials = {"glow": {"type": "own", "emission": 3e38}}
    sun = {"sun": {"type": "directional", "direction": [0, 0, 1], "irradiance": 5e8}}
    scene = strong(shapes=shapes, materials=materials, lights=sun)
    found = rendered(scene, integrator={"max_depth": 2, "light_choice": "uniform"}, spp=1)
    assert found.nonfinite_causes == {"infinite sum": found.nonfinite_samples} and found.nonfinite_samples


def test_previews_have_causes_too():
    found = rendered(scene_of(**NEAR), "packets", {"type": "ibl"})
    assert found.nonfinite_causes == {"infinite light": found.nonfinite_samples} and found.nonfinite_samples


def test_pilots_are_among_them():
    film = {"width": 48, "height": 40}
    plain, known = (rendered(strong(**GLARING), "packets", film=film, pilots=on) for on in (False, True))
    assert known.nonfinite_samples > plain.nonfinite_samples
    assert sum(known.nonfinite_causes.values()) == known.nonfinite_samples
    assert "not repeated" not in known.nonfinite_causes


def test_a_healthy_picture_has_none():
    found = rendered(scene_of(lights={"sky": {"type": "constant", "radiance": 1}}))
    assert "nonfinite_causes" not in found.header()
    assert (found.nonfinite_samples, found.nonfinite_causes, found.nonfinite_first) == (0, {}, "")
    assert not {"nonfinite_causes", "nonfinite_first"} & found.summary().keys()


def test_the_summary_and_the_table_tell_them():
    found = rendered(scene_of(**NEAR))
    assert found.summary()["nonfinite_causes"] == found.nonfinite_causes
    assert found.summary()["nonfinite_first"] == found.nonfinite_first
    count = found.nonfinite_samples
    assert found.header()["nonfinite_causes"] == f"{count} infinite light"
    assert f"samples not finite: {count} (infinite light: " in repr(found)


# -- strict


@pytest.mark.parametrize("clamp", [None, 2.0])
@pytest.mark.parametrize("way", WAYS)
def test_strict_tells_pixel_sample_depth_and_cause(way, clamp):
    film = {"crop": [4, 3, 9, 8]}
    with pytest.raises(RenderError) as error:
        rendered(scene_of(**NEAR), way, {"strict": True, "clamp": clamp}, film)
    found = re.fullmatch(
        r"integrator.strict: sample (\d+) of pixel \((\d+), (\d+)\) is not finite: "
        r"infinite light at depth 1 \(shape ball, material white\)",
        str(error.value),
    )
    assert found is not None, error.value
    first = rendered(scene_of(**NEAR), "eager", film=film).nonfinite_first
    assert first.startswith(f"sample {found[1]} of pixel ({found[2]}, {found[3]}): ")


@pytest.mark.parametrize("way", WAYS)
def test_strict_lets_a_healthy_picture_pass(way):
    sky = {"lights": {"sky": {"type": "constant", "radiance": 1}}}
    plain, strict = (rendered(scene_of(**sky), way, {"strict": on}) for on in (False, True))
    assert torch.equal(plain.image, strict.image)


@pytest.mark.parametrize("way", WAYS)
def test_under_a_clamp_they_are_counted_too(way):
    plain, clamped = (rendered(scene_of(**NEAR), way, {"clamp": clamp}) for clamp in (None, 2.0))
    assert clamped.nonfinite_causes == plain.nonfinite_causes and clamped.nonfinite_samples
    assert clamped.clamped is not None and 0 < clamped.clamped <= 1


# -- which are kept


def test_a_checkpoint_keeps_them(tmp_path: Path):
    whole = rendered(scene_of(**NEAR), spp=8)
    path, resumed = str(tmp_path / "a.ckpt"), None

    def stop(progress: torchpt.rendering.api.Progress) -> bool:
        return progress.done >= progress.total / 2

    scene = scene_of(**NEAR)
    for resume in (False, True):
        wish = {"render": {"spp": 8, "compile": "off", "checkpoint": path, "resume": resume}}
        resumed = render_scene(scene, settings(scene.description, wish), None if resume else stop)
    assert resumed is not None and resumed.nonfinite_samples == whole.nonfinite_samples
    assert resumed.nonfinite_causes == whole.nonfinite_causes and resumed.nonfinite_first == whole.nonfinite_first


def test_the_first_ones_are_kept_in_order():
    values = torch.zeros(3, 4, 30)
    values[0, 1, 2], values[1, 3, 29], values[2, 1, 2] = torch.inf, torch.nan, -torch.inf
    lost = NonFinite.of(values, 10, 5, (3, 2, 16, 12))
    assert (lost.nan, lost.infinite, lost.count) == (1, 1, 2)
    assert lost.samples == [SampleId(6, 2, 15, nan=False), SampleId(8, 4, 10, nan=True)]
    assert str(lost.samples[0]) == "sample 6 of pixel (15, 2)"
    chosen = PixelSet(
        torchpt.physics.film.Film(30, 1, 1, torch.device("cpu")), {}, Randomizations(2, 3), torch.arange(100, 140)
    )
    (first, _) = NonFinite.of(values, 10, 5, (3, 2, 16, 12), chosen).samples
    assert (first.x, first.y, first.first_randomization, first.randomizations) == (112 % 16 + 3, 112 // 16 + 2, 2, 3)
    assert NonFinite.read(lost.plain()) == lost


def test_no_more_are_kept_than_are_traced():
    lost = NonFinite()
    for sample in (9, 3):
        lost.add(NonFinite.of(torch.full((3, 1, 50), torch.nan), 0, sample, (0, 0, 50, 1)))
    assert lost.count == 100 and len(lost.samples) == KEPT
    assert [place.sample for place in lost.samples] == [3] * 50 + [9] * (KEPT - 50)
    pilots = PixelSet(torchpt.physics.film.Film(50, 1, 1, torch.device("cpu")), {}, Randomizations(1, 1))
    lost.add(NonFinite.of(torch.full((3, 1, 50), torch.nan), 0, 0, (0, 0, 50, 1), pilots))
    assert lost.count == 150 and {place.first_randomization for place in lost.samples} == {0}, (
        "paths of the picture can be looked at"
    )


@pytest.mark.parametrize(
    "facts",
    [None, 3, {}, {"nan": -1, "infinite": 0, "places": []}, {"nan": 1, "infinite": 0, "places": [[0, 0, 0, 0, 1]]},
     {"nan": 1, "infinite": 0, "places": [[0, 0, "a", 0, 1, True]]}, {"nan": 1, "infinite": 0, "places": 7}],
)  # fmt: skip
def test_what_a_checkpoint_says_of_lost_samples_is_held_against_its_form(facts: Any) -> None:
    with pytest.raises(ValueError, match="lost samples"):
        NonFinite.read(facts)
    whole = NonFinite(2, 1, [SampleId(1, 2, 3, 0, 1, True)])
    assert NonFinite.read(whole.plain()) == whole
