"""Render scenes by cameras in one call; each picture is that of ``render``, to the bit.

For each picture :func:`render_batch` prepares a request (checked arguments of one ``render``); the pictures are rendered
without gradients from one queue of tasks, and autograd wraps each afterwards where its request needs gradients.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, repeat
from typing import Any, Literal, Unpack, cast, overload
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchpt.core.autograd import is_transformed, under_transforms
from torchpt.core.errors import SceneError
from torchpt.core.memory import check_limit, mb
from torchpt.core.threads import limited_threads, outside_inference_mode
from torchpt.engines.engine import TASKS
from torchpt.paths.wave import Wave
from torchpt.rendering import QueuedRender, Rendering, Run, render_many
from torchpt.rendering.batches.backward import SharedBackward
from torchpt.rendering.batches.inputs import (
    BatchCameras,
    Cameras,
    Counts,
    Seeds,
    cameras_of,
    naming_errors,
    number_of,
    params_of,
    scenes_of,
    values_of,
)
from torchpt.rendering.execution import execute_request
from torchpt.rendering.forward_layers import with_derivatives
from torchpt.rendering.requests import RenderRequest, prepare_request
from torchpt.scene import Scene
from torchpt.scene.entry import as_scene
from torchpt.scene.settings import BatchOptions, CommonOptions, Params
from torchpt.scene.versions import check_unchanged
from torchpt.spec.arguments import SCENE_VALUE, check_names, expand_signature

__all__ = ["Picture", "Renderings", "render_batch", "render_pictures", "request_of", "task_counts"]


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
class Picture:
    """One picture of a batch: its indices, its name in errors, and the request.

    Attributes:
        scene: number of the scene with its parameters; consecutive pictures of one number differ in cameras and samples only.
        camera: number of the camera.
        name: such as ``scenes[3]``; "" if there is nothing to name.
        request: of the picture, with the versions of the scene's parameters.
    """

    scene: int
    camera: int
    name: str
    request: RenderRequest


#: Tensors with a leading dimension for scenes, by name; or a mapping for each scene.
BatchParams = Params | Sequence[Params] | None


@overload
def render_batch(
    scenes: Scene | Iterable[Scene], cameras: Cameras = None, params: BatchParams = None, *, spp: Counts = None,
    seed: Seeds = SCENE_VALUE, on_progress: Callable[[int, int | None], None] | None = None,
    full: Literal[False] = False, **options: Unpack[BatchOptions],
) -> Tensor: ...  # fmt: skip
@overload
def render_batch(
    scenes: Scene | Iterable[Scene], cameras: Cameras = None, params: BatchParams = None, *, spp: Counts = None,
    seed: Seeds = SCENE_VALUE, on_progress: Callable[[int, int | None], None] | None = None,
    full: Literal[True], **options: Unpack[BatchOptions],
) -> Renderings: ...  # fmt: skip
@expand_signature
def render_batch(
    scenes: Scene | Iterable[Scene],
    cameras: Cameras = None,
    params: BatchParams = None,
    *,
    spp: Counts = None,
    seed: Seeds = SCENE_VALUE,
    on_progress: Callable[[int, int | None], None] | None = None,
    full: bool = False,
    **options: Unpack[BatchOptions],
) -> Tensor | Renderings:
    """Render S scenes by C cameras to linear RGB ``(S, C, H, W, 3)``; differentiable in ``params`` and poses.

    Picture ``[s, c]`` is to the bit ``torchpt.render(scenes[s].seen_by(cameras[c]), params=..., spp=..., seed=...)``. Threads
    share one queue of tasks of all pictures, and the next pictures are prepared while they trace. World, search structure and
    kernels are made once for all cameras of a scene. Pictures are rendered one after another by tensor operations (as on
    CUDA), with a time limit or target error, in bounded memory, by several ``ranks`` (which share each picture's pixels), and
    under transforms of ``torch.func``.

    Args:
        scenes: scenes of :func:`torchpt.load` with films of one size: a sequence, or an iterator, which may load each while
            others are rendered; or one scene, of which ``params`` make S.
        cameras: shared by all scenes: a sequence of blocks ``camera`` as in scene files (with ``K``, ``R``, ``t`` too), of
            poses ``camera.to_world (4, 4)`` for the scenes' own cameras, or a tensor of poses ``(C, 4, 4)``; for each scene
            its own: a sequence of S such sequences, or a tensor ``(S, C, 4, 4)``; None: each scene's own camera, C = 1.
        params: values in place of the scenes', by dotted name: a mapping to tensors (or lists) with a leading dimension S, or a
            sequence of S mappings as :func:`torchpt.render` takes them.
        spp: samples a pixel, of all pictures (None: the scenes' own), a sequence of S, or S sequences of C.
        seed: one seed for all pictures (by default the scenes' own), a sequence of S, or S sequences of C; None: a new one for
            each picture, from torch's default generator.
        on_progress: called after each picture with the number of finished and of all pictures (None: an iterator of scenes).
        full: True returns :class:`Renderings`: pictures, AOVs, and the facts of each picture.
        options: other arguments of :func:`torchpt.render`, the same for all pictures. ``checkpoint`` and ``edge_guide`` are
            refused; ``max_memory`` bounds the whole batch with its pictures.

    Raises:
        SceneError: an argument is not accepted; its key names the scene or camera, such as ``scenes[3].``.
        RenderError: as :func:`torchpt.render`.
        TypeError: an unknown argument.
    """
    own = ("cameras", "params", "spp", "seed", "on_progress", "full")
    edge_guide = cast(dict[str, Any], options).pop("edge_guide", None)
    check_names("render_batch", options, BatchOptions, own)
    if on_progress is not None and not callable(on_progress):
        raise SceneError("on_progress", on_progress, "a function")
    scenes = scenes_of(scenes)
    checkpoint = options.get("checkpoint")
    if checkpoint is not None:
        raise SceneError("render.checkpoint", checkpoint, "null for a batch")
    if edge_guide is not None:
        expected = (
            "None for a batch: a guide learns from one backward pass after the other, and those of a batch overlap"
        )
        raise SceneError("edge_guide", edge_guide, expected)
    param_sets = params_of(params, scenes)
    # Number of scenes; None for an iterator.
    size = (
        len(param_sets or [None])
        if isinstance(scenes, Scene)
        else len(scenes)
        if isinstance(scenes, Sequence)
        else None
    )
    batch_cameras = cameras_of(cameras, size)
    spp_of = values_of("spp", spp, size, batch_cameras.count)
    shares_scene = isinstance(scenes, Scene)
    pictures = _pictures(
        repeat(scenes, size or 1) if shares_scene else scenes,
        batch_cameras,
        param_sets,
        spp_of,
        values_of("seed", seed, size, batch_cameras.count),
        options,
        shares_scene=shares_scene,
        full=full,
    )
    first = next(pictures, None)
    if first is None:
        raise SceneError("scenes", 0, "one scene at least")
    total = None if size is None else size * batch_cameras.count
    found: dict[tuple[int, int], tuple[RenderRequest | None, Rendering]] = {}  # by scene and camera

    def on_done(picture: Picture, request: RenderRequest | None, rendering: Rendering) -> None:
        found[picture.scene, picture.camera] = request, rendering
        if on_progress is not None:
            on_progress(len(found), total)

    with limited_threads(first.request.settings.render.threads):
        _check_memory(first.request, total)
        given_spp = [spp_of(s, c) for s in range(size or 0) for c in range(batch_cameras.count)]
        # Others are errors, or None for the scenes' own.
        counts = [spp for spp in given_spp if type(spp) is int and spp > 0]
        tasks_of = task_counts(total, sum(counts) / len(counts) if counts else None) if total else lambda picture: 1
        if under_transforms():  # threads of a queue cannot take their tensors
            for picture in chain([first], pictures):
                with naming_errors(picture.name, ""):
                    on_done(picture, None, execute_request(picture.request))
        else:
            render_pictures(chain([first], pictures), tasks_of, on_done)
    count = 1 + max(s for s, _ in found)
    rows_of_cameras = None if batch_cameras.shared else batch_cameras.rows
    for key, given in (("params", param_sets), ("cameras", rows_of_cameras), ("spp", spp), ("seed", seed)):
        entries = number_of(given)
        if entries not in (None, count):
            raise SceneError(key, entries, f"as many as there are scenes, {count}")
    # Gradients last: autograd wraps pictures that are rendered already.
    shared = SharedBackward(first.request.settings.render.threads)
    joint: list[tuple[int, int]] = []  # pictures whose backward passes are shared

    def differentiable(s: int, c: int) -> Rendering:
        request, rendering = found.pop((s, c))
        if request is None:
            return rendering
        if not shared.accepts(request):
            return execute_request(request, [rendering])
        joint.append((s, c))
        return execute_request(request, [rendering], shared.share)

    rows = tuple(tuple(differentiable(s, c) for c in range(batch_cameras.count)) for s in range(count))
    images = [[rendering.image for rendering in row] for row in rows]
    for (s, c), image in zip(joint, shared.join([images[s][c] for s, c in joint]), strict=True):
        images[s][c] = image
    image = _stack(images)
    if not full:
        return image
    names = tuple(rows[0][0].layers)

    def stacked() -> dict[str, Tensor]:
        return {name: _stack([[r.layers[name] for r in row] for row in rows]) for name in names}

    layers = with_derivatives(dict.fromkeys(names, image), names, stacked)
    smooth = [[r.denoised for r in row if r.denoised is not None] for row in rows]
    return Renderings(image, layers, _stack(smooth) if smooth[0] else None, rows)


def _stack(rows: list[list[Tensor]]) -> Tensor:
    """Return pictures ``(H, W, C)`` of scenes by cameras as one tensor ``(scenes, cameras, H, W, C)``."""
    with outside_inference_mode():
        return torch.stack([torch.stack(row) for row in rows])


def task_counts(pictures: int, mean_spp: float | None) -> Callable[[Picture], int]:
    """Return a function that gives the number of tasks of a picture: of all pictures together as many as one render has.

    Args:
        pictures: number of pictures.
        mean_spp: mean of their samples a pixel, to which tasks are in proportion; None: as many for each.
    """
    tasks_per_picture = TASKS * torch.get_num_threads() / pictures
    if mean_spp is None:
        return lambda picture: math.ceil(tasks_per_picture)
    return lambda picture: math.ceil(tasks_per_picture * picture.request.settings.render.spp / mean_spp)


def _pictures(
    scenes: Iterable[Scene],
    cameras: BatchCameras,
    param_sets: Sequence[Params] | None,
    spp: Callable[[int, int], Any],
    seeds: Callable[[int, int], Any],
    options: BatchOptions,
    *,
    shares_scene: bool,
    full: bool,
) -> Iterator[Picture]:
    """Yield the pictures, those of a scene together.

    Args:
        scenes: the scenes, in order.
        cameras: the cameras.
        param_sets: parameters of each scene; None: none.
        spp: returns the samples a pixel of scene ``s`` and camera ``c``.
        seeds: returns the seed, likewise.
        options: arguments of ``render`` for all pictures.
        shares_scene: True: all scenes are one, with different parameters.
        full: as for :func:`render_batch`.

    Raises:
        SceneError: an argument is not accepted, or a film differs from that of the first picture.
    """
    first_facts: dict[str, Any] = {}
    versions: WeakKeyDictionary[Scene, dict[str, int]] = WeakKeyDictionary()
    for s, candidate in enumerate(scenes):
        scene = as_scene(candidate, f"scenes[{s}]")
        if not shares_scene:  # earlier pictures of the scene may still be in work
            with naming_errors(f"scenes[{s}]", ""):
                now = scene.versions()
                check_unchanged(versions.setdefault(scene, now), now, "while the batch has it")
        if param_sets is not None and s >= len(param_sets):
            raise SceneError("params", len(param_sets), "as many as there are scenes")
        for c, (camera_name, camera) in enumerate(cameras.of_scene(s)):
            name = ("" if param_sets is None else f"params[{s}]") if shares_scene else f"scenes[{s}]"
            with naming_errors(name, camera_name):
                params = {} if param_sets is None else param_sets[s]
                request = _request_by(scene, camera, params, spp(s, c), seeds(s, c), options, full=full)
                film = request.settings.film
                _, _, *size = film.window
                film_facts = {"width": size} | ({"aovs": list(film.aovs), "denoise": film.denoise} if full else {})
                first_facts = first_facts or film_facts
                for key, value in film_facts.items():
                    if value != first_facts[key]:
                        raise SceneError(f"film.{key}", value, f"{first_facts[key]}, as of the first picture")
            yield Picture(s, c, name, request)


def _request_by(
    scene: Scene,
    camera: Mapping[str, Any] | Tensor | None,
    params: Params,
    spp: Any,
    seed: Any,
    options: BatchOptions,
    *,
    full: bool,
) -> RenderRequest:
    """Return the request for one picture."""
    if isinstance(camera, Tensor):
        if "camera.to_world" in params:
            raise SceneError("params.camera.to_world", "a pose", "none where cameras are poses")
        params = {**params, "camera.to_world": camera}
    elif camera is not None:
        scene = scene.seen_by(camera, options.get("film"))
    if under_transforms():  # their tensors are checked where they are plain
        return prepare_request(scene, full, params=params, spp=spp, seed=seed, **options).with_versions()
    return request_of(scene, full, params=params, spp=spp, seed=seed, **options)


def request_of(scene: Scene, full: bool, **options: Unpack[CommonOptions]) -> RenderRequest:
    """Return the request of a picture for :func:`render_pictures`; arguments as of :func:`torchpt.render`.

    Raises:
        SceneError: an argument is not accepted.
    """
    request = prepare_request(scene, full=full, **options)
    if any(map(is_transformed, request.params.values())):
        raise SceneError("params", "tensors under a transform of torch.func", "plain ones: items have no gradients")
    request.scene.check(request.params)
    return request.with_versions()


def render_pictures(
    pictures: Iterable[Picture],
    tasks_of: Callable[[Picture], int],
    on_done: Callable[[Picture, RenderRequest | None, Rendering], None],
) -> None:
    """Render pictures side by side, each without gradients.

    Args:
        pictures: the pictures; an iterator may prepare each while others are rendered.
        tasks_of: returns the number of tasks that a picture is cut into, at most.
        on_done: called with each picture as it ends, its request if it needs gradients (which :func:`execute_request` adds to
            the rendering), and the rendering.

    Raises:
        RenderError: a scene was changed while its pictures were rendered; others as :func:`torchpt.render`.
    """
    latest: list[tuple[int, Wave]] = []  # number and wave of the latest scene

    def queued_render(picture: Picture) -> QueuedRender:
        request = picture.request
        needs_gradients = request.needs_gradients  # read before gradients are disabled

        def make(threads: int) -> Run:
            same_scene = next((wave for scene, wave in latest if scene == picture.scene), None)
            plain = {name: value.detach() for name, value in request.params.items()}
            call = request.call
            run = Run(
                request.scene, request.settings, plain, call.dtype, group=call.ranks, like=same_scene, threads=threads
            )
            latest[:] = [(picture.scene, run.wave)]
            return run

        def finish(rendering: Rendering) -> None:
            request.check_unchanged("while the batch has it")
            # A request keeps its scene alive, and there may be many.
            if needs_gradients:
                on_done(picture, request, rendering)
            else:
                on_done(picture, None, execute_request(request, [rendering]))

        def on_error(error: BaseException) -> None:
            with naming_errors(picture.name, ""):
                raise error

        return QueuedRender(request.scene.device, make, finish, on_error, tasks_of(picture))

    render_many(map(queued_render, pictures))


def _check_memory(request: RenderRequest, total: int | None) -> None:
    """Raise if the pictures of a batch alone need more than ``render.max_memory``."""
    limit, film = request.settings.render.max_memory, request.settings.film
    _, _, width, height = film.window
    bytes_each = torch.finfo(request.call.dtype).bits // 8
    picture_bytes = 2 * 3 * width * height * bytes_each * (total or 1)  # single pictures, and the stacked ones
    if limit is not None:
        check_limit(limit, picture_bytes, f"more than the {mb(picture_bytes)} that the pictures alone take")
