"""What every kind of texture holds to. One more kind is one more row of ``ROWS``."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.compiler.function import compile_lanewise
from torchpt.core.errors import SceneError
from torchpt.math.vectors import luminance
from torchpt.physics.parts import Parameters
from torchpt.physics.textures import KINDS, Node, Table, TexturePoint
from torchpt.scene.formats.cameras import read_camera
from torchpt.scene.formats.description import Description
from torchpt.scene.formats.textures import texture_of
from torchpt.scene.texture_loader import TextureLoader
from torchpt.spec import Color, Moves, Scalar, Spec, Texels, parameters_of
from torchpt.spec.schema import read_typed

CPU = torch.device("cpu")
COLOUR = Color((0.0, 0.0, 0.0), low=0.0, high=1.0, texture=True)
NUMBER = Scalar(0.0, low=0.0, high=1.0, texture=True)
HEIGHT = Scalar(0.0, low=None, texture=True)
TURN = {"scale": [1.5, 0.75], "rotate": 30.0, "translate": [0.2, -0.4]}
SHEAR = {"matrix": [[1.3, 0.4, 0.2], [-0.3, 0.9, -0.4]]}
MATRIX = (
    (1.5 * math.cos(math.pi / 6), -0.75 * math.sin(math.pi / 6), 0.2),
    (1.5 * math.sin(math.pi / 6), 0.75 * math.cos(math.pi / 6), -0.4),
)


@dataclass(frozen=True)
class Row:
    """A kind under test.

    Attributes:
        entry: as in a scene file; PATH stands for an image of 3 x 2 texels.
        known: colours at points (u, v).
        refused: by parameter, a value that no file may hold.
        beyond: by parameter of ``scene.params``, a value that no render may be given where a number in 0..1 is wanted.
        filters: what makes it average over footprints; empty where nothing does.
        side: of a square footprint that covers some detail.
        smooth: whether values between edges change, so that a slope can be told.
    """

    entry: dict[str, Any]
    known: dict[tuple[float, float], tuple[float, float, float]]
    refused: dict[str, Any]
    beyond: dict[str, float] = field(default_factory=dict)
    filters: dict[str, Any] = field(default_factory=dict)
    side: float = 0.3
    smooth: bool = True


TEXELS = torch.tensor(
    [[[0.1, 0.2, 0.3], [0.9, 0.5, 0.7], [0.3, 0.8, 0.4]], [[0.6, 0.1, 0.5], [0.2, 0.7, 0.9], [0.8, 0.4, 0.2]]]
)
ROWS: dict[str, Row] = {
    "image": Row(
        {"path": "PATH"},
        {(0.5 / 3, 0.25): (0.1, 0.2, 0.3), (1.0 / 3, 0.25): (0.5, 0.35, 0.5), (2.5 / 3, -0.25): (0.8, 0.4, 0.2)},
        {
            "path": 3, "data": [[1], [2, 3]], "wrap": "around", "filter": "cubic", "colorspace": "xyz", "clamp": 2,
            "scale": "big", "channel": "z", "max_pixels": 0, "uv_transform": {"rotate": "left"},
        },
        {"": 1.01},
        {"filter": "trilinear"},
        0.8,
    ),
    "checkerboard": Row(
        {"color0": [0.9, 0.2, 0.1], "color1": [0.1, 0.3, 0.8], "scale": [2, 1]},
        {(0.1, 0.1): (0.9, 0.2, 0.1), (0.3, 0.1): (0.1, 0.3, 0.8), (0.3, 0.6): (0.9, 0.2, 0.1), (-0.1, 0.1): (0.1, 0.3, 0.8)},
        {"color0": -1, "color1": [1, 2], "scale": "two", "filter": "bilinear", "uv_transform": 2},
        {".color0": 1.01, ".color1": -0.01},
        {"filter": "trilinear"},
        0.5,
        smooth=False,
    ),
    "vertex_color": Row({}, {}, {}),
    "noise": Row(
        {"color0": [0.9, 0.2, 0.1], "color1": [0.1, 0.3, 0.8], "scale": 3, "octaves": 3, "seed": 5},
        # At the first octave's grid the others alone speak: with none it is the mean.
        {},
        {
            "color0": "red", "color1": math.inf, "scale": 0, "octaves": 17, "persistence": 1.5, "lacunarity": 0.5, "seed": -1,
            "filter": "trilinear", "uv_transform": {"turn": 3},
        },
        {".color0": 1.01, ".color1": -0.01, ".scale": 0.0, ".persistence": 1.01, ".lacunarity": 0.9},
        {"filter": "fade"},
    ),
}  # fmt: skip
#: Finds files by their absolute paths.
DESCRIPTION = Description(
    None, Path("/"), read_camera({"type": "perspective", "origin": [0, 0, 1], "target": [0, 0, 0]}, {}, None)
)
MAPPED = [name for name in ROWS if KINDS[name].reads == "uv"]
FILTERED = [name for name in ROWS if ROWS[name].filters]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("contract") / "a.exr"
    torchpt.write_image(file, TEXELS)
    return str(file)


Opened = tuple[Node, dict[str, Tensor], dict[str, Spec]]


@pytest.fixture
def opened(path: str) -> Callable[..., Opened]:
    """A kind's row as a slot opens it: its node, parameters in float64, and their specs."""

    def make(name: str, spec: Spec = COLOUR, *, named: str | None = None, **more: Any) -> Opened:
        entry, parameters = entry_of(name, path, **more), Parameters()
        textures = {"t": read_typed("texture", KINDS, entry, "t", None)}
        opener = TextureLoader(textures, DESCRIPTION, parameters)
        node = opener(texture_of({"texture": "t", "channel": named} if named else entry, spec), "slot")
        given = {key: torch.from_numpy(np.asarray(value, np.float64)) for key, value in parameters.items()}
        return node, given, parameters.specs

    return make


def table_of(found: Opened, dtype: torch.dtype = torch.float64) -> Table:
    node, given, _ = found
    return node.table([node], given, dtype, CPU)


def points(n: int = 300, dtype: torch.dtype = torch.float64, footprint: Tensor | None = None) -> TexturePoint:
    generator = torch.Generator().manual_seed(5)
    uv = torch.rand(2, n, generator=generator, dtype=torch.float64) * 4 - 2
    colors = torch.rand(3, n, generator=generator, dtype=torch.float64)
    return TexturePoint(uv.to(dtype), footprint, colors.to(dtype))


def read(table: Table, point: TexturePoint, coloured: bool = True) -> Tensor:
    assert point.uv is not None
    return table.look_up(torch.zeros(point.uv.shape[1], dtype=torch.int64), point, coloured=coloured)


def inclines(table: Table, point: TexturePoint) -> Tensor:
    assert point.uv is not None
    return torch.stack(table.slope(torch.zeros(point.uv.shape[1], dtype=torch.int64), point))


def test_every_kind_has_a_row():
    assert set(ROWS) == set(KINDS)


@pytest.mark.parametrize("name", ROWS)
def test_known_points(name: str, opened: Callable[..., Opened]):
    table = table_of(opened(name))
    for at, expected in ROWS[name].known.items():
        value = read(table, TexturePoint(torch.tensor(at, dtype=torch.float64)[:, None]))
        assert value[:, 0].tolist() == pytest.approx(expected, abs=1e-6), at


@pytest.mark.parametrize("name", ROWS)
def test_a_number_is_a_channel_of_the_colour(name: str, opened: Callable[..., Opened]):
    point = points()
    colour = read(table_of(opened(name)), point)
    assert colour.shape == (3, 300) and float((colour[0] - colour[1]).abs().max()) > 0.1
    expected = {"luminance": luminance(colour), **dict(zip("rgb", colour, strict=True))}
    for channel, values in expected.items():
        table = table_of(opened(name, NUMBER, named=channel))
        assert torch.allclose(read(table, point, False), values, atol=1e-6), channel


@pytest.mark.parametrize(("transform", "rows"), [(TURN, MATRIX), (SHEAR, SHEAR["matrix"])], ids=["parts", "matrix"])
@pytest.mark.parametrize("name", MAPPED)
def test_the_transform_moves_the_coordinates(name: str, transform: Any, rows: Any, opened: Callable[..., Opened]):
    plain, turned = table_of(opened(name)), table_of(opened(name, uv_transform=transform))
    point = points()
    assert point.uv is not None
    (a, b, c), (d, e, f) = rows
    u, v = point.uv
    moved = TexturePoint(torch.stack((a * u + b * v + c, d * u + e * v + f)))
    assert torch.allclose(read(turned, point), read(plain, moved), atol=1e-9)
    assert float((read(turned, point) - read(plain, point)).abs().max()) > 0.1


@pytest.mark.parametrize("transform", [TURN, SHEAR], ids=["parts", "matrix"])
@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("name", MAPPED)
def test_the_slope_is_the_derivative(name: str, wide: bool, transform: Any, opened: Callable[..., Opened]):
    """Of what is read at points, and of what a footprint leaves of it."""
    filters = ROWS[name].filters if wide else {}
    footprint = torch.full((1000,), 0.1, dtype=torch.float64) if wide else None
    table = table_of(opened(name, HEIGHT, uv_transform=transform, **filters))
    point = points(1000, footprint=footprint)
    uv, h = point.uv, 1e-6
    assert uv is not None

    def at(*step: float) -> Tensor:
        return read(table, replace(point, uv=uv + torch.tensor(step, dtype=torch.float64)[:, None]), False)

    expected = torch.stack((at(h, 0) - at(-h, 0), at(0, h) - at(0, -h))) / (2 * h)
    error = (inclines(table, point) - expected).abs() / (1e-3 + expected.abs())
    assert float((error > 1e-2).double().mean()) < 0.01  # but at creases
    assert (float(expected.abs().median()) > 0.01) == ROWS[name].smooth


@pytest.mark.parametrize("name", ROWS)
def test_gradients(name: str, opened: Callable[..., Opened]):
    """To every parameter, to coordinates, and of slopes."""
    more = ROWS[name].filters
    node, given, _ = opened(name, uv_transform=TURN, **more) if name in MAPPED else opened(name)
    names = list(given)
    assert set(names) == {f"slot.{key}" for key, spec in parameters_of(KINDS[name]).items() if spec.differentiable} or (
        name == "image" and names == ["slot"]
    )
    footprint = torch.full((4,), 0.01, dtype=torch.float64) if more else None
    start = points(4, footprint=footprint)
    assert start.uv is not None and start.colors is not None

    def values(uv: Tensor, colors: Tensor, *tensors: Tensor) -> Tensor:
        table = node.table([node], dict(zip(names, tensors, strict=True)), torch.float64, CPU)
        return read(table, TexturePoint(uv, footprint, colors))

    inputs = [x.clone().requires_grad_() for x in (start.uv, start.colors, *given.values())]
    assert torch.autograd.gradcheck(values, inputs, fast_mode=True)
    if name not in MAPPED:
        return
    flat = values(*inputs)
    for key, grad in zip(names, torch.autograd.grad(flat[0].sum(), inputs[2:], allow_unused=True), strict=True):
        assert grad is not None and float(grad.abs().max()) > 0, key
    number, heights, _ = opened(name, HEIGHT, uv_transform=TURN, **more)

    def leans(uv: Tensor, *tensors: Tensor) -> Tensor:
        table = number.table([number], dict(zip(names, tensors, strict=True)), torch.float64, CPU)
        return inclines(table, TexturePoint(uv, footprint))

    inputs = [x.clone().requires_grad_() for x in (start.uv, *heights.values())]
    assert torch.autograd.gradcheck(leans, inputs, fast_mode=True)


@pytest.mark.parametrize("name", ROWS)
def test_float32_is_close_to_float64(name: str, opened: Callable[..., Opened]):
    point, small = points(), points(dtype=torch.float32)
    found = opened(name)
    error = (read(table_of(found, torch.float32), small).double() - read(table_of(found), point)).abs()
    assert read(table_of(found, torch.float32), small).dtype == torch.float32
    assert float((error > 1e-5).double().mean()) < 0.01  # but at edges


@pytest.mark.parametrize("name", ROWS)
def test_compiled_is_eager(name: str, opened: Callable[..., Opened]):
    """And a lane gives the same bits at any place."""
    row, count = ROWS[name], 1000
    more = {"uv_transform": TURN} if name in MAPPED else {}
    footprint = torch.linspace(0, 0.2, count)
    point = points(count, torch.float32, footprint)
    assert point.uv is not None and point.colors is not None
    inputs = (point.uv, point.colors, footprint)
    for coloured, filters in ((True, {}), (False, {}), (True, row.filters), (False, row.filters)):
        table = table_of(opened(name, COLOUR if coloured else HEIGHT, **more, **filters), torch.float32)

        def stage(
            uv: Tensor, colors: Tensor, area: Tensor, *, table: Table = table, coloured: bool = coloured
        ) -> list[Tensor]:
            at = TexturePoint(uv, area if table.filtered else None, colors)
            slopes = list(inclines(table, at)) if not coloured and name in MAPPED else []
            return [read(table, at, coloured), *slopes]

        eager, compiled = stage(*inputs), compile_lanewise(stage, inputs)(*inputs)
        for a, b in zip(eager, compiled, strict=True):
            off = (a - b).abs() > 1e-4 * (1 + a.abs())
            assert float(off.float().mean()) < 0.005  # a coordinate rounded otherwise lies across an edge
        for first, size in ((0, 1), (5, 1), (3, 13), (7, 500)):
            part = stage(*(x[..., first : first + size].contiguous() for x in inputs))
            assert all(torch.equal(p, e[..., first : first + size]) for p, e in zip(part, eager, strict=True))


@pytest.mark.parametrize("name", FILTERED)
def test_footprints(name: str, opened: Callable[..., Opened]):
    """Where a footprint is nothing, the look-up at a point; where it is all, the mean; between, nearer to the mean over it."""
    plain, filtered = table_of(opened(name)), table_of(opened(name, **ROWS[name].filters))
    assert filtered.filtered and not plain.filtered
    point = points(400)
    at = read(plain, point)

    def over(area: float) -> Tensor:
        return read(filtered, TexturePoint(point.uv, torch.full((400,), area, dtype=torch.float64)))

    assert torch.allclose(over(0.0), at, atol=1e-12)
    node, given, _ = opened(name)
    for area in (1e4, 1e30, math.inf):
        assert torch.allclose(over(area), node.mean(given)[:, None].expand(3, 400), atol=2e-2), area
    assert point.uv is not None
    side, parts = ROWS[name].side, (torch.arange(8, dtype=torch.float64) + 0.5) / 8 - 0.5
    steps = [side * torch.stack((x, y))[:, None] for x in parts for y in parts]
    mean = torch.stack([read(plain, TexturePoint(point.uv + step)) for step in steps]).mean(0)
    before, after = (float((value - mean).square().mean()) for value in (at, over(side**2)))
    assert after < 0.75 * before


@pytest.mark.parametrize("name", MAPPED)
def test_the_mean_of_a_texture(name: str, opened: Callable[..., Opened]):
    node, given, _ = opened(name)
    side = (torch.arange(300, dtype=torch.float64) + 0.5) / 300
    uv = torch.stack(torch.meshgrid(side, side, indexing="xy")).reshape(2, -1)
    assert torch.allclose(node.mean(given), read(table_of((node, given, {})), TexturePoint(uv)).mean(1), atol=5e-3)


@pytest.mark.parametrize("name", MAPPED)
def test_values_in_units_of_length(name: str, opened: Callable[..., Opened]):
    found = opened(name, HEIGHT)
    node, given, _ = found
    point, table = points(), table_of(found)
    divided = table_of((node.divided(4.0), given, {}))
    assert torch.allclose(read(divided, point, False) * 4, read(table, point, False), atol=1e-12)
    assert torch.allclose(inclines(divided, point) * 4, inclines(table, point), atol=1e-12)


@pytest.mark.parametrize("name", MAPPED)
def test_several_nodes_are_each_alone(name: str, opened: Callable[..., Opened]):
    kinds = [{}, {"uv_transform": TURN}, *([ROWS[name].filters] if ROWS[name].filters else [])]
    every = [opened(name, **more) for more in kinds]
    nodes, given = [node for node, _, _ in every], every[0][1]
    table = nodes[0].table(nodes, given, torch.float64, CPU)
    assert len({node.variant for node in nodes}) == 1
    point = points(200, footprint=torch.full((200,), 0.3, dtype=torch.float64))
    for k, node in enumerate(nodes):
        whole = table.look_up(torch.full((200,), k), point, coloured=True)
        assert torch.allclose(whole, read(table_of((node, given, {})), point), atol=1e-12)


# -- errors


def scene(entry: dict[str, Any], **slots: Any) -> dict[str, Any]:
    return {
        "camera": {"origin": [0, 0, 4], "target": [0, 0, 0]},
        "textures": {"t": entry},
        "materials": {"m": {"type": "principled", "roughness": {"texture": "t"}, **slots}},
        "shapes": {"s": {"type": "rectangle", "material": "m"}},
    }


def entry_of(name: str, file: str, **more: Any) -> dict[str, Any]:
    entry = {key: file if value == "PATH" else value for key, value in ROWS[name].entry.items()}
    return {"type": name, **entry, **more}


@pytest.mark.parametrize("name", ROWS)
def test_what_a_file_may_not_hold(name: str, path: str):
    torchpt.load(scene(entry_of(name, path)), "cpu")
    refused = ROWS[name].refused
    assert set(refused) == set(parameters_of(KINDS[name]))
    for key, value in refused.items():
        with pytest.raises(SceneError) as caught:
            torchpt.load(scene(entry_of(name, path, **{key: value})), "cpu")
        assert caught.value.key.startswith(f"textures.t.{key}"), key
        assert "expected" in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(SceneError, match=r"textures\.t\.colour: expected a known key"):
        torchpt.load(scene(entry_of(name, path, colour=1)), "cpu")


@pytest.mark.parametrize("name", ROWS)
def test_what_a_render_may_not_be_given(name: str, path: str):
    """Of every parameter: out of the slot's range as in a file, not finite, of another shape."""
    loaded = torchpt.load(scene(entry_of(name, path)), "cpu")
    names = [key for key in loaded.params if key.startswith("textures.")]
    assert set(names) == {f"textures.t{key}" for key in ROWS[name].beyond}
    for key in names:
        own = loaded.params[key]
        loaded.check({key: own})
        beyond = torch.full_like(own, ROWS[name].beyond[key.removeprefix("textures.t")])
        for bad in (beyond, torch.full_like(own, math.nan), own[None]):
            with pytest.raises(SceneError, match=f"params.{key}"):
                loaded.check({key: bad})


@pytest.mark.parametrize("name", [name for name in ROWS if ROWS[name].beyond])
def test_several_slots_narrow_a_range(name: str, path: str):
    """And one with a wider range does not widen it; whichever is read first."""
    glass = {"type": "dielectric", "int_ior": {"texture": "t"}}
    for slots, inner, expected in (
        ({}, None, (0.0, 1.0)),
        ({"emission": {"texture": "t"}, "opacity": {"texture": "t"}}, None, (0.0, 1.0)),
        ({}, glass, (1e-3, 1.0)),
    ):
        whole = scene(entry_of(name, path), **slots)
        if inner is not None:
            whole["shapes"]["second"] = {"type": "sphere", "material": inner}
        for shapes in (whole["shapes"], dict(reversed(whole["shapes"].items()))):
            loaded = torchpt.load({**whole, "shapes": shapes}, "cpu")
            spec = loaded.spec(next(key for key in loaded.params if key.startswith("textures.t")))
            assert isinstance(spec, Color | Texels) and spec.bounds == expected
            assert (spec.moves is Moves.RAYS) == (inner is not None)


@pytest.mark.parametrize("name", ROWS)
def test_alpha_that_is_not_there(name: str, path: str):
    wrong = scene(entry_of(name, path), metallic={"texture": "t", "channel": "a"})
    with pytest.raises((SceneError, torchpt.AssetError), match="alpha"):
        torchpt.load(wrong, "cpu")


@pytest.mark.parametrize("name", FILTERED)
def test_slots_at_points_do_not_filter(name: str, path: str):
    filtering = entry_of(name, path, **ROWS[name].filters)
    for slot in ("opacity", "emission"):
        with pytest.raises(SceneError, match=rf"materials\.m\.{slot}\.filter.*{slot} is read at points"):
            torchpt.load(scene(filtering, **{slot: filtering}), "cpu")
        loaded = torchpt.load(scene({"type": "noise"}, **{slot: {"texture": "t"}}), "cpu")
        assert not loaded.world(torch.float32)[0].textures.filtered
