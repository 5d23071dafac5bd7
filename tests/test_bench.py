"""The scenes of the benchmark beside Mitsuba 3: both sides render the same, and what is replaced is said."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import bench_figures
import bench_workers
import numpy as np
import pytest
import torch
from trials import chi_square_p, z_limit

import torchpt
from torchpt.rendering.api import render_scene
from torchpt.scene import Scene
from torchpt.scene.formats.description import settings

SCRIPTS = Path(__file__).parent.parent / "scripts"
CAMERA = {"origin": [0, 1.4, 4.2], "target": [0, 0.6, 0], "fov": 45}
#: One of everything that is replaced.
LACKING: dict[str, Any] = {
    "camera": {**CAMERA, "type": "thinlens", "aperture_radius": 0.05, "focus_distance": 4, "blades": 6},
    "materials": {
        "phong": {"type": "phong", "diffuse": [0.2, 0.3, 0.5], "specular": 0.2, "exponent": 20},
        "blinn": {"type": "blinn_phong", "diffuse": [0.2, 0.3, 0.1], "specular": 0.05, "exponent": 60},
        "paint": {"type": "nonmetal", "base_color": [0.6, 0.3, 0.2], "roughness": 0.5},
        "course": {"type": "microfacet", "diffuse": [0.3, 0.2, 0.5], "roughness": 0.6},
        "metal": {"type": "roughconductor", "reflectance": [0.9, 0.7, 0.4], "alpha": 0.3, "energy_compensation": True},
        "worn": {"type": "blend", "a": "phong", "b": {"type": "nonmetal"}, "weight": 0.5},
    },
    "shapes": {
        "floor": {
            "type": "rectangle",
            "material": "course",
            "transform": [{"scale": 5}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
        },
        "cone": {"type": "cone", "apex": [-1.2, 1.2, 0], "height": -1.1, "slope": 0.4, "material": "metal"},
        "tilted": {
            "type": "cone",
            "height": 1,
            "slope": 0.4,
            "material": "paint",
            "transform": [{"rotate": {"axis": [0, 0, 1], "angle": 35}}, {"translate": [-0.5, 0.2, 0.6]}],
        },
        "ball": {"type": "sphere", "center": [0.3, 0.4, -0.2], "radius": 0.4, "material": "blinn"},
        "small": {"type": "sphere", "center": [0.6, 0.2, 0.7], "radius": 0.2, "material": "worn"},
        "block": {
            "type": "cube",
            "material": "phong",
            "transform": [{"scale": 0.2}, {"translate": [1.2, 0.2, 0]}],
        },
        "another": {"type": "instance", "of": "block", "transform": [{"scale": 0.2}, {"translate": [1.2, 0.8, 0]}]},
    },
    "lights": {"sky": {"type": "constant", "radiance": [0.5, 0.6, 0.8]}},
}
REPLACED = {
    "camera", "materials.phong", "materials.blinn", "materials.paint", "materials.course", "materials.metal",
    "materials.metal.energy_compensation", "materials.worn.b", "shapes.cone", "shapes.tilted", "shapes.another",
}  # fmt: skip


@pytest.fixture
def scripts(monkeypatch):
    """The modules ``mitsuba_scene``, ``compare_mitsuba`` and ``bench_mitsuba``."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    for name in ("mitsuba_scene", "compare_mitsuba", "bench_mitsuba"):
        sys.modules.pop(name, None)
    import bench_mitsuba
    import compare_mitsuba
    import mitsuba_scene

    return mitsuba_scene, compare_mitsuba, bench_mitsuba


def lacking() -> Scene:
    return torchpt.load(LACKING, device="cpu")


def test_what_is_replaced_is_said(scripts):
    mitsuba_scene, _, _ = scripts
    assert set(mitsuba_scene.replacements(lacking())) == REPLACED
    assert mitsuba_scene.replacements(mitsuba_scene.nearest(lacking())) == {}
    scene = torchpt.load("cornell_box", device="cpu")
    assert mitsuba_scene.nearest(scene) is scene


def test_no_shape_is_dropped(scripts):
    mitsuba_scene, _, _ = scripts
    near = mitsuba_scene.nearest(lacking())
    assert near.built.copies == ()
    assert {part.shape for part in near.built.parts} == set(LACKING["shapes"])


def test_a_mesh_stands_where_its_cone_stood(scripts):
    mitsuba_scene, _, _ = scripts
    film = {"width": 64, "height": 64, "filter": "box", "aovs": ["object_id", "normal"]}
    pinhole = {**LACKING, "camera": CAMERA}
    layers = [
        render_scene(scene, settings(scene.description, wishes)).layers
        for scene in (torchpt.load(pinhole, device="cpu"), mitsuba_scene.nearest(torchpt.load(pinhole, device="cpu")))
        for wishes in [{"film": film, "integrator": {"type": "aov"}, "render": {"spp": 1}}]
    ]
    same = layers[0]["object_id"] == layers[1]["object_id"]
    assert float(same.double().mean()) > 0.995
    apart = (layers[0]["normal"] - layers[1]["normal"]).norm(dim=-1)[same[..., 0]]
    assert float((apart > 0.02).double().mean()) < 0.005


def test_deviates_of_equal_and_of_unequal_pictures(scripts):
    _, compare_mitsuba, bench_mitsuba = scripts
    g = torch.Generator().manual_seed(1)
    a, b = (1 + 0.2 * torch.randn(64, 32, 32, 3, generator=g, dtype=torch.float64) for _ in range(2))
    same, brighter = compare_mitsuba.deviates(a, b), compare_mitsuba.deviates(1.01 * a, b)
    assert same.blocks.shape == (4, 4, 3)
    assert abs(compare_mitsuba.worst(same.whole)) < z_limit(3) < abs(compare_mitsuba.worst(brighter.whole))
    means = [stack.mean((1, 2)).tolist() for stack in (a, b)]
    assert bench_mitsuba.deviate(*means) == pytest.approx(compare_mitsuba.worst(same.whole), rel=1e-6)


def test_means_are_of_complete_groups():
    assert set(bench_figures.SCENES) == {name for group in bench_figures.GROUPS.values() for name in group}
    assert len(bench_figures.SCENES) == 10
    ratios = dict.fromkeys(bench_figures.SIMPLE, 2.0) | {"cornell_box": 0.5, "clutter": 9.0}
    assert bench_figures.geometric_means(ratios) == {"simple": pytest.approx(2**0.5)}


@pytest.mark.mitsuba
@pytest.mark.parametrize("name", ["cornell_box", "lacking"])
def test_both_render_the_same(scripts, name):
    mitsuba_scene, compare_mitsuba, _ = scripts
    mitsuba = mitsuba_scene.load_mitsuba("scalar_rgb")
    scene = mitsuba_scene.nearest(lacking() if name == "lacking" else name)
    found = compare_mitsuba.compare(mitsuba, scene, 32, 32, 12)
    assert abs(compare_mitsuba.worst(found.whole)) < 1.2 * z_limit(3)  # variances of 12 pictures: wider than normal
    assert abs(compare_mitsuba.worst(found.blocks)) < 1.3 * z_limit(found.blocks.numel())
    for channel in found.blocks.permute(2, 0, 1):
        assert chi_square_p(float(channel.square().sum()), channel.numel()) > 1e-4
    assert float((found.ours.mean() / found.theirs.mean() - 1).abs()) < 0.01


@pytest.mark.mitsuba
@pytest.mark.parametrize(("engine", "sampler", "taken"), [
    ("torchpt", None, 7), ("scalar_rgb", None, 7), ("scalar_rgb", "multijitter", 8),
])  # fmt: skip
def test_a_turn_of_the_benchmark(engine, sampler, taken, tmp_path):
    given = argparse.Namespace(
        scene="cornell_box", engine=engine, sampler=sampler, size=16, spp=2, compile="off", threads=1, device="cpu"
    )
    shoot = (bench_workers.torchpt if engine == "torchpt" else bench_workers.mitsuba)(given)
    turn = bench_workers.timed(shoot, 16, 7, 1, str(tmp_path / "picture.npy"))
    assert turn["spp"] == taken and turn["seconds"] > 0
    assert turn["rate"] == pytest.approx(16 * 16 * taken / turn["seconds"] / 1e6)
    picture = np.load(tmp_path / "picture.npy", allow_pickle=False)
    assert picture.shape == (16, 16, 3)
    assert turn["mean"] == pytest.approx(picture.mean((0, 1)), rel=1e-5)
    assert not np.array_equal(picture, shoot(7, 2)[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["bench_gradients", "bench_projective", "gradient_pairs", "gradient_tasks", "measure_features"]
)
def test_scripts_find_what_they_share_with_tests(name, tmp_path):
    """Started as the docs say, by their path and nothing else."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    script = [sys.executable, str(SCRIPTS / f"{name}.py"), "--help"]
    done = subprocess.run(script, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stdout.startswith("usage: "), done.stderr[-500:]
