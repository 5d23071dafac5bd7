"""Rendered pictures as data sets of ``torch.utils.data``: ``RenderDataset`` by index, ``RenderStream`` without end.

An item is a function of its index alone: the same bits in any number of workers, forked or spawned, on any rank. For it,
what is handed over as ``make`` must be such a function too: draw its random numbers from
``torch.Generator().manual_seed(index)``. Spawned workers pickle the data set, so that ``make`` must be a function of a
module, no ``lambda``.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from torchpt.core.errors import SceneError
from torchpt.rendering.api import render
from torchpt.scene import Scene, load
from torchpt.scene.settings import RenderOptions
from torchpt.spec.arguments import check_names

__all__ = ["Made", "RenderDataset", "RenderStream"]

#: A scene or a mapping of the scene format; with arguments of ``torchpt.render`` for it, where there are some.
Made = Scene | Mapping[str, Any] | tuple[Scene | Mapping[str, Any], Mapping[str, Any]]


class _ItemRenderer:
    """How an index becomes an item."""

    def __init__(
        self,
        call: str,
        make: Callable[[int], Made],
        cameras: Sequence[Any],
        spp: int | None,
        layers: Sequence[str],
        seed: int,
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
        if type(seed) is not int or seed < 0:
            raise SceneError("seed", seed, "a whole number >= 0")
        if isinstance(layers, str) or not isinstance(layers, Iterable):
            raise SceneError("layers", layers, "a sequence of names of layers")
        self.make, self.layers, self.seed, self.device, self.options = make, tuple(layers), seed, device, dict(options)
        self.spp = spp
        self.cameras = _cameras(cameras)
        self.latest: tuple[int, Scene, dict[str, Any]] | None = None

    def item(self, index: int) -> dict[str, Tensor]:
        """See :class:`RenderDataset`."""
        number, view = divmod(index, max(len(self.cameras), 1))
        scene, own = self._scene(number)
        options: dict[str, Any] = {**self.options, **own}
        film = {
            **(self.options.get("film") or {}),
            **(own.get("film") or {}),
            "aovs": list(self.layers),
            "denoise": False,
        }
        params = {**(self.cameras[view] if self.cameras else {}), **(options.pop("params", None) or {})}
        own_types = {name: value.dtype for name, value in scene.params.items()}
        params = {n: _tensor(f"params.{n}", value, own_types.get(n, torch.float32)) for n, value in params.items()}
        if get_worker_info() is not None:
            options.setdefault("threads", 1)  # workers share the cores
        options = {"spp": self.spp, "seed": self.seed + index, **options, "film": film}
        with torch.no_grad():
            found = render(scene, params=params, full=True, **options)
            exact = own_types["camera.to_world"]  # float64 far from the origin
            world = scene.merged(params)["camera.to_world"].to(exact)
            item = {"image": found.image, **{name: found.layers[name] for name in self.layers}, "to_world": world}
            if "camera.fov" in scene.params:
                seen = {name: value for name, value in params.items() if name.startswith("camera.")}
                matrices = scene.pinhole(seen, film, exact)
                item |= {"K": matrices.K, "R": matrices.R, "t": matrices.t}
        return {**{name: value.detach() for name, value in item.items()}, "index": torch.tensor(index)}

    def _scene(self, number: int) -> tuple[Scene, dict[str, Any]]:
        """A scene and its own wishes; the latest one is kept, for its next camera."""
        if self.latest is None or self.latest[0] != number:
            made = self.make(number)
            source, own = made if isinstance(made, tuple) and len(made) == 2 else (made, {})
            if not isinstance(source, Scene | Mapping) or not isinstance(own, Mapping):
                expected = (
                    "a scene from torchpt.load, a mapping of the scene format, or (one of them, arguments of render)"
                )
                raise SceneError(f"make({number})", made, expected)
            check_names("render", own, RenderOptions)
            _check_options(own, f"make({number}).")
            scene = source if isinstance(source, Scene) else load(dict(source), self.device)
            self.latest = number, scene, dict(own)
        return self.latest[1], dict(self.latest[2])

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "latest": None}  # workers make their own


class RenderDataset(Dataset):
    """A data set of rendered pictures, by index.

    Item ``i`` is a dict of tensors: ``image (H, W, 3)`` linear RGB; each of ``layers`` by name, ``(H, W, C)``; the camera as
    ``to_world (4, 4)`` and, of a perspective or thin lens one, as OpenCV's ``K (3, 3)`` in pixels, ``R (3, 3)`` and ``t (3,)``
    (docs/reference/cameras.md); ``index ()`` int64. ``torch.utils.data.DataLoader`` puts them into batches as they are, where
    all are of one size.

    Its seed is ``seed + i``. In workers a render takes one thread, else as many as the scene wishes, unless ``threads``
    says otherwise.

    Args:
        make: from a scene's index to the scene: a :class:`torchpt.Scene`, a mapping of the scene format, or a pair of one of
            these and arguments of ``torchpt.render`` (``params`` among them), which win over those of the data set.
        scenes: how many there are.
        cameras: poses ``(4, 4)`` from camera to world, or mappings of ``camera.*`` parameters, for each scene: item
            ``i`` is scene ``i // len(cameras)`` seen by camera ``i % len(cameras)``. Without any, each scene has its own.
        spp: samples a pixel; None: the scene's own wish.
        layers: names of layers (``film.aovs``).
        seed: of item 0; any integer from 0.
        device: where mappings are loaded.
        options: further arguments of ``torchpt.render``.

    Raises:
        SceneError: arguments that are not accepted; on access, what ``load`` and ``render`` raise.
        TypeError: an argument that ``render`` does not know; on access, an index that is no whole number.
        IndexError: on access, an index that there is not.
    """

    def __init__(
        self,
        make: Callable[[int], Made],
        scenes: int,
        *,
        cameras: Sequence[Any] = (),
        spp: int | None = None,
        layers: Sequence[str] = (),
        seed: int = 0,
        device: str | torch.device = "cpu",
        **options: Any,
    ) -> None:
        if type(scenes) is not int or scenes < 0:
            raise SceneError("scenes", scenes, "a whole number >= 0")
        self._items, self.scenes = (
            _ItemRenderer("RenderDataset", make, cameras, spp, layers, seed, device, options),
            scenes,
        )

    def __len__(self) -> int:
        return self.scenes * max(len(self._items.cameras), 1)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        try:
            index = operator.index(index)
        except TypeError:
            shown = repr(index) if isinstance(index, int | float | str | None) else f"a {type(index).__name__}"
            raise TypeError(f"index of a data set: expected a whole number, got {shown}") from None
        if not -len(self) <= index < len(self):
            raise IndexError(f"index {index} of a data set of {len(self)} items")
        return self._items.item(index % len(self))


class RenderStream(IterableDataset):
    """The items of a :class:`RenderDataset` one after the other, without end by default.

    Ranks and workers share them: rank ``r`` of ``R`` has the indices ``i`` with ``i % R == r``, and its worker ``w`` of ``W``
    every ``W``-th of these. So no picture is rendered twice, and one that is rendered on another rank has the same bits.

    Args:
        make: see :class:`RenderDataset`.
        scenes: how many there are; None: no end.
        start: the first index, to go on where a run ended.
        shard: ``(rank, world)``; by default those of ``torch.distributed``, where it is set up in the process that makes the
            workers, else ``(0, 1)``.
        cameras: see :class:`RenderDataset`; so are all others.
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
        seed: int = 0,
        device: str | torch.device = "cpu",
        **options: Any,
    ) -> None:
        if scenes is not None and (type(scenes) is not int or scenes < 0):
            raise SceneError("scenes", scenes, "a whole number >= 0, or None for no end")
        if type(start) is not int or start < 0:
            raise SceneError("start", start, "a whole number >= 0")
        if shard is not None and not 0 <= shard[0] < shard[1]:
            raise SceneError("shard", shard, "(rank, world) with 0 <= rank < world")
        self._items = _ItemRenderer("RenderStream", make, cameras, spp, layers, seed, device, options)
        self.scenes = scenes
        self.start, self.shard = start, shard
        self.seen: tuple[int, int] | None = None  # of the process that made this worker

    def indices(self) -> Iterator[int]:
        """Those that this process renders, in order."""
        rank, world = self.shard or self.seen or _ranks()
        worker = get_worker_info()
        mine, workers = (0, 1) if worker is None else (worker.id, worker.num_workers)
        index = self.start + (rank - self.start) % world + world * mine
        end = None if self.scenes is None else self.scenes * max(len(self._items.cameras), 1)
        while end is None or index < end:
            yield index
            index += world * workers

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        return (self._items.item(index) for index in self.indices())

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "seen": self.seen or _ranks()}  # spawned workers know nothing of ranks


def _check_options(options: Mapping[str, Any], where: str = "") -> None:
    """Refuse arguments of ``render`` that would change nothing here; ``where``: what their keys begin with."""
    film, params = options.get("film"), options.get("params")
    if "full" in options:
        raise SceneError(f"{where}full", options["full"], "none: an item holds the picture and its layers")
    if film is not None and not isinstance(film, Mapping):
        raise SceneError(f"{where}film", film, "a mapping of film settings such as width")
    if params is not None and not isinstance(params, Mapping):
        raise SceneError(f"{where}params", params, "a mapping from names of scene.params to tensors")
    film = film or {}
    if film.get("aovs") not in (None, (), []):
        raise SceneError(f"{where}film.aovs", film["aovs"], "none: use layers, an argument of the data set")
    if film.get("denoise") not in (None, False):
        expected = "false: an item holds no denoised picture; hand its image to torchpt.denoise with its layers"
        raise SceneError(f"{where}film.denoise", film["denoise"], expected)


def _cameras(cameras: Any) -> list[Mapping[str, Any]]:
    """Each camera as parameters of a scene."""
    if isinstance(cameras, str | Mapping) or not isinstance(cameras, Iterable):
        raise SceneError("cameras", cameras, "a sequence of poses (4, 4) or of mappings of camera.* parameters")
    found: list[Mapping[str, Any]] = []
    for c, camera in enumerate(cameras):
        if not isinstance(camera, Mapping):
            shape = tuple(_tensor(f"cameras[{c}]", camera, torch.float64).shape)
            if shape != (4, 4):
                raise SceneError(f"cameras[{c}]", f"shape {shape}", "a pose (4, 4) or a mapping of camera.* parameters")
            camera = {"camera.to_world": camera}
        elif not all(str(name).startswith("camera.") for name in camera):
            expected = "names of scene.params such as camera.fov; a whole camera block is for render_batch or seen_by"
            raise SceneError(f"cameras[{c}]", list(camera), expected)
        found.append(camera)
    return found


def _tensor(key: str, value: Any, dtype: torch.dtype) -> Tensor:
    """A floating tensor as it is, and other numbers as one of ``dtype``."""
    if isinstance(value, Tensor) and value.is_floating_point():
        return value
    try:
        return torch.as_tensor(value, dtype=dtype)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise SceneError(key, value, "numbers, or a floating tensor") from None


def _ranks() -> tuple[int, int]:
    """Rank and number of ranks; ``(0, 1)`` where there are none."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return 0, 1
