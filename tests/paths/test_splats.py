"""Light to pixels other than a sample's own, from an integrator of a user's own, by both engines.

It (``references/mirrored.py``) sends the light that is sampled at surfaces to the pixel on the other side of the picture, so
that the plain picture turned around is what it comes to.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path as File
from typing import Any

import pytest
import torch
from mirrored import KEYS, Mirrored, lights, room
from torch import Tensor

import torchpt
from torchpt.core.memory import MemoryMeter
from torchpt.paths.integrators.kinds.path import Path
from torchpt.paths.state import Shadow, Splat, StageContext, VertexInput, VertexOutput, no_shadow
from torchpt.physics.film.splats import LARGEST, SplatSums
from torchpt.rendering import Progress, render_scene
from torchpt.scene.formats.description import settings

ENGINES = ("off", "on")


class Broken(Mirrored):
    """Splats that are not finite where they are bright."""

    name = "broken"

    def sent(self, light: Shadow) -> Shadow:
        bright = light.radiance > 0.25
        return replace(light, radiance=torch.where(bright, torch.inf, light.radiance))


@pytest.mark.parametrize("opacity", [1.0, 0.5])
@pytest.mark.parametrize("compile", ENGINES)
def test_a_picture_turned_around(compile: str, opacity: float) -> None:
    scene = torchpt.load(room(opacity), "cpu")
    plain = torchpt.render(scene, integrator=Path(**lights()), compile=compile, **KEYS)
    found = torchpt.render(scene, integrator=Mirrored(**lights()), compile=compile, **KEYS)
    # A sample on the border of two pixels may count in the other one.
    off = (found - plain.flip(1)).abs().amax(-1) > 1e-4 * plain.amax()
    assert int(off.sum()) <= 4
    assert float(plain.std()) > 0.01


def test_engines_agree_on_clamp_and_crop() -> None:
    scene = torchpt.load(room(), "cpu")
    film = {"width": 20, "height": 12, "crop": [2, 3, 16, 8], "filter": "box"}
    found = [
        torchpt.render(scene, integrator=Mirrored(**lights(clamp=0.2)), compile=compile, film=film, spp=8, full=True)
        for compile in ENGINES
    ]
    assert float((found[0].image - found[1].image).abs().max()) < 1e-4
    assert found[0].clamped == pytest.approx(found[1].clamped, rel=1e-4)
    assert float(found[0].image.max()) < 3 * 0.2


def test_the_same_bits_over_threads_and_memory() -> None:
    scene = torchpt.load(room(), "cpu")
    ways: list[dict[str, Any]] = [
        {"threads": 1},
        {"threads": 2},
        {"threads": 5},
        {
            "threads": 1,
            "max_memory": MemoryMeter(torch.device("cpu")).above() + (600 << 20),
        },  # what tests before hold counts
    ]
    found = [torchpt.render(scene, integrator=Mirrored(**lights()), compile="on", **KEYS, **way) for way in ways]
    assert all(torch.equal(found[0], other) for other in found[1:])


def test_looking_at_the_picture_on_the_way_changes_nothing() -> None:
    """Sums are brought to one form where they are read, while other threads add to them."""
    scene = torchpt.load(room(), "cpu")
    blocks = {"film": KEYS["film"], "render": {"spp": 256, "threads": 3, "compile": "on"}}
    wishes = settings(scene.description, {**blocks, "integrator": Mirrored(**lights())})
    looks: list[float] = []

    def look(progress: Progress) -> None:
        looks.append(float(progress.snapshot().image.mean()))

    quiet = render_scene(scene, wishes).image
    for _ in range(8):
        assert torch.equal(quiet, render_scene(scene, wishes, look).image)
    assert len(looks) > 3


def test_a_checkpoint_goes_on_to_the_bit(tmp_path: File) -> None:
    scene, file = torchpt.load(room(), "cpu"), str(tmp_path / "half.ckpt")
    keys = {key: value for key, value in KEYS.items() if key != "spp"}
    whole = torchpt.render(scene, integrator=Mirrored(**lights()), spp=8, **keys)
    torchpt.render(scene, integrator=Mirrored(**lights()), spp=5, checkpoint=file, **keys)
    rest = torchpt.render(scene, integrator=Mirrored(**lights()), spp=8, checkpoint=file, resume=True, **keys)
    assert torch.equal(whole, rest)


def test_the_error_of_pictures_with_splats() -> None:
    """The spread of two streams tells the variance: over many pictures it is that of the mean."""
    scene = torchpt.load(room(), "cpu")
    film = {"width": 6, "height": 4, "filter": "box", "aovs": ["variance"]}
    pictures = [
        torchpt.render(scene, spp=4, seed=seed, film=film, integrator=Mirrored(**lights()), full=True)
        for seed in range(48)
    ]
    told = torch.stack([picture.layers["variance"] for picture in pictures]).mean()
    seen = torch.stack([picture.image for picture in pictures]).var(0).mean()
    assert float(told) == pytest.approx(float(seen), rel=0.2)
    assert pictures[0].relmse is not None
    plain = torchpt.render(scene, integrator=Mirrored(**lights()), full=True, **KEYS)
    assert plain.relmse is None
    # Instead of probes all pixels are sampled by two streams.
    told = torchpt.render(
        scene, spp=4, seed=0, film={**film, "aovs": []}, integrator=Mirrored(**lights()), full=True, pilots=True
    )
    assert told.relmse == pictures[0].relmse and torch.equal(told.image, pictures[0].image)


@pytest.mark.parametrize(("opacity", "clamp"), [(1.0, 0.1), (0.5, None)])
@pytest.mark.parametrize("way", [("on", "replay"), ("off", "replay"), ("off", "autograd")], ids="-".join)
def test_gradients_go_to_where_light_came_from(way: tuple[str, str], opacity: float, clamp: float | None) -> None:
    """The cotangent of a pixel reaches the samples of the other side."""
    scene = torchpt.load(room(opacity), "cpu")
    names = ["materials.wall.reflectance", "shapes.lamp.emission"]
    weights = torch.rand(12, 16, 3, generator=torch.Generator().manual_seed(3))

    def gradients(integrator: Path, weights: Tensor) -> list[Tensor]:
        leaves = {name: scene.params[name].clone().requires_grad_() for name in names}
        image = torchpt.render(
            scene, params=leaves, integrator=integrator, compile=way[0], adjoint=way[1], seed_grad=0, **KEYS
        )
        return list(torch.autograd.grad((image * weights).sum(), list(leaves.values())))

    found = gradients(Mirrored(**lights(clamp=clamp)), weights)
    if clamp is None:
        for ours, plain in zip(found, gradients(Path(**lights()), weights.flip(1)), strict=True):
            torch.testing.assert_close(ours, plain, rtol=5e-3, atol=1e-4)
        return
    value, step = scene.params[names[0]], 1e-3

    def loss(reflectance: Tensor) -> Tensor:
        keys = {**KEYS, "compile": way[0]}
        return (
            torchpt.render(scene, params={names[0]: reflectance}, integrator=Mirrored(**lights(clamp=clamp)), **keys)
            * weights
        ).sum()

    with torch.no_grad():
        slope = (loss(value + step) - loss(value - step)) / (2 * step)
    assert float(found[0].sum()) == pytest.approx(float(slope), rel=2e-2)


@pytest.mark.parametrize("compile", ENGINES)
def test_splats_that_are_not_finite_are_counted(compile: str) -> None:
    scene = torchpt.load(room(), "cpu")
    found = torchpt.render(scene, integrator=Broken(**lights()), compile=compile, full=True, **KEYS)
    assert 0 < found.nonfinite_samples <= 16 * 12 * 8
    assert bool(torch.isfinite(found.image).all())


def test_what_does_not_go_with_splats_is_refused() -> None:
    scene = torchpt.load(room(), "cpu")
    wishes: list[dict[str, Any]] = [{"target_error": 0.1}, {"sampler": {"type": "sobol", "adaptive": True}}]
    for more in wishes:
        with pytest.raises(torchpt.SceneError, match="light their own pixels"):
            torchpt.render(scene, integrator=Mirrored(), **{**KEYS, **more})
    pose = scene.params["shapes.ball.to_world"].clone().requires_grad_()
    with pytest.raises(torchpt.NotBuiltError, match="light their own pixels"):
        torchpt.render(scene, params={"shapes.ball.to_world": pose}, integrator=Mirrored(), **KEYS).sum().backward()

    class Undeclared(Path):
        name = "undeclared"

        def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
            output = super().bounce(context, model, vertex)
            return replace(output, splat=Splat(vertex.state.lane, no_shadow(vertex.state)))

    for compile in ENGINES:
        with pytest.raises(torchpt.SceneError, match=r"integrator\.splats"):
            torchpt.render(scene, integrator=Undeclared(), compile=compile, **KEYS)


def test_sums_of_splats_are_exact_in_any_order() -> None:
    rng = torch.Generator().manual_seed(1)
    n, pixels, streams = 20000, 7, 2
    value = torch.randn(3, n, generator=rng) * 10.0 ** (torch.rand(1, n, generator=rng) * 24 - 12)
    pixel = torch.randint(pixels, (n,), generator=rng)
    stream = torch.randint(streams, (n,), generator=rng)
    order = torch.randperm(n, generator=rng)
    one, other, third = (SplatSums(pixels, streams, torch.device("cpu")) for _ in range(3))
    one.add(stream, pixel, value)
    for part in order.split(3001):
        other.add(stream[part], pixel[part], value[:, part])
        sums, place, total = third.writes_of_add(stream[part], pixel[part], value[:, part])
        sums.index_copy_(2, place, total)
    assert torch.equal(one.state(), other.state()) and torch.equal(one.state(), third.state())
    for s in range(streams):
        for p in range(pixels):
            of = value[1, (pixel == p) & (stream == s)].tolist()
            exact = sum((Fraction(v) for v in of), Fraction(0))
            # what lies below 2**-72 of a term is cut off
            assert abs(Fraction(float(one.values(s)[1, p])) - exact) <= abs(exact) * Fraction(1, 2**52) + n * Fraction(
                1, 2**72
            )
    big = torch.full((3, 1), LARGEST / 2)
    for _ in range(100):
        one.add(torch.tensor([0]), torch.tensor([0]), big)
    assert float(one.values(0)[0, 0]) == pytest.approx(100 * LARGEST / 2, rel=1e-3)
