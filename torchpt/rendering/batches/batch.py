"""Many pictures by one call: scenes by cameras, on one work list. Each is to the bit the one that ``render`` makes alone."""

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
    """The pictures of a batch of S scenes and C cameras; ``renderings[s, c]`` is one of them with all its facts.

    Attributes:
        image: ``(S, C, H, W, 3)`` linear RGB; it carries gradients, where they are wanted.
        layers: what ``film.aovs`` asked for, by name, each ``(S, C, H, W, channels)``.
        denoised: the pictures without their noise ``(S, C, H, W, 3)``; None without ``film.denoise``.
        rows: the pictures one by one, those of a scene together. Times in them overlap.
    """

    image: Tensor
    layers: dict[str, Tensor]
    denoised: Tensor | None
    rows: tuple[tuple[Rendering, ...], ...]

    def __getitem__(self, which: tuple[int, int]) -> Rendering:
        """The picture of scene ``s`` by camera ``c``."""
        if not isinstance(which, tuple) or len(which) != 2:
            raise TypeError(f"expected renderings[s, c], a scene's number and a camera's, got renderings[{which!r}]")
        s, c = which
        return self.rows[s][c]

    def __repr__(self) -> str:
        return f"Renderings({' x '.join(map(str, self.image.shape))}; layers: {', '.join(self.layers) or 'none'})"


@dataclass(frozen=True)
class _Picture:
    """One picture of a batch: where it belongs, its name in errors, what is asked for."""

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
    list of work over all pictures, and what is next is made ready while they trace. Worlds, search structures and kernels are
    made once for all cameras of a scene. Pictures by tensor operations (as on CUDA) are rendered one after another; so are all
    that a time or an error ends, in bounded memory, or by several ``ranks`` (which share each picture's pixels).

    Args:
        scenes: from :func:`torchpt.load`: a sequence, or an iterator that loads them (while others are rendered), of any kinds,
            all with films of one size; or one scene, of which ``params`` make S.
        cameras: shared by all scenes: a sequence of blocks ``camera`` as in scene files (with ``K``, ``R``, ``t`` too), of
            poses ``camera.to_world (4, 4)`` for the scenes' own cameras, or a tensor of such ``(C, 4, 4)``; None: C is 1, each
            scene's own.
        params: tensors in place of the scenes', by dotted name: a mapping to tensors with a leading dimension S, or a sequence
            of S mappings.
        seed: one for all pictures (by default the scenes' own), or a sequence of S of them or of S sequences of C.
        on_progress: called after each picture with how many are done, and of how many (None: scenes came from an iterator).
        full: True returns a :class:`Renderings`: pictures, layers, and each picture's own facts.
        options: all other arguments of :func:`torchpt.render`, the same for all pictures. ``checkpoint`` is not taken;
            ``max_memory`` holds for the batch, the pictures included.

    Raises:
        SceneError: what is not accepted, by a key that begins with the scene's or camera's place, such as ``scenes[3].``.
        RenderError: as :func:`torchpt.render`.
        TypeError: an argument that ``render`` does not know.
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
    # Gradients last: what is on a tape is made of pictures that are there.
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
    """A rendering on the tape that its parameters are on; without an order there is none."""
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
    """Return the orders, picture by picture, those of a scene together; ``several``: scenes are one under other parameters."""
    like: dict[str, Any] = {}
    versions: WeakKeyDictionary[Scene, dict[str, int]] = WeakKeyDictionary()
    for s, each in enumerate(scenes):
        scene = as_scene(each, f"scenes[{s}]")
        if not several:  # whether its pictures are rendered by now, nobody can tell
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
    """Return the order of one picture."""
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
    """Renders of pictures; what they come to is put into ``found``."""
    latest: list[tuple[int, Wave]] = []  # of the scene that is being rendered

    def entry(picture: _Picture) -> QueuedRender:
        request, place = picture.request, (picture.scene, picture.camera)
        needs_gradients = request.needs_gradients  # before gradients are off

        def make(threads: int) -> Run:
            like = next((wave for scene, wave in latest if scene == picture.scene), None)
            plain = {name: value.detach() for name, value in request.params.items()}
            run = Run(request.scene, request.settings, plain, request.call.dtype, request.call.ranks, like, threads)
            latest[:] = [(picture.scene, run.wave)]
            return run

        def done(rendering: Rendering) -> None:
            request.check_unchanged("while the batch has it")
            # An order holds its scene, of which there may be many.
            found[place] = (request, rendering) if needs_gradients else (None, execute_request(request, [rendering]))
            if on_progress is not None:
                on_progress(len(found), total)

        def failed(error: BaseException) -> None:
            with named(picture.name, None):
                raise error

        return QueuedRender(request.scene.device, make, done, failed)

    return map(entry, pictures)


def _check_memory(request: RenderRequest, total: int | None) -> None:
    """Refuse a bound that the pictures of a batch alone would break."""
    limit, film = request.settings.render.max_memory, request.settings.film
    _, _, width, height = film.crop or (0, 0, film.width, film.height)
    bytes_each = torch.finfo(request.call.dtype).bits // 8
    held = 2 * 3 * width * height * bytes_each * (total or 1)  # one by one, and then together
    if limit is not None:
        check_limit(limit, held, f"more than the {mb(held)} that the pictures alone take")
