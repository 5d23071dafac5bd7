"""Data sets of rendered pictures: an item is a function of its index, whoever renders it."""

from __future__ import annotations

import copy
import itertools
import pickle
import threading
from typing import Any

import numpy as np
import pytest
import torch
from scene_makers import FILM, dim, flat, room
from torch import Tensor
from torch.utils.data import DataLoader, DistributedSampler

import torchpt
from torchpt import search
from torchpt.core.errors import RenderError, SceneError
from torchpt.core.memory import MemoryMeter
from torchpt.data import RenderDataset, RenderStream, SceneLoader
from torchpt.scene import scene as scene_module

Items = dict[int, dict[str, Tensor]]


def data(**changes: Any) -> RenderDataset:
    return RenderDataset(room, 4, **{"spp": 4, "layers": ["depth", "normal"], "seed": 7, **changes})


def far_away() -> torchpt.Scene:
    """A ball 4,000 km from the origin."""
    place = [4e6, 0, 0]
    return torchpt.load(
        {
            "camera": {"type": "perspective", "origin": [4e6, 0, 4], "target": place, "fov": 40},
            "film": FILM,
            "shapes": {"ball": {"type": "sphere", "center": place}},
            "lights": {"sky": {"type": "constant", "radiance": 1.0}},
        },
        "cpu",
    )


def by_index(batches: Any) -> Items:
    return {int(i): {k: v[n] for k, v in batch.items()} for batch in batches for n, i in enumerate(batch["index"])}


def same(found: Items, expected: Items) -> bool:
    return found.keys() == expected.keys() and all(
        torch.equal(found[i][name], value) for i, item in expected.items() for name, value in item.items()
    )


def test_an_item_is_the_render_of_its_index():
    item = data()[2]
    scene = torchpt.load(room(2), "cpu")
    expected = torchpt.render(scene, spp=4, seed=9, film={"aovs": ["depth", "normal"]}, full=True)
    camera = scene.pinhole()
    assert torch.equal(item["image"], expected.image) and torch.equal(item["depth"], expected["depth"])
    assert (
        item["image"].shape == (8, 10, 3) and item["normal"].shape == (8, 10, 3) and item["depth"].shape == (8, 10, 1)
    )
    assert torch.equal(item["K"], camera.K) and torch.equal(item["R"], camera.R) and torch.equal(item["t"], camera.t)
    assert torch.equal(item["to_world"], scene.params["camera.to_world"]) and int(item["index"]) == 2
    assert not any(value.requires_grad for value in item.values())


def test_items_differ_and_come_again():
    items = data(cameras=[torch.eye(4) + 0.0])
    assert len(items) == 4
    first, other = data()[0], data()[1]
    assert not torch.equal(first["image"], other["image"])
    assert torch.equal(data()[0]["image"], first["image"]) and torch.equal(data()[-3]["image"], other["image"])
    with pytest.raises(IndexError, match="index 4 of a data set of 4 items"):
        data()[4]


def test_cameras_of_each_scene():
    scene = torchpt.load(room(0), "cpu")
    near, far = scene.params["camera.to_world"].clone(), scene.params["camera.to_world"].clone()
    far[2, 3] += 1
    calls: list[int] = []

    def make(index: int) -> dict[str, Any]:
        calls.append(index)
        return room(index)

    items = RenderDataset(
        make, 2, cameras=[near, {"camera.to_world": far, "camera.fov": 30.0}], spp=1, layers=["depth"]
    )
    found = [items[i] for i in range(len(items))]
    assert len(found) == 4 and calls == [0, 1]  # a scene is made once for its cameras
    assert torch.equal(found[0]["to_world"], near) and torch.equal(found[3]["to_world"], far)
    assert float(found[1]["depth"][4, 5, 0] - found[0]["depth"][4, 5, 0]) == pytest.approx(1, abs=0.05)
    assert float(found[1]["K"][0, 0]) > float(found[0]["K"][0, 0])


def test_settings_of_a_scene_and_of_the_data_set():
    scene = torchpt.load(room(1), "cpu")
    params = {"shapes.lamp.emission": torch.ones(3)}
    expected = torchpt.render(scene, params=params, spp=2, seed=1, film={"width": 5})
    assert torch.equal(RenderDataset(dim, 2, spp=16, film={"width": 5})[1]["image"], expected)


def test_a_camera_without_a_matrix_has_its_pose():
    item = RenderDataset(flat, 1, spp=1)[0]
    assert item["to_world"].shape == (4, 4) and "K" not in item


def test_scenes_may_be_made_by_the_caller_and_items_are_without_gradients():
    scene = torchpt.load(room(0), "cpu")
    scene.params["materials.wall.reflectance"].requires_grad_()
    item = RenderDataset(lambda _: scene, 1, spp=1)[0]
    assert not item["image"].requires_grad and item["image"].shape == (8, 10, 3)


@pytest.mark.parametrize(
    "index", [1.5, "a", "1", None, [1], torch.tensor([0, 1]), torch.tensor(1.0), slice(0, 2)], ids=str
)
def test_an_index_is_a_whole_number(index):
    with pytest.raises(TypeError, match="^index of a data set: expected a whole number, got ") as caught:
        data()[index]
    assert "\n" not in str(caught.value)


def test_indices_of_arrays_and_tensors():
    made = data(layers=[], spp=1)
    indices: list[Any] = [np.int64(1), torch.tensor(1), -3]
    for index in indices:
        assert int(made[index]["index"]) == 1


@pytest.mark.parametrize(
    ("wish", "key"),
    [
        ({"seed": -1}, "seed"),
        ({"full": True}, "full"),
        ({"params": {}}, "params"),
        ({"scenes": -1}, "scenes"),
        ({"checkpoint": "x"}, "checkpoint"),
        ({"seed_grad": 3}, "seed_grad"),
        ({"spp_grad": 3}, "spp_grad"),
    ],
    ids=str,
)
def test_arguments_that_are_not_accepted(wish, key):
    with pytest.raises(SceneError, match=f"^{key}: expected"):
        RenderDataset(room, **{"scenes": 2, **wish})
    if key not in ("seed", "params", "scenes"):  # which a scene may have
        with pytest.raises(SceneError, match=rf"^make\(1\).{key}: expected"):
            RenderDataset(lambda _: (room(0), wish), 2)[1]


@pytest.mark.parametrize(
    "shard", [3, "ab", (0, 1, 2), (0,), (0.0, 2), (None, 2), (2, 2), (-1, 2), (0, 0), {"rank": 0, "world": 1}], ids=str
)
def test_shards_that_are_not_accepted(shard):
    with pytest.raises(SceneError, match=r"^shard: expected \(rank, world\) with 0 <= rank < world, got ") as refused:
        RenderStream(room, shard=shard)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("cameras", "says"),
    [
        (torch.eye(4), r"cameras: expected a sequence of poses .*, got \(4, 4\)"),
        (np.eye(4), r"cameras: expected a sequence of poses .*, got \(4, 4\)"),
        (torch.eye(4).tolist(), r"cameras: expected a sequence of poses .*, got \[\[1.0, 0.0"),
        (list(torch.eye(4)), r"cameras: expected a sequence of poses .*, got \[tensor"),
        (torch.tensor(1.0), r"cameras: expected a sequence of poses .*, got \(\)"),
        (torch.eye(4)[None, None], r"cameras: expected a sequence of poses .*, got \(1, 1, 4, 4\)"),
        ([torch.eye(4), torch.eye(3)], r"cameras\[1\]: expected a pose \(4, 4\) .*, got 'shape \(3, 3\)'"),
    ],
    ids=["tensor", "array", "list", "rows", "number", "nested", "shape"],
)
def test_cameras_that_are_not_accepted(cameras, says):
    with pytest.raises(SceneError, match=f"^{says}") as refused:
        RenderDataset(room, 1, cameras=cameras)
    assert "\n" not in str(refused.value)


def test_an_unknown_layer_is_named():
    with pytest.raises(SceneError, match="film.aovs"):
        data(layers=["smell"])[0]


@pytest.mark.parametrize("kind", ["tensor", "list", "array", "made"])
def test_poses_far_from_the_origin_keep_their_digits(kind):
    scene = far_away()
    pose = scene.params["camera.to_world"].clone()
    assert pose.dtype == torch.float64
    pose[0, 3] += 0.2
    given = {"tensor": pose, "list": pose.tolist(), "array": pose.numpy(), "made": pose.tolist()}[kind]
    if kind == "made":
        item = RenderDataset(lambda _: (scene, {"params": {"camera.to_world": given}}), 1, spp=1)[0]
    else:
        item = RenderDataset(lambda _: scene, 1, cameras=[given], spp=1)[0]
    assert torch.equal(item["to_world"], pose)
    assert torch.allclose(-(item["R"].T @ item["t"]), pose[:3, 3], rtol=0, atol=1e-6)
    assert torch.equal(item["image"], torchpt.render(scene, params={"camera.to_world": pose}, spp=1, seed=0))


def test_items_of_a_scene_are_of_one_type_whatever_its_poses_are():
    poses = [torch.eye(4, dtype=torch.float64), torch.eye(4), torch.eye(4).tolist()]
    items = RenderDataset(room, 1, cameras=poses, spp=1)
    first, *others = (items[i] for i in range(3))
    for other in others:
        assert all(other[name].dtype == first[name].dtype for name in first)
    assert first["to_world"].dtype == torch.float32


def test_wishes_of_a_scene_for_files_are_left_out(monkeypatch):
    monkeypatch.setattr("torchpt.images.denoiser.denoise", lambda *_, **__: pytest.fail("nobody sees it"))
    scene = torchpt.load({**room(0), "film": {**FILM, "denoise": True, "aovs": ["normal"]}}, "cpu")
    item = RenderDataset(lambda _: scene, 1, spp=1, layers=["depth"])[0]
    assert "depth" in item and "normal" not in item


# -- items of a batch, side by side


@pytest.mark.parametrize("indices", [[2, 0, 3], [1, 1, -3], [], np.array([3, 1])], ids=str)
def test_items_of_a_batch_are_those_taken_one_by_one(indices):
    pose = torchpt.load(room(0), "cpu").params["camera.to_world"].clone()
    pose[2, 3] += 1
    items = data(cameras=[pose, {"camera.to_world": pose, "camera.fov": 30.0}], spp=2)
    batch = items.__getitems__(indices)
    assert len(batch) == len(indices)
    for found, index in zip(batch, indices, strict=True):
        expected = items[index]
        assert found.keys() == expected.keys()
        assert all(torch.equal(found[name], value) for name, value in expected.items())


def test_a_batch_of_scenes_with_settings_of_their_own():
    def make(index: int) -> Any:
        return dim(index) if index % 2 else (room(index), {"spp": 2, "threads": 1})

    items = RenderDataset(make, 4, film={"width": 5})
    for found, index in zip(items.__getitems__(range(4)), range(4), strict=True):
        assert torch.equal(found["image"], items[index]["image"])


def test_scenes_of_a_batch_are_made_one_after_another_and_once():
    made: list[int] = []

    def make(index: int) -> dict[str, Any]:
        made.append(index)
        return room(index)

    items = RenderDataset(make, 3, cameras=[torch.eye(4)] * 2, spp=1)
    items.__getitems__(range(6))
    assert made == [0, 1, 2]


def test_a_scene_that_changes_while_a_batch_has_it_is_an_error():
    scene = torchpt.load(room(0), "cpu")

    def make(index: int) -> torchpt.Scene:
        scene.params["materials.wall.reflectance"].fill_(0.1 * index)
        return scene

    items = RenderDataset(make, 3, spp=1)
    assert items[1]["image"].shape == (8, 10, 3)
    with pytest.raises(RenderError, match=r"^items\[.\]: .*changed.* while the batch has it"):
        items.__getitems__(range(3))


def test_an_error_in_a_batch_names_its_item():
    def make(index: int) -> torchpt.Scene:
        scene = torchpt.load(room(index), "cpu")
        if index == 2:
            scene.params["shapes.lamp.emission"].fill_(torch.nan)
            scene.check_own = lambda: None  # which refuses that  # type: ignore[method-assign]
        return scene

    items = RenderDataset(make, 4, spp=1, integrator={"type": "path", "strict": True})
    with pytest.raises(RenderError, match=r"^items\[2\]: integrator.strict"):
        items.__getitems__(range(4))


# -- a loader of scenes


def test_batches_of_scenes():
    loader = SceneLoader(room, range(5), batch_size=2, device="cpu")
    batches = list(loader)
    assert [batch.indices.tolist() for batch in batches] == [[0, 1], [2, 3], [4]] and len(loader) == 3
    images = torchpt.render_batch(batches[1].scenes, spp=2, seed=[2, 3])
    for image, index in zip(images, batches[1].indices.tolist(), strict=True):
        assert torch.equal(image[0], torchpt.render(torchpt.load(room(index), "cpu"), spp=2, seed=index))
    whole = SceneLoader(room, [3, 1, 0], batch_size=2, drop_last=True, device="cpu")
    assert [indices.tolist() for indices, _ in whole] == [[3, 1]] and len(whole) == 1
    assert [indices.tolist() for indices, _ in whole] == [[3, 1]]  # once more from the start


@pytest.mark.parametrize("ahead", [0, 1, 2])
def test_the_next_scenes_are_made_while_the_caller_has_a_batch(ahead):
    made: list[int] = []
    arrived = {index: threading.Event() for index in range(20)}

    def make(index: int) -> dict[str, Any]:
        made.append(index)
        arrived[index].set()
        assert threading.current_thread() is not threading.main_thread()
        return room(index)

    batches: Any = iter(SceneLoader(make, itertools.count(), batch_size=2, ahead=ahead, device="cpu"))
    for step in range(2):
        assert next(batches).indices.tolist() == [2 * step, 2 * step + 1]
        for index in range(2 * (step + 1 + ahead)):
            assert arrived[index].wait(60)
        assert len(made) == 2 * (step + 1 + ahead)
    batches.close()
    assert len(made) <= 2 * (2 + ahead)


def test_what_a_render_needs_is_built_by_the_loader(monkeypatch):
    built: list[str] = []

    def counting(module: Any, name: str) -> None:
        plain = getattr(module, name)

        def call(*args: Any, **given: Any) -> Any:
            built.append(threading.current_thread().name)
            return plain(*args, **given)

        monkeypatch.setattr(module, name, call)

    counting(scene_module, "assemble")
    counting(search, "build")
    for _, scenes in SceneLoader(room, range(2), batch_size=2, device="cpu", film={"aovs": ["uv"]}):
        before = len(built)
        assert before and all(name.startswith("torchpt_") for name in built)
        torchpt.render_batch(scenes, spp=1, film={"aovs": ["uv"]}, full=True)
        assert len(built) == before


def test_gradients_reach_parameters_of_loaded_scenes():
    (batch,) = SceneLoader(room, range(2), batch_size=2, device="cpu")
    for scene in batch.scenes:
        scene.params["materials.wall.reflectance"].requires_grad_()
    torchpt.render_batch(batch.scenes, spp=2, seed=[1, 2]).sum().backward()
    for index, scene in enumerate(batch.scenes):
        own = torchpt.load(room(index), "cpu")
        leaf = own.params["materials.wall.reflectance"].clone().requires_grad_()
        torchpt.render(own, params={"materials.wall.reflectance": leaf}, spp=2, seed=1 + index).sum().backward()
        grad = scene.params["materials.wall.reflectance"].grad
        assert grad is not None and leaf.grad is not None and torch.equal(grad, leaf.grad) and bool(grad.any())


@pytest.mark.slow
def test_500_iterations_over_new_scenes_are_flat_in_memory():
    """Scenes, worlds, kernels and gradients of an iteration go with it; nothing is released by hand."""
    meter, held = MemoryMeter(torch.device("cpu")), list[int]()
    tint = torch.ones(3, requires_grad=True)
    for indices, scenes in SceneLoader(room, range(1000), batch_size=2, device="cpu"):
        params = [{"materials.wall.reflectance": tint * s.params["materials.wall.reflectance"]} for s in scenes]
        torchpt.render_batch(scenes, params=params, spp=4, seed=indices).mean().backward()
        held.append(meter.now())
    assert len(held) == 500
    print(f"{held[100] / 1e6:.1f} MB after 100, {max(held[400:]) / 1e6:.1f} MB after 400 to 500")
    assert max(held[400:]) <= 1.02 * held[100]


def test_samplers_of_ranks_share_the_indices():
    shares = []
    for rank in range(2):
        sampler = DistributedSampler(range(7), num_replicas=2, rank=rank, shuffle=False, drop_last=True)  # type: ignore[arg-type]
        shares += [batch.indices.tolist() for batch in SceneLoader(room, sampler, batch_size=3, device="cpu")]
    assert shares == [[0, 2, 4], [1, 3, 5]]


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (lambda index: {**room(index), "lights": {"sky": {"type": "moon"}}}, r"^make\(2\)\.lights\.sky\.type: "),
        (lambda index: 3, r"^make\(2\): expected a scene from torchpt.load"),
    ],
)
def test_an_error_comes_with_its_batch(made, message):
    batches = iter(SceneLoader(lambda index: made(index) if index == 2 else room(index), range(4), device="cpu"))
    assert [next(batches).indices.tolist() for _ in range(2)] == [[0], [1]]
    with pytest.raises(SceneError, match=message) as caught:
        next(batches)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("wish", "key"),
    [
        ({"make": 3}, "make"),
        ({"indices": 3}, "indices"),
        ({"indices": "ab"}, "indices"),
        ({"batch_size": 0}, "batch_size"),
        ({"ahead": -1}, "ahead"),
        ({"drop_last": 1}, "drop_last"),
    ],
)
def test_arguments_that_a_loader_refuses(wish, key):
    arguments: dict[str, Any] = {"make": room, "indices": range(2), **wish}
    with pytest.raises(SceneError, match=f"^{key}: expected"):
        SceneLoader(**arguments)


def test_other_arguments_of_a_loader():
    with pytest.raises(TypeError, match="'batchsize'. Did you mean 'batch_size'"):
        SceneLoader(room, range(2), batchsize=3)  # type: ignore[call-arg]
    with pytest.raises(SceneError, match="^indices: expected whole numbers, got 1.5"):
        next(iter(SceneLoader(room, [1.5], device="cpu")))  # type: ignore[list-item]
    with pytest.raises(TypeError, match="over a count has no length"):
        len(SceneLoader(room, itertools.count()))


# -- workers


@pytest.fixture(scope="module")
def expected() -> Items:
    """By this process, with threads: what workers are forked from has rendered."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        items = data()
        return {i: items[i] for i in range(4)}
    finally:
        torch.set_num_threads(threads)


def made_wrongly(index: int) -> Any:
    return {**room(1), "shapes": {"ball": {"type": "sphere", "radius": -1}}} if index else (room(1), {"spp": 0})


@pytest.mark.parametrize(
    ("index", "key"), [(1, "make(1).shapes.ball.radius"), (0, "make(0).render.spp")], ids=["scene", "option"]
)
@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_in_a_worker_keeps_its_type_and_key(index, key, workers):
    items = RenderStream(made_wrongly, start=index, scenes=index + 1, film=(4, 4))
    with pytest.raises(SceneError) as error:
        next(iter(DataLoader(items, num_workers=workers, multiprocessing_context="fork" if workers else None)))
    assert error.value.key == key and str(error.value).startswith(f"{key}: expected") and "\n" not in str(error.value)


def test_the_same_bits_without_workers(expected):
    assert same(by_index(DataLoader(data(), batch_size=2)), expected)


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_the_same_bits_in_workers(expected, method):
    loader = DataLoader(data(), batch_size=2, num_workers=2, multiprocessing_context=method, timeout=300)
    assert same(by_index(loader), expected)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # torch's, where there are fewer cores
@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("wish", [{"compile": "off"}, {"threads": 2}, {"accel": "torch"}], ids=str)
def test_the_same_bits_in_any_number_of_workers(method, workers, wish):
    items = data(**wish)
    loader = DataLoader(items, num_workers=workers, multiprocessing_context=method, timeout=300)
    assert same(by_index(loader), {i: items[i] for i in range(4)})


def test_a_stream_in_workers_has_each_index_once(expected):
    stream = RenderStream(room, 4, spp=4, layers=["depth", "normal"], seed=7)
    loader = DataLoader(stream, batch_size=1, num_workers=2, multiprocessing_context="fork", timeout=300)
    assert same(by_index(loader), expected)
    assert same(by_index(DataLoader(stream, batch_size=4)), expected)


def test_a_stream_has_no_end_and_goes_on():
    indices = RenderStream(room).indices()
    assert [next(indices) for _ in range(5)] == [0, 1, 2, 3, 4]
    later = iter(RenderStream(room, start=3, spp=1, seed=5))
    first = next(later)
    assert int(first["index"]) == 3 and int(next(later)["index"]) == 4
    assert torch.equal(first["image"], RenderDataset(room, 4, spp=1, seed=5)[3]["image"])


@pytest.mark.parametrize("start", [0, 1, 5])
def test_ranks_share_a_stream(start):
    shares = [list(RenderStream(room, 12, start=start, shard=(rank, 3)).indices()) for rank in range(3)]
    assert sorted(index for share in shares for index in share) == list(range(start, 12))
    assert all(index % 3 == rank for rank, share in enumerate(shares) for index in share)
    numbers: Any = (np.int64(1), torch.tensor(3))
    assert list(RenderStream(room, 12, start=start, shard=numbers).indices()) == shares[1]


def test_ranks_of_torch_distributed(tmp_path, monkeypatch):
    stream = RenderStream(room, 6, spp=1)
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_rank", lambda: 1)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 2)
    assert list(stream.indices()) == [1, 3, 5]
    sent = pickle.dumps(stream)  # as to a spawned worker
    monkeypatch.undo()
    assert list(pickle.loads(sent).indices()) == [1, 3, 5]
    assert list(RenderStream(room, 6, shard=(1, 2)).indices()) == [1, 3, 5]


def test_a_used_data_set_is_sent_without_its_scene():
    items = data()
    size = len(pickle.dumps(items))
    assert items[0]["image"].shape == (8, 10, 3)
    assert len(pickle.dumps(items)) == size and copy.copy(items)._items is items._items
