"""A loaded scene: its parameters as tensors, and a cache of the worlds and search structures built from them.

A *world* holds the tensors that stages read, in *the coordinates of lanes*: about the scene's centre and in another unit, so
that float32 suffices (:mod:`torchpt.scene.space`). A *spec* declares range, unit and effect of a parameter. The *build* is what
loading made of the scene file; it never changes. Each parameter has a *version*, a number that changes when its tensor does, by
which the caches find out what is stale.
"""

from __future__ import annotations

import copy
import itertools
import math
import threading
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import torch
from torch import Tensor

from torchpt import search
from torchpt.core.autograd import outside_transforms
from torchpt.core.errors import SceneError, example_names
from torchpt.core.memory import MemoryMeter, mb, retry_out_of_memory, trim_heap
from torchpt.core.memory_block import MemoryBlock, with_own_memory
from torchpt.core.threads import ReadAhead, outside_inference_mode, thread_count, warm_up
from torchpt.core.tree import moved
from torchpt.images import PackedImages
from torchpt.physics.bsdfs import Bsdf
from torchpt.physics.cameras import Camera
from torchpt.physics.cameras.opencv import PinholeMatrices, extrinsics
from torchpt.physics.shapes.geometry import Geometry
from torchpt.physics.world import World
from torchpt.scene.build import SceneBuild, build_parts
from torchpt.scene.devices import device_of
from torchpt.scene.formats.description import Description, settings
from torchpt.scene.host_copies import HostCopies
from torchpt.scene.info import describe
from torchpt.scene.settings import Film, FilmSettings, Params, Settings
from torchpt.scene.sizes import sized_shapes, unchanged_sizes, with_poses
from torchpt.scene.sources import check_light_params
from torchpt.scene.space import MAX_COORDINATE, Space, bounds_center, bounds_extent
from torchpt.scene.validation import check_tensor, inherited_checks, params_as_tensors, validate_changes
from torchpt.scene.versions import VersionCounter, changed_versions
from torchpt.scene.view import view_attributes
from torchpt.scene.world import assemble
from torchpt.scene.world.pieces import KeptPieces, ParameterReads
from torchpt.search import Accel
from torchpt.spec import Moves, Pose, Refused, Spec, parameters_of

__all__ = ["Scene", "live_scenes", "scene_by_number"]

#: Attributes that copies take over; all others are rebuilt on demand.
_COPIED_ATTRIBUTES = ("description", "device", "own_models", "_tensors", "load_seconds", "peak", "_built")

_numbers = itertools.count(1)
#: All live scenes by number.
_scenes: WeakValueDictionary[int, Scene] = WeakValueDictionary()


def scene_by_number(number: int) -> Scene | None:
    """Return the scene with a number; None once it is gone."""
    return _scenes.get(number)


def live_scenes() -> list[Scene]:
    """Return all live scenes."""
    return list(_scenes.values())


def _leaf(value: Tensor) -> Tensor:
    """Return a leaf tensor: a parameter that is a result of autograd is detached, with gradients of its own."""
    return value if value.is_leaf else value.detach().requires_grad_()


class Scene:
    """A scene on one device.

    Attributes:
        description: the validated scene file.
        device: device of the parameters.
        own_models: BSDFs of the caller.
        params: every tensor by dotted name.
        load_seconds: seconds of loading, files included; 0 where it was not measured.
    """

    def __init__(
        self,
        description: Description,
        device: torch.device,
        own_models: tuple[Bsdf, ...] = (),
        vertex_params: Collection[str] = (),
    ) -> None:
        warm_up()
        meter = MemoryMeter(device)
        meter.base()  # the memory from which peaks are counted, now that all modules are imported
        before = meter.peak()
        self.load_seconds = 0.0
        self.description, self.device, self.own_models = description, device, own_models
        self._built: SceneBuild = retry_out_of_memory(
            "the files and shapes of the scene", lambda: build_parts(description, vertex_params)
        )
        # A centre other than 0 means that the scene lies far from its origin. Then positions stay in float64: float32 would
        # lose detail before they are moved to the origin.
        far = bool(self._built.centre.any())
        self._tensors: dict[str, Tensor] = {}
        parameters = self._built.parameters
        # Texels may be large: they are kept once, where a world reads them.
        block = MemoryBlock(sum(value.size for value in parameters.values() if value.dtype == np.float32))
        images, parameters.images = parameters.images, {}
        unread = {name for name, image in images.items() if device.type == "cpu" and not image.needs_floats}
        for name, value in parameters.items():
            positions = far and self.spec(name).holds_positions
            if value.dtype == np.float32:
                values = images[name].values() if name in images and name not in unread else value
                tensor = block.reserve(value.shape) if name in unread else block.add(values)
                parameters[name] = tensor.numpy()
            else:
                with np.errstate(over="ignore"):  # infinite in float32: the check of the world says so
                    tensor = torch.from_numpy(value.astype(np.float64 if positions else np.float32, order="C"))
            self._tensors[name] = tensor.to(device)
        packed = {name: image for name, image in images.items() if unread and image.is_read_packed}
        self._packed = PackedImages(packed, {name: self._tensors[name] for name in unread})
        del images, packed
        trim_heap()  # of files as they were read
        after = meter.peak()
        #: Peak bytes while the scene was read, above those after import; 0 where unknown, and where no new peak was reached.
        self.peak = after - meter.base() if after > before else 0
        self._reset_caches()
        self._checked_versions = self.versions()  # the reader has checked these values

    def _reset_caches(self) -> None:
        """Reset all caches."""
        self._host_space = Space(torch.from_numpy(self._built.centre), self._built.unit)
        self._space = moved(self._host_space, self.device)
        self._host_copies = HostCopies()
        self._sized_shapes = sized_shapes(self.description, self._tensors)
        self._size_names = frozenset(name for shape in self._sized_shapes for name in shape.names)
        self._unchanged_sizes = unchanged_sizes(self._sized_shapes, self._tensors)
        self._lock = threading.RLock()
        # By dtype, whether texture coordinates were asked for, light sampler, and whether lights are sampled alone.
        self._worlds: dict[tuple[torch.dtype, bool, str, bool], tuple[World, Geometry]] = {}
        self._pieces = KeptPieces()  # of the latest worlds
        # By kind of search and number of threads: those of the scene's own parameters, and the latest of any parameters, to
        # refit or to reuse its topology.
        self._accels: dict[tuple[str, int | None], Accel] = {}
        self._latest_accels: dict[tuple[str, int | None], Accel] = {}
        # Versions of the parameters that the caches were built from, by a counter of their own; views of the scene share both.
        self._cache_counter, self._cached_versions = VersionCounter(), dict[str, int]()
        self._origin: Scene | None = None
        self._assign_number()

    def _assign_number(self) -> None:
        """Take a new number and forget which versions were checked."""
        # Scenes with textures in place of numbers, by names and sizes of the texels; :mod:`torchpt.scene.texel_params` has
        # them.
        self.textured: dict[Any, Scene] = {}
        self._version_counter = VersionCounter()
        self._checked_versions: dict[str, int] = {}
        #: Unique in this process; compiled graphs refer to the scene by it.
        self.number = next(_numbers)
        _scenes[self.number] = self

    @property
    def params(self) -> dict[str, Tensor]:
        """Return every tensor by dotted name (``materials.*``, ``shapes.*``, ``lights.*``, ``camera.*``).

        Colours are ``(3,)``, vertices ``(V, 3)`` in the mesh's own space, poses ``(4, 4)``. Changes in place take effect at the
        next render, which checks them like a scene file; to differentiate, pass replacements to ``torchpt.render(scene,
        params=...)``. Images of 8 bits a value are decoded when this is first asked for.
        """
        if self._packed.pending:
            # torch.compile leaves it to Python.
            unpack: Any = torch.compiler.disable(self._unpack) if torch.compiler.is_compiling() else self._unpack
            unpack()
        return self._tensors

    @params.setter
    def params(self, params: dict[str, Tensor]) -> None:
        _ = self.params  # no tensor waits for its numbers any more
        self._tensors = params

    def _unpack(self) -> None:
        with self._lock:  # after a world that is being made of packed images
            if self._packed.unpack():
                self._pieces.clear()  # those of packed images

    def replace_params(self, params: Mapping[str, Tensor]) -> None:
        """Take tensors in place of parameters, which are those of :attr:`params` from now on."""
        known = self._tensors if self._packed.found().keys().isdisjoint(params) else self.params
        known.update(params)

    @property
    def raw_params(self) -> Mapping[str, Tensor]:
        """Return :attr:`params` for names, shapes and versions: where images are not decoded yet, numbers are arbitrary."""
        return self._tensors

    def readable_params(self, params: Mapping[str, Tensor] | None = None) -> Mapping[str, Tensor]:
        """Return :meth:`merged`; images that are not decoded yet are so where they are looked up, and stay as they are."""
        return ParameterReads(self.merged(params), packed=self._packed.found())

    @property
    def origin(self) -> Scene:
        """Return the scene that this is a view of (:meth:`seen_by`), else itself; caches belong to it."""
        return self if self._origin is None else self._origin

    def seen_by(self, camera: Mapping[str, Any], film: FilmSettings | None = None) -> Scene:
        """Return a view of this scene through another camera. It shares all other parameters, worlds and search structures.

        Args:
            camera: camera block, as in a scene file.
            film: film settings that override the scene's, or ``(width, height)``. A ``K`` without ``size`` is in pixels of the
                film.

        Raises:
            SceneError: a wrong camera block or film.
        """
        view = object.__new__(type(self))
        with outside_inference_mode():
            view_state = view_attributes(
                self.description, self._built, self._tensors, camera, {} if film is None else film
            )
        view.__dict__.update(self.__dict__ | view_state)  # the caches are shared, not copied
        view._origin = self.origin
        view._assign_number()
        view.mark_checked(self)
        return view

    def to(self, device: str | torch.device) -> Scene:
        """Return the scene on a device, or ``auto``: itself where it is on that device, else a copy.

        As with tensors, gradients flow from the copy's parameters to the originals; BSDFs of the caller are copied.

        Raises:
            RenderError: the device is not available.
        """
        chosen = device_of(device)
        if chosen.type == self.device.type and chosen.index in (None, self.device.index or 0):
            return self
        return self._copied(chosen, {name: value.to(chosen) for name, value in self.params.items()}, memo={})

    def __copy__(self) -> Scene:
        """Return another scene of the same tensors."""
        return self._copied(self.device, dict(self.params), memo=None)

    def __deepcopy__(self, memo: dict[int, Any]) -> Scene:
        """Return another scene of copied tensors and BSDFs; the immutable build is shared."""
        params = {name: copy.deepcopy(_leaf(value), memo) for name, value in self.params.items()}
        return self._copied(self.device, params, memo)

    def _copied(self, device: torch.device, params: dict[str, Tensor], memo: dict[int, Any] | None) -> Scene:
        """Return another scene of other parameters; with a ``memo`` of ``copy.deepcopy`` the caller's BSDFs are copied too."""
        made = object.__new__(type(self))
        state = self.__dict__ | {"device": device, "_tensors": params, "peak": 0}
        if memo is not None and self.own_models:
            state |= copy.deepcopy({name: state[name] for name in ("description", "_built", "own_models")}, memo)
            # `held` returns the torch modules of a BSDF.
            for module in (module for model in state["own_models"] for module in model.held()):
                module.to(device)
        made.__setstate__({name: state[name] for name in _COPIED_ATTRIBUTES})
        return made

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle; unpickling reads no files."""
        state = {name: getattr(self, name) for name in _COPIED_ATTRIBUTES}
        return state | {"_tensors": {name: with_own_memory(_leaf(value)) for name, value in self.params.items()}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        warm_up()
        self.__dict__.update(state)
        self._packed = PackedImages({}, {})
        self._reset_caches()

    def weights(self) -> tuple[Tensor, ...]:
        """Return the tensors of the caller's BSDFs that require gradients."""
        found = {id(weight): weight for model in self.own_models for weight in model.weights() if weight.requires_grad}
        return tuple(found.values())

    @property
    def name(self) -> str:
        """Return the name of its file without folder and ending; "" for a mapping."""
        return Path(self.description.file or "").stem

    def __repr__(self) -> str:
        """Return the name or file, the size of the film, and what the scene has."""
        width, height = self.film_size()
        parts, copies = self._built.parts, self._built.copies
        shapes = len({part.name for part in parts}) + len(copies)
        primitives = sum(part.primitive_count for part in parts)
        return (
            f"Scene({self.name or 'of a mapping'}: {width} x {height}, {shapes} shapes, {primitives} primitives, "
            f"{len(self._tensors)} parameters, {self.device})"
        )

    @property
    def size_phrase(self) -> str:
        """Return a phrase about the scene's size, for errors."""
        triangles = sum(len(value) for name, value in self._tensors.items() if name.endswith(".vertices"))
        held = sum(value.numel() * value.element_size() for value in self._tensors.values())
        return f"{len(self._built.parts)} parts with {triangles} vertices, whose parameters alone take {mb(held)}"

    def drop_pieces(self) -> None:
        """Drop the pieces that are kept for the next world."""
        self._pieces.clear()

    def replace_build(self, built: SceneBuild) -> None:
        """Replace the build of a new copy by one with other materials, before anything is cached."""
        self._built = built

    @property
    def built(self) -> SceneBuild:
        """Return the parts, instances and lights built from the description; immutable."""
        return self._built

    @property
    def space(self) -> Space:
        """Return the transform to the coordinates of lanes."""
        return self._space

    @property
    def numbers(self) -> int:
        """Return how many numbers its parameters have as they were loaded."""
        return self._built.numbers

    def center(self) -> np.ndarray:
        """Return the centre ``(3,)`` of the bounding box of all surfaces, float64; the origin where there are none."""
        return bounds_center(self._built.parts, self._built.copies)

    @property
    def length(self) -> float:
        """Return the longest side of the bounding box of all surfaces in scene units, rounded to a power of two."""
        extent = bounds_extent(self._built.parts, self._built.copies)
        return 2.0 ** round(math.log2(max(extent, 2.0**-100)))  # a single point has a logarithm too

    def check(self, params: Mapping[str, Any] | None) -> None:
        """Check parameters that are to replace the scene's in a render.

        Raises:
            SceneError: an unknown name, a tensor of another shape, numbers that a scene file could not hold.
        """
        if params is not None and not isinstance(params, Mapping):
            raise SceneError("params", params, "a mapping from names of scene.params to tensors")
        for name, value in (params or {}).items():
            if name not in self._tensors:
                examples = example_names(str(name), list(self._tensors))
                raise SceneError(f"params.{name}", name, f"a parameter of this scene such as {examples}")
            check_tensor(name, value, self._tensors[name].shape, texels=self.spec(name).texture)
            self.check_number(name, value.detach())
        merged = self.merged(params)
        check_light_params(self._built.sources, params or {}, merged)
        self.check_sizes(params or {}, merged)

    def check_own(self) -> None:
        """Check the tensors of :attr:`params` that were replaced or changed in place since the last check.

        Raises:
            SceneError: as :meth:`check`, or names that were removed or added.
        """
        with outside_transforms():
            validate_changes(self, self._checked_versions)

    def mark_checked(self, other: Scene) -> None:
        """Mark as checked the tensors that are shared with another scene and checked there."""
        self._checked_versions = inherited_checks(self, other, other._checked_versions)

    def versions(self) -> dict[str, int]:
        """Return version numbers of :attr:`params` by name; see :class:`torchpt.scene.versions.VersionCounter`."""
        return self._version_counter.of(self._tensors)

    def merged(self, params: Mapping[str, Tensor] | None) -> dict[str, Tensor]:
        """Return all parameters, with those of ``params`` (checked before) in place of the scene's.

        Poses of shapes whose sizes have changed (:mod:`torchpt.scene.sizes`) are those of their primitives. Images are those of
        :attr:`raw_params`; :meth:`readable_params` has their numbers.
        """
        merged = {**self._tensors, **{name: value.to(self.device) for name, value in (params or {}).items()}}
        # Autograd refuses tensors of torch.inference_mode, but not their clones.
        merged = {name: value.clone() if value.is_inference() else value for name, value in merged.items()}
        return with_poses(merged, self._sized_shapes, self._unchanged_sizes)

    def spec(self, name: str) -> Spec:
        """Return the spec of a parameter."""
        return self._built.parameters.specs[name]

    def check_number(self, name: str, value: Tensor) -> None:
        """Check the values of a parameter.

        Raises:
            SceneError: numbers that a scene file could not hold.
        """
        spec = self.spec(name)
        try:
            spec.check(value)
        except Refused as error:
            shown = value.tolist() if error.value is ... else error.value  # ...: the whole value is wrong
            raise SceneError(f"params.{name}", shown, error.expected) from None
        if isinstance(spec, Pose) and spec.moves is Moves.SURFACES:
            # The position of the shape: the translation of its pose.
            reach, position = MAX_COORDINATE * self._space.unit, value.double().cpu().numpy()[:3, 3]
            if not np.abs(position - self._built.centre).max() <= reach:  # True for NaN too
                expected = f"a place up to {reach:.3g} from the middle of this scene as it was loaded"
                raise SceneError(f"params.{name}", position.tolist(), expected)

    def check_sizes(self, names: Collection[str], merged: Mapping[str, Tensor]) -> None:
        """Check the poses of shapes of which sizes are among ``names``; ``merged``: all parameters (:meth:`merged`).

        Raises:
            SceneError: sizes that a scene file could not hold, or with which a shape has no pose.
        """
        if self._size_names.isdisjoint(names):
            return
        for shape in self._sized_shapes:
            given = [name for name in shape.names if name in names]
            changed = next((name for name in given if not shape.is_loaded(name, merged[name])), None)
            if changed is None:
                continue
            try:
                shape.kind.check(shape.values(merged), frozenset())
            except Refused as error:
                raise SceneError(
                    ".".join(("params", shape.stem, *map(str, error.at))), error.value, error.expected
                ) from None
            try:
                self.check_number(shape.pose_name, merged[shape.pose_name].detach())
            except SceneError as error:
                expected = f"sizes with which its pose is {error.expected}"
                raise SceneError(f"params.{changed}", merged[changed].tolist(), expected) from None

    def world(
        self,
        dtype: torch.dtype,
        params: Mapping[str, Tensor] | None = None,
        uv: bool = False,
        choice: str = "auto",
        alone: bool = False,
        accel: tuple[str, int | None] | None = None,
    ) -> tuple[World, Geometry]:
        """Return the world and the geometry for the search; cached for the scene's own parameters.

        Args:
            dtype: dtype of the lanes.
            params: checked tensors in place of the scene's.
            uv: True for texture coordinates even where no texture reads them.
            choice: the light sampler, from ``lights.LIGHT_SAMPLERS``.
            alone: True where lights are sampled alone, not combined with BSDF sampling by MIS.
            accel: arguments of :meth:`accel`, for a search structure that is built beside the scene's own world.
        """
        if params:
            return self._assemble(self.merged(params), dtype, uv=uv, choice=choice, alone=alone)
        with self._lock:
            self._refresh()
            key = dtype, uv, choice, alone
            if key not in self._worlds:
                with outside_inference_mode(), torch.no_grad(), ReadAhead(thread_count(None)) as beside:
                    begun: list[Callable[[], Accel]] = []

                    def begin(geometry: Geometry) -> None:
                        if accel is not None and accel not in self._accels and dtype == torch.float32:
                            begun.append(beside.add(partial(self._build_accel, accel, geometry)))

                    merged = self.merged(None)
                    self._worlds[key] = self._assemble(
                        merged, dtype, uv=uv, choice=choice, alone=alone, on_geometry=begin
                    )
                    for built in begun:
                        assert accel is not None
                        self._accels[accel] = built()
                trim_heap()  # of large meshes and textures, temporaries are as much as what is kept
            return self._worlds[key]

    def _own_geometry(self) -> Geometry:
        """Return the float32 geometry of the scene's own parameters; any world has it, whatever its lights."""
        made = (geometry for (dtype, *_), (_, geometry) in self._worlds.items() if dtype == torch.float32)
        found = next(made, None)
        return self.world(torch.float32)[1] if found is None else found

    def accel(self, kind: str, threads: int | None, geometry: Geometry | None = None) -> Accel:
        """Return a search structure: a new one for ``geometry``, else the cached one of the scene's own.

        A new one is made by refitting the latest where that is good enough (:meth:`Accel.refit`), since in an optimization
        vertices move from render to render. The latest itself is not changed.

        Args:
            kind: value of ``render.accel``.
            threads: threads of the search; None: torch's number.
            geometry: geometry of other parameters; None: that of the scene's own.
        """
        key = kind, threads
        with self._lock:
            if geometry is None:
                self._refresh()
                if key not in self._accels:
                    self._accels[key] = self._build_accel(key, self._own_geometry())
                return self._accels[key]
        return self._build_accel(key, geometry)

    def _build_accel(self, key: tuple[str, int | None], geometry: Geometry) -> Accel:
        """Build a search structure from the latest of the same kind and threads (``key``)."""
        made = search.build(geometry, *key, before=self._latest_accels.get(key))
        if made.refits:  # a kind that later ones can be refitted from
            self._latest_accels[key] = made
        trim_heap()
        return made

    def camera(self, film: Film, params: Mapping[str, Tensor], dtype: torch.dtype) -> Camera:
        """Return the camera on a film, in the coordinates of lanes. It is computed on the host, see :meth:`_assemble`."""
        camera, values = self.description.camera, dict(self.description.camera.values)
        params = {name: value for name, value in params.items() if name.startswith("camera.")}
        params = self._host_copies.of(params, self._tensors)
        for key, spec in parameters_of(camera.kind).items():
            value = params.get(f"camera.{key}")
            if spec.differentiable and value is not None:
                values[key] = (value.double() / self._space.unit if spec.length else value).to(dtype)
        pose = params["camera.to_world"]
        pose = torch.cat((self._host_space.pose(pose), pose[3:].double())).to(dtype)  # (3, 4), and the last row 0 0 0 1
        return moved(camera.kind.on(pose, (film.width, film.height), values), self.device)

    def faces(self, name: str) -> Tensor:
        """Return the triangles of a mesh: ``(F, 3)`` int64 indices of its vertices, on the scene's device.

        Vertices that a file splits, such as at seams of texture coordinates, are different ones.

        Args:
            name: its parameter ``shapes.NAME.vertices``, or ``shapes.NAME``.

        Raises:
            SceneError: no mesh of this scene.
        """
        meshes = {part.name: part.faces for part in self._built.parts if part.faces is not None}
        faces = meshes.get(str(name).removesuffix(".vertices"))
        if faces is None:
            found = (
                f"one of {', '.join([*meshes][:8])}{', ...' if len(meshes) > 8 else ''}"
                if meshes
                else "a mesh (there is none)"
            )
            raise SceneError("name", name, found)
        return torch.from_numpy(faces).to(self.device, torch.int64)

    def film_size(self, film: FilmSettings | None = None) -> tuple[int, int]:
        """Return width and height of the whole film in pixels; ``film``: settings that override the scene's."""
        film_settings = settings(self.description, {"film": film or {}}).film
        return film_settings.width, film_settings.height

    def pinhole(
        self,
        params: Params | None = None,
        film: FilmSettings | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> PinholeMatrices:
        """Return the camera as OpenCV's matrices ``K`` in pixels, ``R`` and ``t``; see :mod:`torchpt.physics.cameras.opencv`.

        Args:
            params: values in place of the scene's, by name, as :func:`torchpt.render` takes them; gradients flow to the
                camera's.
            film: film settings that override the scene's, e.g. ``(640, 480)``; a crop has no effect.
            dtype: dtype of the matrices.

        Raises:
            SceneError: wrong parameters or film settings, or a camera other than a pinhole.
        """
        if isinstance(params, Mapping):
            params = params_as_tensors(self, params)
        self.check(params)
        merged, film_settings = self.merged(params), settings(self.description, {"film": film or {}}).film
        matrix = self.camera(film_settings, merged, torch.float64).intrinsics()
        if matrix is None:
            raise SceneError(
                "camera.type", self.description.camera.name, "a camera with an angle of view", self.description.file
            )
        rotation, translation = extrinsics(merged["camera.to_world"].double())
        return PinholeMatrices(matrix.to(dtype), rotation.to(dtype), translation.to(dtype))

    def info(self, settings: Settings) -> dict[str, Any]:
        """Return what ``torchpt info`` prints about the scene, as nested dicts; see :mod:`torchpt.scene.info`."""
        world, _ = self.world(torch.float32, choice=settings.light_choice)
        threads = None if settings.render.threads == "auto" else int(settings.render.threads)
        return describe(self.description, self._built, world, self.accel(settings.render.accel, threads), settings)

    def _assemble(
        self,
        params: Mapping[str, Tensor],
        dtype: torch.dtype,
        *,
        uv: bool,
        choice: str,
        alone: bool,
        on_geometry: Callable[[Geometry], None] | None = None,
    ) -> tuple[World, Geometry]:
        """Assemble the world on the host, and copy it to the device; ``on_geometry`` gets the host's geometry before the rest.

        torch's operators round differently on a GPU, and a ray that then takes another way changes the picture. Tensors that
        are a parameter as it is, such as texels, are not copied.
        """
        packed = self._packed.found()
        if any(params[name] is not self._tensors.get(name) for name in packed):
            packed = {}
            _ = self.params  # all images by their numbers
        host = self._host_copies.of(params, self._tensors)
        own = frozenset(name for name, value in params.items() if self._tensors.get(name) is value)
        reads = ParameterReads(host, self._pieces, own, variant=(dtype, uv), packed=packed)
        built, space = self._built, self._host_space
        made = assemble(
            built.parts,
            reads,
            built.sources,
            space,
            dtype,
            built.copies,
            uv=uv,
            choice=choice,
            alone=alone,
            own_models=self.own_models,
            on_geometry=on_geometry if self.device.type == "cpu" else None,
        )
        if self.device.type == "cpu":
            return made
        return moved(made, self.device, {id(host[name]): value for name, value in params.items()})

    def _refresh(self) -> None:
        """Clear the caches where a parameter other than the camera's was replaced or changed in place."""
        now, before = self._cache_counter.of(self._tensors), self._cached_versions.copy()
        changed = changed_versions(before, now)
        gone = any(name not in now and not name.startswith("camera.") for name in before)
        if not changed and not gone:
            return
        for name in changed:
            if self.spec(name).holds_positions and name in before:  # moved: it may lie out of reach now
                self.check_number(name, self._tensors[name].detach())
        self._cached_versions.clear()
        self._cached_versions.update(now)
        if not gone and all(name.startswith("camera.") for name in changed):  # nothing in the caches depends on it
            return
        self._worlds.clear()
        self._accels.clear()
