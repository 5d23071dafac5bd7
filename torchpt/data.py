"""Data sets of rendered pictures for ``torch.utils.data`` (``RenderDataset``, ``RenderStream``), and a loader of scenes.

An item is a function of its index: it has the same bits in any number of workers, forked or spawned, and on any rank. So must
be the scene that ``make`` returns: draw its random numbers from ``torch.Generator().manual_seed(index)``. Spawned workers
pickle the data set, so for them ``make`` must be a function of a module, not a ``lambda``.

:class:`SceneLoader` is for training through the renderer itself: it makes batches of scenes for ``render_batch``, the next ones
while those before are rendered.
"""

from __future__ import annotations

import operator
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any, NamedTuple, Unpack

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from torchpt.core.errors import SceneError
from torchpt.core.threads import TaskQueue, limited_threads, outside_inference_mode
from torchpt.rendering import Rendering
from torchpt.rendering.batches import Picture, naming_errors, render_pictures, request_of, task_counts
from torchpt.rendering.execution import execute_request
from torchpt.rendering.requests import RenderRequest, template_of
from torchpt.scene import Scene, load
from torchpt.scene.prepare import make_wave
from torchpt.scene.settings import BatchOptions, RenderOptions, base_seed, film_keys
from torchpt.spec.arguments import check_names, expand_signature

__all__ = ["Made", "RenderDataset", "RenderStream", "SceneBatch", "SceneLoader"]

#: What ``make`` returns: a scene or a mapping of the scene format, optionally with arguments of ``torchpt.render``.
Made = Scene | Mapping[str, Any] | tuple[Scene | Mapping[str, Any], Mapping[str, Any]]


@dataclass(frozen=True)
class _Item:
    """An item that is ready to be rendered.

    Attributes:
        index: of the item.
        scene_index: of its scene.
        params: tensors in place of the scene's, by name.
        film: settings of the film.
        request: of its picture.
    """

    index: int
    scene_index: int
    params: Mapping[str, Tensor]
    film: Mapping[str, Any]
    request: RenderRequest


class _ItemRenderer:
    """Renders the items of a data set.

    Arguments are those of :class:`RenderDataset`; ``call`` is its name for errors, ``latest`` index, scene and options of the
    latest scene.
    """

    def __init__(
        self,
        call: str,
        make: Callable[[int], Made],
        cameras: Sequence[Any],
        spp: int | None,
        layers: Sequence[str],
        seed: int | Tensor,
        device: str | torch.device,
        options: Mapping[str, Any],
    ) -> None:
        if not callable(make):
            raise SceneError("make", make, "a function from a scene's index to the scene")
        check_names(call, options, RenderOptions, ("cameras", "layers"))
        for key in ("params", "spp", "seed"):
            if key in options:
                raise SceneError(key, options[key], "an argument of the data set, of `make` or none")
        _check_options(options)
        seed = base_seed(seed)
        if isinstance(layers, str) or not isinstance(layers, Iterable):
            raise SceneError("layers", layers, "a sequence of names of layers")
        self.make, self.layers, self.seed, self.device, self.options = make, tuple(layers), seed, device, dict(options)
        self.spp = spp
        self.cameras = _camera_params(cameras)
        self.latest: tuple[int, Scene, dict[str, Any]] | None = None

    def item(self, index: int) -> dict[str, Tensor]:
        """Return the item of an index, as :class:`RenderDataset` describes it."""
        with torch.no_grad():
            item = self._ready(index)
            return self._tensors(item, execute_request(item.request))

    def items(self, indices: Sequence[int]) -> list[dict[str, Tensor]]:
        """Return the items of indices, rendered side by side; the next scenes are made while others are rendered."""
        found: dict[int, dict[str, Tensor]] = {}  # by position in `indices`
        waiting: dict[int, _Item] = {}

        def pictures() -> Iterator[Picture]:
            for position, index in enumerate(indices):
                item = waiting[position] if position in waiting else self._ready(index)
                waiting[position] = item
                yield Picture(item.scene_index, position, f"items[{index}]", item.request)

        def on_done(picture: Picture, request: RenderRequest | None, rendering: Rendering) -> None:
            found[picture.camera] = self._tensors(waiting.pop(picture.camera), rendering)

        if not len(indices):
            return []
        with torch.no_grad():
            waiting[0] = self._ready(indices[0])
            with limited_threads(waiting[0].request.settings.render.threads):
                render_pictures(pictures(), task_counts(len(indices), None), on_done)
        return [found[position] for position in range(len(indices))]

    def _ready(self, index: int) -> _Item:
        """Make the scene of an index, and the request of its picture."""
        scene_index, camera_index = divmod(index, max(len(self.cameras), 1))
        scene, scene_options = self._scene(scene_index)
        options: dict[str, Any] = {**self.options, **scene_options}
        film = {
            **(film_keys(self.options.get("film")) or {}),
            **(film_keys(scene_options.get("film")) or {}),
            "aovs": list(self.layers),
            "denoise": False,
        }
        params = {**(self.cameras[camera_index] if self.cameras else {}), **(options.pop("params", None) or {})}
        params = {
            name: _tensor(
                f"params.{name}", value, scene.raw_params[name].dtype if name in scene.raw_params else torch.float32
            )
            for name, value in params.items()
        }
        if get_worker_info() is not None:
            options.setdefault("threads", 1)  # the workers share the cores
        options = {"spp": self.spp, "seed": self.seed + index, **options, "film": film}
        with naming_errors(f"make({scene_index})", ""):
            return _Item(index, scene_index, params, film, request_of(scene, True, params=params, **options))

    def _tensors(self, item: _Item, rendering: Rendering) -> dict[str, Tensor]:
        """Return picture, layers and camera of a rendered item."""
        scene, params = item.request.caller_scene, item.params
        pose_dtype = scene.raw_params["camera.to_world"].dtype  # float64 far from the origin
        to_world = scene.merged(params)["camera.to_world"].to(pose_dtype)
        layers = {name: rendering.layers[name] for name in self.layers}
        found = {"image": rendering.image, **layers, "to_world": to_world}
        if "camera.fov" in scene.raw_params:
            camera = {name: value for name, value in params.items() if name.startswith("camera.")}
            matrices = scene.pinhole(camera, item.film, pose_dtype)
            found |= {"K": matrices.K, "R": matrices.R, "t": matrices.t}
        return {**{name: value.detach() for name, value in found.items()}, "index": torch.tensor(item.index)}

    def _scene(self, index: int) -> tuple[Scene, dict[str, Any]]:
        """Return a scene and its arguments of ``render``; the latest is cached for its next camera."""
        if self.latest is None or self.latest[0] != index:
            with naming_errors(f"make({index})", ""):
                made = self.make(index)
            source, options = made if isinstance(made, tuple) and len(made) == 2 else (made, {})
            if not isinstance(source, Scene | Mapping) or not isinstance(options, Mapping):
                expected = (
                    "a scene from torchpt.load, a mapping of the scene format, or (one of them, arguments of render)"
                )
                raise SceneError(f"make({index})", made, expected)
            check_names("render", options, RenderOptions)
            _check_options(options, f"make({index}).")
            with naming_errors(f"make({index})", ""):
                scene = source if isinstance(source, Scene) else load(dict(source), self.device)
            self.latest = index, scene, dict(options)
        _, scene, options = self.latest
        return scene, dict(options)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "latest": None}  # each worker makes its own scene


class RenderDataset(Dataset):
    """A map-style data set of rendered pictures.

    Item ``i`` is a dict of tensors: ``image (H, W, 3)`` linear RGB; each of ``layers`` by name, ``(H, W, C)``; the camera as
    ``to_world (4, 4)`` and, of a perspective or thin lens one, as OpenCV's ``K (3, 3)`` in pixels, ``R (3, 3)`` and ``t (3,)``
    (docs/reference/cameras.md); ``index ()`` int64. ``torch.utils.data.DataLoader`` collates them into batches if all have one
    size; the items of a batch are rendered side by side, and the next scenes made meanwhile.

    The seed of item ``i`` is ``seed + i``. Renders use one thread in workers, and otherwise the scene's number, unless
    ``threads`` is given.

    Args:
        make: returns the scene of an index: a :class:`torchpt.Scene`, a mapping of the scene format, or a pair of one of these
            and arguments of ``torchpt.render`` (also ``params``), which take precedence over those of the data set.
        scenes: number of scenes.
        cameras: poses ``(4, 4)`` from camera to world, or mappings of ``camera.*`` parameters, for each scene: item
            ``i`` is scene ``i // len(cameras)`` by camera ``i % len(cameras)``. Without cameras, each scene has its own.
        spp: samples a pixel; None: the scene's own.
        layers: names of AOVs (``film.aovs``).
        seed: seed of item 0; any integer from 0, also as a tensor.
        device: device on which mappings are loaded.
        options: further arguments of ``torchpt.render``; not ``checkpoint``, nor those of gradients alone (``edge_guide``,
            ``seed_grad``, ``spp_grad``), which items do not have.

    Raises:
        SceneError: an argument is not accepted; on access, as ``load`` and ``render``, with ``make(index)`` in its key.
        TypeError: an unknown argument; on access, an index that is no integer.
        IndexError: on access, an index out of range.
    """

    def __init__(
        self,
        make: Callable[[int], Made],
        scenes: int,
        *,
        cameras: Sequence[Any] = (),
        spp: int | None = None,
        layers: Sequence[str] = (),
        seed: int | Tensor = 0,
        device: str | torch.device = "cpu",
        **options: Any,
    ) -> None:
        if type(scenes) is not int or scenes < 0:
            raise SceneError("scenes", scenes, "a whole number >= 0")
        self._items = _ItemRenderer("RenderDataset", make, cameras, spp, layers, seed, device, options)
        self.scenes = scenes

    def __len__(self) -> int:
        return self.scenes * max(len(self._items.cameras), 1)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        return self._items.item(self._checked(index))

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Tensor]]:
        """Return the items of a batch, as ``DataLoader`` asks for them; they are rendered side by side."""
        return self._items.items([self._checked(index) for index in indices])

    def _checked(self, index: Any) -> int:
        """Return an index from 0; negative ones count from the end.

        Raises:
            TypeError: not a whole number.
            IndexError: out of range.
        """
        try:
            index = operator.index(index)
        except TypeError:
            shown = repr(index) if isinstance(index, int | float | str | None) else f"a {type(index).__name__}"
            raise TypeError(f"index of a data set: expected a whole number, got {shown}") from None
        if not -len(self) <= index < len(self):
            raise IndexError(f"index {index} of a data set of {len(self)} items")
        return index % len(self)


class RenderStream(IterableDataset):
    """An iterable data set of the items of a :class:`RenderDataset`, endless by default.

    Ranks and workers share the items: rank ``r`` of ``R`` has the indices ``i`` with ``i % R == r``, and its worker ``w`` of
    ``W`` every ``W``-th of these. So no picture is rendered twice, and each has the same bits on any rank.

    Args:
        make: see :class:`RenderDataset`.
        scenes: number of scenes; None: endless.
        start: the first index, to resume a run.
        shard: ``(rank, world)``; by default those of ``torch.distributed``, if it is initialized in the process that starts
            the workers, else ``(0, 1)``.
        cameras: see :class:`RenderDataset`, as for all others.
        spp: see there.
        layers: see there.
        seed: see there.
        device: see there.
        options: see there.
    """

    def __init__(
        self,
        make: Callable[[int], Made],
        scenes: int | None = None,
        *,
        start: int = 0,
        shard: tuple[int, int] | None = None,
        cameras: Sequence[Any] = (),
        spp: int | None = None,
        layers: Sequence[str] = (),
        seed: int | Tensor = 0,
        device: str | torch.device = "cpu",
        **options: Any,
    ) -> None:
        if scenes is not None and (type(scenes) is not int or scenes < 0):
            raise SceneError("scenes", scenes, "a whole number >= 0, or None for no end")
        if type(start) is not int or start < 0:
            raise SceneError("start", start, "a whole number >= 0")
        shard = None if shard is None else _shard(shard)
        self._items = _ItemRenderer("RenderStream", make, cameras, spp, layers, seed, device, options)
        self.scenes = scenes
        self.start, self.shard = start, shard
        self.starter_ranks: tuple[int, int] | None = None  # rank and world of the process that started this worker

    def indices(self) -> Iterator[int]:
        """Yield the indices of the items of this process, in order."""
        rank, world = self.shard or self.starter_ranks or _rank_and_world()
        worker = get_worker_info()
        worker_id, workers = (0, 1) if worker is None else (worker.id, worker.num_workers)
        # The first index from `start` on that this rank has, and then that this worker of it has.
        index = self.start + (rank - self.start) % world + world * worker_id
        end = None if self.scenes is None else self.scenes * max(len(self._items.cameras), 1)
        while end is None or index < end:
            yield index
            index += world * workers

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        return (self._items.item(index) for index in self.indices())

    def __getstate__(self) -> dict[str, Any]:
        return {
            **self.__dict__,
            "starter_ranks": self.starter_ranks or _rank_and_world(),
        }  # spawned workers have no process group


# ---- Scenes, for training through the renderer


class SceneBatch(NamedTuple):
    """A batch of scenes.

    Attributes:
        indices: ``(B,)`` int64.
        scenes: the scenes of these indices, as ``render_batch`` takes them.
    """

    indices: Tensor
    scenes: tuple[Scene, ...]


class SceneLoader:
    """Batches of scenes; a thread loads and builds the next ones while the caller works with the batch before.

    Worlds and search structures are built too, so that ``torchpt.render_batch(scenes)`` begins to trace at once. Pictures have
    the bits of scenes that the caller loads. Each iteration is a new one over ``indices``. An error of ``make`` or of loading
    is raised where its batch would come.

    Args:
        make: returns the scene of an index: a :class:`torchpt.Scene`, or a mapping of the scene format. It is called in another
            thread, index by index in their order.
        indices: whole numbers: a ``range``, a list, a sampler of ``torch.utils.data`` (``DistributedSampler`` gives each rank
            its own), or ``itertools.count()`` for no end.
        batch_size: number of scenes of a batch.
        drop_last: True leaves out a last batch of fewer scenes.
        ahead: number of batches that are made ahead of the one in use; 0: each is made when it is asked for.
        options: arguments that ``render_batch`` will be given; those that decide what is built (``accel``, ``dtype``,
            ``film``, ``integrator``, ``threads``) should be the same. ``device`` is that on which mappings are loaded.

    Raises:
        SceneError: an argument is not accepted; during iteration, as ``torchpt.load``, with ``make(index)`` in its key.
        TypeError: an unknown argument.
    """

    @expand_signature
    def __init__(
        self,
        make: Callable[[int], Scene | Mapping[str, Any]],
        indices: Iterable[int],
        *,
        batch_size: int = 1,
        drop_last: bool = False,
        ahead: int = 1,
        **options: Unpack[BatchOptions],
    ) -> None:
        check_names("SceneLoader", options, BatchOptions, own=("batch_size", "drop_last", "ahead"))
        if not callable(make):
            raise SceneError("make", make, "a function from an index to the scene")
        if isinstance(indices, str | Mapping) or not isinstance(indices, Iterable):
            raise SceneError("indices", indices, "a range, a list, a sampler or another iterable of whole numbers")
        for key, value, low in (("batch_size", batch_size, 1), ("ahead", ahead, 0)):
            if type(value) is not int or value < low:
                raise SceneError(key, value, f"a whole number >= {low}")
        if not isinstance(drop_last, bool):
            raise SceneError("drop_last", drop_last, "True or False")
        self.make, self.indices = make, indices
        self.batch_size, self.drop_last, self.ahead = batch_size, drop_last, ahead
        self.options: dict[str, Any] = dict(options)

    def __len__(self) -> int:
        """Return the number of batches.

        Raises:
            TypeError: ``indices`` has no length.
        """
        if not isinstance(self.indices, Sized):
            raise TypeError(f"a SceneLoader over a {type(self.indices).__name__} has no length")
        count = len(self.indices)
        return count // self.batch_size if self.drop_last else -(-count // self.batch_size)

    def __iter__(self) -> Iterator[SceneBatch]:
        source = iter(self.indices)
        queue = TaskQueue[None, Scene](1)  # a single thread: scenes come in the order of indices
        started: deque[list[int]] = deque()  # indices of batches that are being made

        def start(batches: int) -> None:
            while len(started) < batches and (chunk := [_index(value) for value in islice(source, self.batch_size)]):
                if len(chunk) < self.batch_size and self.drop_last:
                    return
                started.append(chunk)
                for index in chunk:
                    queue.add(None, partial(self._built, index))

        try:
            while True:
                start(1 + self.ahead)
                if not started:
                    return
                scenes = []
                while len(scenes) < len(started[0]):
                    if (finished := queue.next(wait=True)) is None:
                        continue
                    if isinstance(finished[1], BaseException):
                        raise finished[1]
                    scenes.append(finished[1])
                indices = started.popleft()
                start(self.ahead)
                yield SceneBatch(torch.tensor(indices), tuple(scenes))
                del scenes  # the caller's from here on
        finally:
            queue.close()

    def _built(self, index: int) -> Scene:
        """Make the scene of an index, and build what a render needs."""
        with naming_errors(f"make({index})", ""):
            source = self.make(index)
            if not isinstance(source, Scene | Mapping):
                raise SceneError("", source, "a scene from torchpt.load, or a mapping of the scene format")
            scene = source if isinstance(source, Scene) else load(dict(source), self.options.get("device"))
            template = template_of(scene, True, self.options)
            with outside_inference_mode(), torch.no_grad():
                make_wave(scene, template.settings, None, template.call.dtype)  # the scene keeps world and search
        return scene


def _index(value: Any) -> int:
    """Return an index.

    Raises:
        SceneError: not a whole number.
    """
    try:
        return operator.index(value)
    except TypeError:
        raise SceneError("indices", value, "whole numbers") from None


# ---- Arguments


def _check_options(options: Mapping[str, Any], where: str = "") -> None:
    """Raise SceneError for arguments of ``render`` that have no effect here; ``where`` begins their keys."""
    film, params = film_keys(options.get("film")), options.get("params")
    if "full" in options:
        raise SceneError(f"{where}full", options["full"], "none: an item holds the picture and its layers")
    for key in ("edge_guide", "seed_grad", "spp_grad"):
        if options.get(key) is not None:
            raise SceneError(f"{where}{key}", options[key], "none: pictures of a data set have no gradients")
    if options.get("checkpoint") is not None:
        expected = "none: a file of one picture, which the items would share"
        raise SceneError(f"{where}checkpoint", options["checkpoint"], expected)
    if film is not None and not isinstance(film, Mapping):
        raise SceneError(f"{where}film", film, "(width, height), or a mapping of film settings")
    if params is not None and not isinstance(params, Mapping):
        raise SceneError(f"{where}params", params, "a mapping from names of scene.params to tensors")
    film = film or {}
    if film.get("aovs") not in (None, (), []):
        raise SceneError(f"{where}film.aovs", film["aovs"], "none: use layers, an argument of the data set")
    if film.get("denoise") not in (None, False):
        expected = "false: an item holds no denoised picture; hand its image to torchpt.denoise with its layers"
        raise SceneError(f"{where}film.denoise", film["denoise"], expected)


def _camera_params(cameras: Any) -> list[Mapping[str, Any]]:
    """Return each camera as parameters of a scene."""
    expected = "a sequence of poses (4, 4) or of mappings of camera.* parameters, or a tensor (C, 4, 4)"
    if isinstance(cameras, str | Mapping) or not isinstance(cameras, Iterable):
        raise SceneError("cameras", cameras, expected)
    if isinstance(cameras, Tensor | np.ndarray) and cameras.ndim != 3:
        raise SceneError("cameras", tuple(cameras.shape), expected)
    found: list[Mapping[str, Any]] = []
    for c, camera in enumerate(cameras):
        if not isinstance(camera, Mapping):
            shape = tuple(_tensor(f"cameras[{c}]", camera, torch.float64).shape)
            if shape == (4,):  # a row of a single pose
                raise SceneError("cameras", cameras, expected)
            if shape != (4, 4):
                raise SceneError(f"cameras[{c}]", f"shape {shape}", "a pose (4, 4) or a mapping of camera.* parameters")
            camera = {"camera.to_world": camera}
        elif not all(str(name).startswith("camera.") for name in camera):
            expected = "names of scene.params such as camera.fov; a whole camera block is for render_batch or seen_by"
            raise SceneError(f"cameras[{c}]", list(camera), expected)
        found.append(camera)
    return found


def _shard(shard: Any) -> tuple[int, int]:
    """Return rank and number of ranks.

    Raises:
        SceneError: no pair of whole numbers with ``0 <= rank < world``.
    """
    try:
        rank, world = map(operator.index, shard)
    except (TypeError, ValueError):
        rank, world = 0, 0
    if not 0 <= rank < world:
        raise SceneError("shard", shard, "(rank, world) with 0 <= rank < world")
    return rank, world


def _tensor(key: str, value: Any, dtype: torch.dtype) -> Tensor:
    """Return a floating tensor unchanged, other numbers as a tensor of ``dtype``."""
    if isinstance(value, Tensor) and value.is_floating_point():
        return value
    try:
        return torch.as_tensor(value, dtype=dtype)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise SceneError(key, value, "numbers, or a floating tensor") from None


def _rank_and_world() -> tuple[int, int]:
    """Return rank and number of ranks; ``(0, 1)`` without a process group."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1
