"""Render scenes by cameras in one call; each picture is that of ``render``, to the bit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, repeat
from typing import Any, Literal, Unpack, overload
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from torchpt.core.autograd import is_transformed
from torchpt.core.errors import SceneError
from torchpt.core.memory import check_limit, mb
from torchpt.core.threads import limited_threads, outside_inference_mode
from torchpt.engines.engine import TASKS
from torchpt.paths.wave import Wave
from torchpt.rendering import QueuedRender, Rendering, Run, render_many
from torchpt.rendering.batches.inputs import Cameras, Seeds, cameras_of, named, params_of, scenes_of, seeds_of
from torchpt.rendering.requests import RenderRequest, execute_request, prepare_request
from torchpt.scene import Scene
from torchpt.scene.entry import as_scene
from torchpt.scene.settings import BatchOptions, RenderOptions
from torchpt.scene.versions import check_unchanged
from torchpt.spec.arguments import check_names, expand_signature

__all__ = ["Renderings", "render_batch"]


@dataclass(repr=False, eq=False)
class Renderings:
    """The pictures of S scenes by C cameras; ``renderings[s, c]`` is a :class:`torchpt.Rendering`.

    Attributes:
        image: ``(S, C, H, W, 3)`` linear RGB; it requires gradients if parameters or poses do.
        layers: the AOVs of ``film.aovs`` by name, each ``(S, C, H, W, channels)``.
        denoised: the denoised pictures ``(S, C, H, W, 3)``; None without ``film.denoise``.
        rows: the renderings, a tuple for each scene. Their times overlap.
    """

    image: Tensor
    layers: dict[str, Tensor]
    denoised: Tensor | None
    rows: tuple[tuple[Rendering, ...], ...]

    def __getitem__(self, which: tuple[int, int]) -> Rendering:
        """Return the rendering of scene ``s`` by camera ``c``."""
        if not isinstance(which, tuple) or len(which) != 2:
            raise TypeError(f"expected renderings[s, c], a scene's number and a camera's, got renderings[{which!r}]")
        s, c = which
        return self.rows[s][c]

    def __repr__(self) -> str:
        return f"Renderings({' x '.join(map(str, self.image.shape))}; layers: {', '.join(self.layers) or 'none'})"


@dataclass(frozen=True)
class _Picture:
    """One picture of a batch: its indices, its name in errors, and the request."""

    scene: int
    camera: int
    name: str
    request: RenderRequest


Pictures = Mapping[str, Tensor] | Sequence[Mapping[str, Tensor]] | None


@overload
def render_batch(
    scenes: Scene | Iterable[Scene], cameras: Cameras = None, params: Pictures = None, *, seed: Seeds = None,
    on_progress: Callable[[int, int | None], None] | None = None, full: Literal[False] = False, **options: Unpack[BatchOptions],
) -> Tensor: ...  # fmt: skip
@overload
def render_batch(
    scenes: Scene | Iterable[Scene], cameras: Cameras = None, params: Pictures = None, *, seed: Seeds = None,
    on_progress: Callable[[int, int | None], None] | None = None, full: Literal[True], **options: Unpack[BatchOptions],
) -> Renderings: ...  # fmt: skip
@expand_signature
def render_batch(
    scenes: Scene | Iterable[Scene],
    cameras: Cameras = None,
    params: Pictures = None,
    *,
    seed: Seeds = None,
    on_progress: Callable[[int, int | None], None] | None = None,
    full: bool = False,
    **options: Unpack[BatchOptions],
) -> Tensor | Renderings:
    """Render S scenes by C cameras to linear RGB ``(S, C, H, W, 3)``; differentiable in ``params`` and poses.

    Picture ``[s, c]`` is to the bit ``torchpt.render(scenes[s].seen_by(cameras[c]), params=..., seed=...)``. Threads share one
    queue of tasks of all pictures, and the next pictures are prepared while they trace. World, search structure and kernels
    are made once for all cameras of a scene. Pictures are rendered one after another by tensor operations (as on CUDA), with
    a time limit or target error, in bounded memory, or by several ``ranks`` (which share each picture's pixels).

    Args:
        scenes: scenes of :func:`torchpt.load` with films of one size: a sequence, or an iterator, which may load each while
            others are rendered; or one scene, of which ``params`` make S.
        cameras: shared by all scenes: a sequence of blocks ``camera`` as in scene files (with ``K``, ``R``, ``t`` too), of
            poses ``camera.to_world (4, 4)`` for the scenes' own cameras, or a tensor of poses ``(C, 4, 4)``; None: each
            scene's own camera, C = 1.
        params: tensors in place of the scenes', by dotted name: a mapping to tensors with a leading dimension S, or a sequence
            of S mappings.
        seed: one seed for all pictures (by default the scenes' own), a sequence of S, or S sequences of C.
        on_progress: called after each picture with the number of finished and of all pictures (None: an iterator of scenes).
        full: True returns :class:`Renderings`: pictures, AOVs, and the facts of each picture.
        options: other arguments of :func:`torchpt.render`, the same for all pictures. ``checkpoint`` is refused;
            ``max_memory`` bounds the whole batch with its pictures.

    Raises:
        SceneError: an argument is not accepted; its key names the scene or camera, such as ``scenes[3].``.
        RenderError: as :func:`torchpt.render`.
        TypeError: an unknown argument.
    """
    check_names("render_batch", options, RenderOptions, ("cameras", "on_progress"))
    if on_progress is not None and not callable(on_progress):
        raise SceneError("on_progress", on_progress, "a function")
    scenes = scenes_of(scenes)
    checkpoint = options.get("checkpoint")
    if checkpoint is not None:
        raise SceneError("render.checkpoint", checkpoint, "null for a batch")
    sets = params_of(params, scenes)
    views = cameras_of(cameras)
    size = len(sets or [None]) if isinstance(scenes, Scene) else len(scenes) if isinstance(scenes, Sequence) else None
    seeds = seeds_of(seed, size, len(views))
    several = isinstance(scenes, Scene)
    pictures = _pictures(repeat(scenes, size or 1) if several else scenes, several, views, sets, seeds, full, options)
    first = next(pictures, None)
    if first is None:
        raise SceneError("scenes", 0, "one scene at least")
    total = None if size is None else size * len(views)
    found: dict[tuple[int, int], tuple[RenderRequest | None, Rendering]] = {}
    with limited_threads(first.request.settings.render.threads):
        tasks = 1 if total is None else -(-TASKS * torch.get_num_threads() // total)
        _check_memory(first.request, total)
        render_many(_entries(chain([first], pictures), found, on_progress, total), tasks)
    count = 1 + max(s for s, _ in found)
    for key, given in (("params", sets), ("seed", seed)):
        if isinstance(given, Sequence | Tensor | np.ndarray) and len(given) != count:
            raise SceneError(key, len(given), f"as many as there are scenes, {count}")
    # Gradients last: autograd wraps pictures that are rendered already.
    rows = tuple(tuple(_taped(found.pop((s, c))) for c in range(len(views))) for s in range(count))
    image = _stacked([[r.image for r in row] for row in rows])
    if not full:
        return image
    layers = {name: _stacked([[r.layers[name] for r in row] for row in rows]) for name in rows[0][0].layers}
    smooth = [[r.denoised for r in row if r.denoised is not None] for row in rows]
    return Renderings(image, layers, _stacked(smooth) if smooth[0] else None, rows)


def _stacked(rows: list[list[Tensor]]) -> Tensor:
    with outside_inference_mode():
        return torch.stack([torch.stack(row) for row in rows])


def _taped(found: tuple[RenderRequest | None, Rendering]) -> Rendering:
    """Return a rendering with autograd; without a request it needs none."""
    request, rendering = found
    return rendering if request is None else execute_request(request, [rendering])


def _pictures(
    scenes: Iterable[Scene],
    several: bool,
    cameras: Sequence[Mapping[str, Any] | Tensor | None],
    sets: Sequence[Mapping[str, Tensor]] | None,
    seeds: Any,
    full: bool,
    options: BatchOptions,
) -> Iterator[_Picture]:
    """Yield the pictures, those of a scene together; ``several``: they share one scene with different parameters."""
    like: dict[str, Any] = {}
    versions: WeakKeyDictionary[Scene, dict[str, int]] = WeakKeyDictionary()
    for s, each in enumerate(scenes):
        scene = as_scene(each, f"scenes[{s}]")
        if not several:  # earlier pictures of the scene may still be in work
            with named(f"scenes[{s}]", None):
                now = scene.versions()
                check_unchanged(versions.setdefault(scene, now), now, "while the batch has it")
        if sets is not None and s >= len(sets):
            raise SceneError("params", len(sets), "as many as there are scenes")
        for c, camera in enumerate(cameras):
            name = ("" if sets is None else f"params[{s}]") if several else f"scenes[{s}]"
            with named(name, c if camera is not None else None):
                request = _ordered(scene, camera, {} if sets is None else sets[s], seeds(s, c), full, options)
                film = request.settings.film
                _, _, *size = film.crop or (0, 0, film.width, film.height)
                asked = {"width": size} | ({"aovs": list(film.aovs), "denoise": film.denoise} if full else {})
                like = like or asked
                for key, value in asked.items():
                    if value != like[key]:
                        raise SceneError(f"film.{key}", value, f"{like[key]}, as of the first picture")
            yield _Picture(s, c, name, request)


def _ordered(
    scene: Scene,
    camera: Mapping[str, Any] | Tensor | None,
    params: Mapping[str, Tensor],
    seed: int | None,
    full: bool,
    options: BatchOptions,
) -> RenderRequest:
    """Return the request for one picture."""
    if isinstance(camera, Tensor):
        if "camera.to_world" in params:
            raise SceneError("params.camera.to_world", "a pose", "none where cameras are poses")
        params = {**params, "camera.to_world": camera}
    elif camera is not None:
        scene = scene.seen_by(camera, options.get("film"))
    request = prepare_request(scene, full, params=params, seed=seed, **options)
    if any(map(is_transformed, request.params.values())):
        raise SceneError(
            "params", "tensors under a transform of torch.func", "plain ones: transforms go through render"
        )
    request.scene.check(request.params)
    return request.with_versions()


def _entries(
    pictures: Iterable[_Picture],
    found: dict[tuple[int, int], tuple[RenderRequest | None, Rendering]],
    on_progress: Callable[[int, int | None], None] | None,
    total: int | None,
) -> Iterator[QueuedRender]:
    """Return the renders of pictures; they put requests that need gradients, and renderings, into ``found``."""
    latest: list[tuple[int, Wave]] = []  # index and wave of the latest scene

    def entry(picture: _Picture) -> QueuedRender:
        request, place = picture.request, (picture.scene, picture.camera)
        needs_gradients = request.needs_gradients  # read before gradients are disabled

        def make(threads: int) -> Run:
            like = next((wave for scene, wave in latest if scene == picture.scene), None)
            plain = {name: value.detach() for name, value in request.params.items()}
            run = Run(request.scene, request.settings, plain, request.call.dtype, request.call.ranks, like, threads)
            latest[:] = [(picture.scene, run.wave)]
            return run

        def done(rendering: Rendering) -> None:
            request.check_unchanged("while the batch has it")
            # A request keeps its scene alive, and there may be many.
            found[place] = (request, rendering) if needs_gradients else (None, execute_request(request, [rendering]))
            if on_progress is not None:
                on_progress(len(found), total)

        def failed(error: BaseException) -> None:
            with named(picture.name, None):
                raise error

        return QueuedRender(request.scene.device, make, done, failed)

    return map(entry, pictures)


def _check_memory(request: RenderRequest, total: int | None) -> None:
    """Raise if the pictures of a batch alone need more than ``render.max_memory``."""
    limit, film = request.settings.render.max_memory, request.settings.film
    _, _, width, height = film.crop or (0, 0, film.width, film.height)
    bytes_each = torch.finfo(request.call.dtype).bits // 8
    held = 2 * 3 * width * height * bytes_each * (total or 1)  # single pictures, and the stacked ones
    if limit is not None:
        check_limit(limit, held, f"more than the {mb(held)} that the pictures alone take")
