"""Images of 8 bits a value stay packed until someone asks for their numbers; pictures are the same to the bit."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

import torchpt
from torchpt.gradients.edges.left_out import left_out
from torchpt.images import PackedImages, Texels
from torchpt.physics.textures.atlas import Atlas
from torchpt.scene.fingerprint import fingerprints
from torchpt.scene.formats.description import settings

#: Bytes by number of channels.
SIZES = {1: (5, 7), 2: (3, 4), 3: (6, 5), 4: (4, 3)}


def picture(channels, seed=0):
    rng = np.random.default_rng(channels + 10 * seed)
    return rng.integers(0, 256, (*SIZES[channels], channels), dtype=np.uint8)


def scene(*textures, **changes):
    """Return a description of rectangles side by side under a lamp, each with one of the materials."""
    shapes = {
        f"plate{k}": {
            "type": "rectangle",
            "transform": [{"scale": 0.5}, {"translate": [1.1 * k, 0.0, 0.0]}],
            "material": material,
        }
        for k, material in enumerate(textures)
    }
    return {
        "camera": {"type": "perspective", "fov": 50, "origin": [1.5, 0.3, 4.0], "target": [1.5, 0.0, 0.0]},
        "film": {"width": 48, "height": 24},
        "lights": {"sky": {"type": "constant", "radiance": 1.0}},
        "shapes": {**shapes, "back": {"type": "rectangle", "transform": [{"scale": 5}, {"translate": [0, 0, -1]}]}},
        "render": {"spp": 4},
        **changes,
    }


def image(channels, seed=0, **values):
    return {"type": "image", "data": picture(channels, seed), **values}


#: Every slot that reads an image, every number of channels, wrap mode and encoding.
MATERIALS = {
    "colours": [
        {"type": "diffuse", "reflectance": image(1)},
        {"type": "diffuse", "reflectance": image(2, wrap="clamp")},
        {"type": "diffuse", "reflectance": image(3, wrap="mirror", uv_transform={"scale": 2.5, "rotate": 30.0})},
        {"type": "diffuse", "reflectance": image(4, filter="nearest", scale=[0.5, 0.7, 0.9])},
        {"type": "diffuse", "reflectance": image(3, 1, colorspace="linear")},
    ],
    "numbers": [
        {"type": "roughconductor", "alpha": image(1, scale=0.8)},
        {"type": "roughconductor", "alpha": image(3, channel="b", scale=0.8)},
        {"type": "roughconductor", "alpha": image(4, channel="a", scale=0.8, colorspace="srgb")},
        {"type": "roughconductor", "alpha": image(3, 2, scale=0.8)},  # by luminance: not packed
    ],
    "surfaces": [
        {"type": "diffuse", "opacity": image(4, channel="a")},
        {"type": "diffuse", "bump_map": image(1, scale=0.1)},
        {"type": "diffuse", "normal_map": image(3, 3)},
        {"type": "diffuse", "reflectance": 0.0, "emission": image(3, 4)},
    ],
    "filtered": [
        {"type": "diffuse", "reflectance": image(3, filter="trilinear")},
        {"type": "diffuse", "reflectance": image(3, 5)},
    ],
}


def by_numbers(description):
    """Return the scene with its images decoded."""
    loaded = torchpt.load(description)
    assert loaded.params
    return loaded


@pytest.mark.parametrize("group", MATERIALS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pictures_are_the_same_to_the_bit(group, dtype):
    description = scene(*MATERIALS[group])
    expected = torchpt.render(by_numbers(description), dtype=dtype)
    loaded = torchpt.load(description)
    assert loaded._packed.found()
    assert torch.equal(torchpt.render(loaded, dtype=dtype), expected)
    world, _ = loaded.world(dtype)
    packed = [table.decode is not None for table in world.textures.tables if isinstance(table, Atlas)]
    assert any(packed) and loaded._packed.found()
    assert loaded.params  # decodes
    assert torch.equal(torchpt.render(loaded, dtype=dtype), expected)


@pytest.mark.parametrize("channels", SIZES)
@pytest.mark.parametrize("encoded", [False, True])
def test_numbers_are_those_of_the_image(channels, encoded):
    texels = Texels(picture(channels), eight_bit=True, white=255)
    of_bytes = texels.as_bytes(encoded)
    assert (
        of_bytes is not None and of_bytes is texels.as_bytes(encoded) and of_bytes is not texels.as_bytes(not encoded)
    )
    expected = texels.decoded if encoded else texels.values
    assert np.array_equal(of_bytes.values(), expected)
    assert (of_bytes.min(), of_bytes.max()) == (expected.min(), expected.max())
    tensor = torch.empty(of_bytes.shape)
    images = PackedImages({"a": of_bytes}, {"a": tensor})
    version = tensor._version
    assert np.array_equal(images.found()["a"].image.values(), expected)
    assert images.unpack() and not images.unpack()
    assert np.array_equal(tensor.numpy(), expected) and tensor._version == version and not images.found()


def test_only_bytes_are_packed():
    assert Texels(np.zeros((2, 2, 1), np.uint16), eight_bit=False, white=65535).as_bytes(False) is None
    assert Texels(np.zeros((2, 2, 1), np.uint8), eight_bit=True, white=15).as_bytes(False) is None
    assert Texels(np.zeros((2, 2, 1), np.float32), eight_bit=False).as_bytes(False) is None


def one():
    return torchpt.load(
        scene({"type": "diffuse", "reflectance": image(3)}, {"type": "diffuse", "reflectance": image(1)})
    )


NAME, ALPHA = "shapes.plate0.material.reflectance", "shapes.plate0.material.alpha"


def test_changes_in_place_count():
    loaded = one()
    torchpt.render(loaded)
    loaded.params[NAME].fill_(0.25)
    description = scene({"type": "diffuse", "reflectance": 0.25}, {"type": "diffuse", "reflectance": image(1)})
    torch.testing.assert_close(torchpt.render(loaded), torchpt.render(torchpt.load(description)), rtol=1e-5, atol=1e-6)


def test_texels_in_place_of_packed_ones():
    texels = torch.full((3, 2, 3), 0.25, requires_grad=True)
    loaded, known = one(), one()
    assert known.params
    found = []
    for chosen in (loaded, known):
        torchpt.render(chosen)
        picture_of = torchpt.render(chosen, params={NAME: texels[:2].expand(2, 2, 3).repeat(3, 3, 1)[:6, :5]})
        found.append((picture_of.detach(), *torch.autograd.grad(picture_of.sum(), texels)))
    assert torch.equal(found[0][0], found[1][0]) and torch.equal(found[0][1], found[1][1])


@pytest.mark.parametrize("name", ["lights.sky.radiance", "shapes.plate0.to_world", "camera.fov"])
def test_gradients_by_others_leave_images_packed(name):
    loaded, known = one(), one()
    assert known.params
    grads = []
    for found in (loaded, known):
        value = found.raw_params[name].clone().requires_grad_()
        picture_of = torchpt.render(found, params={name: value})
        grads.append(torch.autograd.grad(picture_of.square().sum(), value)[0])
    assert torch.equal(*grads) and loaded._packed.found() and grads[0].abs().sum() > 0


def test_copies_and_views():
    loaded = one()
    expected = torchpt.render(one())
    view = loaded.seen_by({"type": "perspective", "fov": 50, "origin": [1.5, 0.3, 4.0], "target": [1.5, 0.0, 0.0]})
    assert torch.equal(torchpt.render(view), expected) and loaded._packed.found()
    values = one().params[NAME]
    for made in (view, copy.copy(loaded), copy.deepcopy(loaded), pickle.loads(pickle.dumps(one())), one().to("cpu")):
        assert torch.equal(made.params[NAME], values)
        assert torch.equal(torchpt.render(made), expected)


@pytest.mark.parametrize("transform", ["grad", "jacrev", "vmap"])
def test_numbers_asked_for_within_transforms(transform):
    """Those of torch.func hide the memory of tensors that are made or sliced within."""
    loaded, known = one(), one()
    assert known.params

    def of(found):
        def loss(factor):
            return torchpt.render(found, params={NAME: found.params[NAME] * factor}, spp=2).mean()

        return loss

    at = torch.tensor([0.5, 0.25]) if transform == "vmap" else torch.tensor(0.5)
    found = [getattr(torch.func, transform)(of(chosen))(at) for chosen in (loaded, known)]
    assert torch.equal(*found)


def test_another_default_device():
    """Tensors of scenes on a CPU are made there, and traces as well."""
    film = {"width": 9, "height": 7}
    with torch.device("meta"):
        loaded = one()
        picture_of = torchpt.render(loaded, film=film)
        assert loaded.params[NAME].device.type == "cpu"
        copied = copy.deepcopy(loaded)
    assert torch.equal(picture_of, torchpt.render(one(), film=film))
    assert torch.equal(torchpt.render(copied), torchpt.render(one()))


def test_threads_that_ask_at_once():
    """One asks for the numbers while others render."""
    expected = torchpt.render(one())
    for _ in range(3):
        loaded = one()
        with ThreadPoolExecutor(4) as threads:
            pictures = [threads.submit(torchpt.render, loaded) for _ in range(3)]
            values = threads.submit(lambda loaded=loaded: loaded.params[NAME].clone())
            assert all(torch.equal(one_of.result(), expected) for one_of in pictures)
            assert torch.equal(values.result(), one().params[NAME])


def test_an_image_of_colours_and_numbers():
    """Read as a colour and, by luminance, as a number it has both forms, packed and not."""
    shared = {"type": "image", "data": picture(3, 6), "colorspace": "linear"}
    materials = [
        {"type": "roughconductor", "alpha": {"texture": "both"}, "specular_reflectance": {"texture": "both"}},
        {"type": "diffuse", "reflectance": image(3)},
    ]
    description = scene(*materials, textures={"both": {**shared, "scale": 0.9}})
    loaded = torchpt.load(description)
    assert set(loaded._packed.found()) == {"textures.both", "shapes.plate1.material.reflectance"}
    assert torch.equal(torchpt.render(loaded), torchpt.render(by_numbers(description)))


def test_values_that_a_slot_does_not_accept():
    with pytest.raises(torchpt.SceneError, match=r"numbers in 0\.\.1 in the texels"):
        torchpt.load(scene({"type": "diffuse", "reflectance": image(3, scale=2.0)}))


def test_what_is_left_out_of_edges_reads_numbers():
    """A rough conductor is no mirror while its roughness waits in an image, and keeps it there."""
    rough = {"type": "roughconductor", "alpha": {"type": "image", "data": np.full((6, 5, 1), 128, np.uint8)}}
    loaded = torchpt.load(scene(rough))
    assert not any("mirrors" in name for name in left_out(loaded, settings(loaded.description, {})))
    assert loaded._packed.found() and torch.equal(loaded.readable_params()[ALPHA], loaded.params[ALPHA])


def test_maps_of_normals_leave_images_packed():
    loaded = torchpt.load(scene({"type": "diffuse", "reflectance": image(3), "normal_map": image(3, 3)}))
    radiance = torch.ones(3, requires_grad=True)
    torchpt.render(loaded, params={"lights.sky.radiance": radiance}).mean().backward()
    fingerprints(loaded)
    assert loaded._packed.found()


def test_only_what_is_read_packed_is_packed():
    loaded = torchpt.load(scene(*MATERIALS["filtered"]))
    assert list(loaded._packed.found()) == ["shapes.plate1.material.reflectance"]


def test_parameters_may_be_assigned():
    loaded = one()
    loaded.params |= {NAME: torch.full((6, 5, 3), 0.25)}
    assert float(loaded.params[NAME].max()) == 0.25
    loaded.params = dict(one().params)
    assert torch.equal(torchpt.render(loaded), torchpt.render(one()))
