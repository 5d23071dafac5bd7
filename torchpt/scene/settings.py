"""Settings of a render (film, integrator, sampler, render): built-in default < scene file < override.

:func:`merge` makes :class:`Settings` of these three. A setting is declared by a *spec* (:mod:`torchpt.spec`), which has
default, range and text of the docs. Blocks that name a type (``integrator``, ``sampler``, ``film.filter``) have the parameters
of that type; the blocks ``film`` and ``render`` are records here. A *role* says whether samples depend on a setting
(``Role.FREE``: none does), whether it may end a render (``Role.ENDS``), and whether it names files to write (``Role.FILES``).
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, TypedDict

import numpy as np
import torch
from torch import Tensor

from torchpt.core.autograd import is_transformed, outside_transforms
from torchpt.core.errors import SceneError
from torchpt.math.guiding import EdgeGuide
from torchpt.paths.integrators import KINDS as INTEGRATORS
from torchpt.paths.integrators.base import Integrator
from torchpt.paths.layers import LAYERS
from torchpt.physics.film import FILTERS
from torchpt.physics.samplers import KINDS as SAMPLERS
from torchpt.ranks import Group
from torchpt.spec import Choice, Custom, Flag, FrozenConfig, Integer, Refused, Role, Scalar, parameters_of, reading
from torchpt.spec.arguments import SCENE_VALUE, Argument, InPython, SceneValue, arguments_of
from torchpt.spec.schema import (
    ParsedParams,
    ResultCache,
    check_keys,
    dotted,
    read_params,
    read_typed,
    refuse_unused_keys,
    scene_error,
)

__all__ = [
    "BLOCKS",
    "FILTERS",
    "INTEGRATORS",
    "SAMPLERS",
    "TYPED_BLOCKS",
    "UNTYPED_BLOCKS",
    "BatchOptions",
    "CallArguments",
    "CommonOptions",
    "Film",
    "FilmSettings",
    "Params",
    "Render",
    "RenderOptions",
    "RendererOptions",
    "SeedOfCall",
    "Settings",
    "TraceOptions",
    "base_seed",
    "film_keys",
    "keep_aspect",
    "merge",
    "seed_number",
    "settings_of_call",
    "settings_with",
    "with_plain_numbers",
]

#: The blocks of settings.
BLOCKS = ("film", "integrator", "sampler", "render")
#: Most pixels along a side of the film, and on all of it: 2^28 pixels take some GiB of sums, beyond what a film is used for.
MAX_SIDE = 65_536
MAX_PIXELS = 2**28
#: With the AOV ``variance``, samples are split over four randomizations from this many samples a pixel on, below over two.
#: More randomizations make Sobol' points less effective (Cornell box, 64 spp: relMSE 0.38, 0.50, 0.58 of independent sampling
#: for one, two, four), but a pixel's variance less noisy.
MANY_SAMPLES = 256
#: The largest `render.seed`: seeds are int64.
MAX_SEED = 2**63 - 1


#: Blocks with a type: the table of kinds, and the default type.
TYPED_BLOCKS: dict[str, tuple[Mapping[str, Any], str]] = {
    "integrator": (INTEGRATORS, "path"),
    "sampler": (SAMPLERS, "sobol"),
    "filter": (FILTERS, "gaussian"),
}


# Readers of single settings: each returns the value in its final form, or raises Refused with what is accepted.


def _crop(value: Any) -> tuple[int, int, int, int]:
    if not isinstance(value, list | tuple) or len(value) != 4 or not all(type(number) is int for number in value):
        raise Refused("[x, y, width, height], whole numbers of pixels")
    x, y, width, height = value
    if x < 0 or y < 0 or width < 1 or height < 1:
        raise Refused("[x, y, width, height] with x, y >= 0 and width, height >= 1")
    return x, y, width, height


def _aovs(value: Any) -> tuple[str, ...]:
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list | tuple):
        raise Refused(f"a list of {', '.join(LAYERS)}")
    for index, name in enumerate(names):
        if not isinstance(name, str) or name not in LAYERS or name in names[:index]:
            raise Refused(f"a list of different ones of {', '.join(LAYERS)}", name, at=(index,))
    return tuple(names)


def _gamma(value: Any) -> float | str:
    if value == "srgb":
        return "srgb"
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 100:
        raise Refused("srgb or an exponent > 0 such as 0.4545")
    return float(value)


class Film(FrozenConfig):
    """The film block: size in pixels, reconstruction filter, AOVs, and tone mapping of 8-bit files."""

    parameters: ClassVar = {
        "width": Integer(
            512, low=1, high=MAX_SIDE, doc="in pixels; said alone, the height follows in the scene's shape"
        ),
        "height": Integer(512, low=1, high=MAX_SIDE, doc="in pixels; said alone, the width follows"),
        "filter": Custom(
            lambda _: _typed("filter", {}, "film.filter"),
            words=f"{', '.join(FILTERS)}, or a mapping",
            doc="how samples become pixels",
        ),
        "crop": Custom(
            None,
            reader=_crop,
            words="[x, y, width, height]",
            doc="the part that is rendered, in pixels",
        ),
        "aovs": Custom(
            (),
            reader=_aovs,
            words=f"a list of {', '.join(LAYERS)}",
            doc="layers, kept by .exr",
        ),
        "denoise": Flag(False, doc="a second picture beside the first, without its noise"),
        "exposure": Scalar(
            0.0, low=-64, high=64, words="a number of stops in -64..64", doc="of 8-bit files", role=Role.FREE
        ),
        "tonemap": Choice("none", names=("none", "filmic", "aces", "reinhard"), doc="of 8-bit files", role=Role.FREE),
        "gamma": Custom(
            "srgb",
            reader=_gamma,
            words="srgb or an exponent > 0",
            doc="of 8-bit files: out = in^gamma",
            role=Role.FREE,
        ),
    }

    @property
    def window(self) -> tuple[int, int, int, int]:
        """Return the part that is rendered, x, y, width and height in pixels: the crop, or all."""
        return self.crop or (0, 0, self.width, self.height)

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse a film of too many pixels, and a crop that reaches beyond it; see :class:`FrozenConfig`."""
        width, height, crop = values["width"], values["height"], values["crop"]
        if width * height > MAX_PIXELS:
            raise Refused(f"a film of at most {MAX_PIXELS} pixels", [width, height], at=("width",))
        if crop is None:
            return
        left, top, crop_width, crop_height = crop
        if left + crop_width > width or top + crop_height > height:
            raise Refused(f"a crop inside the film of {width} x {height} pixels", list(crop), at=("crop",))


#: Names of devices: auto, cpu, cuda, cuda:N.
_DEVICE = re.compile(r"(auto|cpu|cuda|cuda:[0-9]{1,3})\Z")


def _device(value: Any) -> str:
    if not isinstance(value, str) or not _DEVICE.match(value):
        raise Refused("auto, cpu, cuda or cuda:N")
    return value


def _pilots(value: Any) -> bool | str:
    if isinstance(value, bool) or value == "auto":
        return value
    raise Refused("auto, true or false")


def _file(value: Any) -> str:
    if isinstance(value, str) and value.strip() and value.isprintable():
        return value
    raise Refused("null or a file path")


#: A seed of a call: a whole number, or a tensor of one; None: a new one; by default the scene's.
SeedOfCall = int | Tensor | SceneValue | None
#: Values in place of a scene's parameters: tensors, or numbers, lists and arrays as in scene files.
Params = Mapping[str, Tensor | float | str | Sequence[Any] | np.ndarray]
#: Film settings of a call: a mapping, or width and height.
FilmSettings = Mapping[str, Any] | tuple[int, int] | list[int]
#: Methods for gradients, the default first.
ADJOINTS = ("replay", "autograd")
#: Arguments of a call, beside its seed, that may be tensors of one whole number.
_PLAIN_NUMBERS = ("spp", "spp_grad", "seed_grad")
#: Phrases of what is accepted.
_TYPE = "a type, or a mapping with `type` and its settings"
_FILE = "null or a file path"


def _whole_number(low: int, doc: str) -> Argument:
    """Return the spec of an argument that is a whole number, by default None."""
    words = f"a whole number >= {low}"
    return Argument(None, fits=lambda value: type(value) is int and value >= low, words=words, doc=doc)


def _flag(doc: str, *, default: bool) -> Argument:
    """Return the spec of an argument that is True or False."""
    return Argument(default, fits=lambda value: type(value) is bool, words="True or False", doc=doc)


# The arguments of `render`, and with them the block `render`: each is declared here only. Signatures, `help`, checks, keys of
# the command line, files of configs/ and tables of the docs are generated from this (`scripts/make_configs.py`,
# `scripts/make_tables.py`). A spec of type Argument belongs to Python calls alone; all others are settings of scene files too.


class _SampleOptions(TypedDict, total=False):
    """The argument that tables list first."""

    spp: Annotated[
        int | Tensor | None, Integer(64, low=1, doc="samples a pixel; a limit of time or error may end sooner")
    ]


class TraceOptions(TypedDict, total=False):
    """Arguments of all functions that trace paths."""

    integrator: Annotated[
        str | Mapping[str, Any] | Integrator | None,
        Custom(TYPED_BLOCKS["integrator"][1], words=_TYPE, doc="what is estimated"),
    ]
    sampler: Annotated[
        str | Mapping[str, Any] | None,
        Custom(TYPED_BLOCKS["sampler"][1], words=_TYPE, doc="where sample points come from"),
    ]
    device: Annotated[
        str | torch.device | None,
        Custom(
            "auto",
            reader=_device,
            words="auto, cpu, cuda or cuda:N",
            doc="auto: CUDA where a check of it passed, else the CPU; in Python the scene's own, where it was loaded",
        ),
    ]
    accel: Annotated[
        str | None,
        Choice("auto", names=("auto", "torch", "numba", "brute"), doc="the search structure"),
    ]
    compile: Annotated[
        str | bool | None,
        Choice(
            "auto",
            names=("auto", "on", "off"),
            booleans={True: "on", False: "off"},
            doc="whether stages run as kernels; auto: in float32 on a CPU, else as tensor operations",
        ),
    ]
    threads: Annotated[
        int | str | None,
        Integer("auto", low=1, high=1024, also=("auto",), doc="auto: as many as torch uses", role=Role.FREE),
    ]
    max_memory: Annotated[
        int | str | None,
        Custom(
            None,
            reader=reading.memory_size,
            words="null, bytes, or a size such as 4GB",
            doc="of all that the process holds above what import took; see docs/guides/stability.md",
            role=Role.FREE,
        ),
    ]
    dtype: Annotated[
        torch.dtype,
        Argument(
            torch.float32,
            fits=lambda value: value in (torch.float32, torch.float64),
            words="torch.float32 or torch.float64",
            doc="of the lanes; float64 is for checking derivatives, and the search stays float32",
        ),
    ]
    adjoint: Annotated[
        str | None,
        Argument(
            ADJOINTS[0],
            fits=lambda value: value in ADJOINTS,
            words=" or ".join(ADJOINTS),
            doc="how gradients are taken: `replay` traces paths again and goes back along them, in memory that grows with"
            " neither depth nor samples; `autograd` runs each chunk of pixels again under a plain tape",
        ),
    ]
    seed_grad: Annotated[
        int | Tensor | None,
        _whole_number(
            0, "of the backward pass; none: one of its own, as shared samples would bias the gradient of a squared loss"
        ),
    ]
    spp_grad: Annotated[
        int | Tensor | None,
        _whole_number(1, "samples a pixel of the backward pass; none: as many as the forward pass took"),
    ]


class BatchOptions(TraceOptions, total=False):
    """Arguments of :func:`torchpt.render` that are the same for all pictures of a batch."""

    film: Annotated[
        FilmSettings | None,
        Custom(
            None,
            words=f"(width, height), or a mapping of {', '.join(Film.parameters)}",
            doc="the picture: its size, its layers",
        ),
    ]
    pilots: Annotated[
        bool | str | None,
        Custom(
            "auto",
            reader=_pilots,
            words="auto, true or false",
            doc="whether one pixel of 16 is sampled twice, to estimate the picture's own error; auto: not in Python",
        ),
    ]
    time_limit: Annotated[
        float | None,
        Scalar(
            None,
            above=0.0,
            words="null or seconds > 0",
            doc="seconds of sampling; loading, building, compiling apart",
            role=Role.ENDS | Role.FREE,
        ),
    ]
    target_error: Annotated[
        float | None,
        Scalar(
            None,
            above=0.0,
            words="null or a relMSE > 0",
            doc="the relMSE, by its pilots, at which the picture is done",
            role=Role.ENDS,
        ),
    ]
    checkpoint: Annotated[
        str | None,
        Custom(
            None,
            reader=_file,
            words=_FILE,
            doc="where the state is written every few seconds and at the end, to go on from",
            role=Role.FILES | Role.FREE,
        ),
    ]
    resume: Annotated[
        bool | None,
        Flag(False, doc="whether to go on from the checkpoint, where there is one", role=Role.FILES | Role.FREE),
    ]
    edges: Annotated[
        bool, _flag("whether silhouettes and shadow edges that move are differentiated; False warns", default=True)
    ]
    edge_spp: Annotated[
        int | None,
        _whole_number(
            1,
            "samples a pixel of each estimator of edges; none: an eighth of the backward pass's, a sixteenth of many, "
            "a quarter for vertices, a thirty-second for large meshes",
        ),
    ]
    ranks: Annotated[
        Group | None,
        Argument(
            None,
            fits=lambda value: isinstance(value, Group),
            words="a torchpt.ranks.Group",
            doc="processes that share the work; each gets all of the picture",
        ),
    ]


class RendererOptions(_SampleOptions, BatchOptions, total=False):
    """Arguments of :func:`torchpt.render` beside the scene, ``full``, ``seed`` and ``params``."""

    edge_guide: Annotated[
        EdgeGuide | None,
        Argument(
            None,
            fits=lambda value: isinstance(value, EdgeGuide),
            words="a torchpt.EdgeGuide",
            doc="remembers which samples of edges contributed to earlier gradients of an optimization, and draws more of their"
            " kind",
        ),
    ]


class CommonOptions(RendererOptions, total=False):
    """Arguments of :func:`torchpt.render` beside the scene and ``full``."""

    seed: Annotated[
        SeedOfCall,
        Integer(0, high=MAX_SEED, doc="the same seed gives the same picture"),
        InPython(
            SCENE_VALUE,
            accepted=f"a whole number 0..{MAX_SEED}, a tensor of one, or None: a new one a call, drawn from torch's generator",
        ),
    ]
    params: Annotated[
        Params | None,
        Argument(
            None,
            fits=lambda value: isinstance(value, Mapping),
            words="a mapping from names of scene.params to tensors, or numbers and lists as in scene files",
            doc="values in place of the scene's, where a material has a number or colour also texels (H, W, C); where a tensor"
            " requires gradients, so does the picture",
        ),
    ]


class RenderOptions(CommonOptions, total=False):
    """All keyword arguments of :func:`torchpt.render`."""

    full: Annotated[
        bool,
        _flag("True: a torchpt.Rendering: picture, layers, error, counts and seconds as one object", default=False),
    ]


_ARGUMENTS = {name: argument.spec for name, argument in arguments_of(RenderOptions).items()}


class Render(FrozenConfig):
    """The render block: samples, seed, stop rules, device, threads, memory and files of a render."""

    parameters: ClassVar = {
        **{name: _ARGUMENTS[name] for name in ("spp", "seed")},  # first in tables
        **{name: spec for name, spec in _ARGUMENTS.items() if name not in BLOCKS and not isinstance(spec, Argument)},
        "preview": Custom(
            None,
            reader=_file,
            words=_FILE,
            doc="albedo and normal beside it first, then the picture so far after each pass",
            role=Role.FILES | Role.FREE,
        ),
    }

    @property
    def search_by_kernels(self) -> bool:
        """Return True if kernels of a device search rays where they can, instead of the structure that ``accel`` names."""
        return self.accel == "auto"

    @property
    def stops(self) -> dict[str, Any]:
        """Return the stop rules that are set, other than ``spp``, by name."""
        rules = {name: getattr(self, name) for name in settings_with(Role.ENDS)["render"]}
        return {name: value for name, value in rules.items() if value is not None}

    def without(self, role: Role) -> Render:
        """Return a copy in which the settings of a role have their defaults."""
        return Render(
            **{name: value for name, value in self.values.items() if name not in settings_with(role)["render"]}
        )

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse ``resume`` without a checkpoint; see :class:`FrozenConfig`."""
        if values["resume"] and values["checkpoint"] is None:
            raise Refused("false without render.checkpoint, the file to go on from", True, at=("resume",))


class CallArguments(FrozenConfig):
    """The arguments of :func:`torchpt.render` that are no settings of a scene file."""

    parameters: ClassVar = {name: spec for name, spec in _ARGUMENTS.items() if isinstance(spec, Argument)}

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> CallArguments:
        """Read these arguments from all ``options`` of a call by name; others are passed over.

        Raises:
            SceneError: a value that is not accepted.
        """
        values: dict[str, Any] = {}
        for name in [name for name in cls.parameters if name in options]:
            try:
                values[name] = arguments_of(RenderOptions)[name].read(options[name])
            except Refused as error:
                raise scene_error(error, key=name, value=options[name], file=None) from None
        return cls(**values)


def seed_number(seed: SeedOfCall) -> Any:
    """Return the seed of a call as a number; None draws a new one from torch's default generator of the CPU.

    Other values, :data:`~torchpt.spec.arguments.SCENE_VALUE` among them, are returned unchanged.

    Raises:
        SceneError: a tensor that is not a single whole number.
    """
    if seed is None:
        with outside_transforms():
            return int(torch.randint(MAX_SEED, (), device="cpu"))
    expected = "a whole number, also as a tensor with one element, or None for a new one"
    return _number_of(seed, "seed", expected) if isinstance(seed, Tensor) else seed


def with_plain_numbers(options: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return arguments of a call in which samples and the seed of the backward pass are no tensors.

    Raises:
        SceneError: a tensor that is not a single whole number.
    """
    expected = "a whole number, also as a tensor with one element"
    given = {name: options[name] for name in _PLAIN_NUMBERS if isinstance(options.get(name), Tensor)}
    return (
        {**options, **{name: _number_of(value, name, expected) for name, value in given.items()}} if given else options
    )


def _number_of(value: Tensor, key: str, expected: str) -> int:
    """Return the whole number that a tensor holds."""
    shown = (tuple(value.shape), value.dtype)
    whole = not (value.is_floating_point() or value.is_complex() or value.dtype == torch.bool or value.is_meta)
    if not whole or value.numel() != 1 or is_transformed(value):
        shown = "a tensor under a transform of torch.func" if is_transformed(value) else shown
        raise SceneError(key, shown, expected)
    return int(value)


def base_seed(seed: Any) -> int:
    """Return the first of the seeds that are counted on from it, a whole number or a tensor of one.

    Raises:
        SceneError: something else.
    """
    number = seed_number(seed) if isinstance(seed, Tensor) else seed
    if type(number) is not int or number < 0:
        raise SceneError("seed", number, "a whole number >= 0")
    return number


def film_keys(film: Any) -> Any:
    """Return the mapping of film settings that a pair ``(width, height)`` stands for; other values unchanged."""
    if isinstance(film, tuple | list) and len(film) == 2:
        return {"width": film[0], "height": film[1]}
    return film


def settings_of_call(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings among the arguments of a call, by block, without the device, which belongs to the scene."""
    render = {name: options.get(name) for name in Render.parameters if name in _ARGUMENTS and name != "device"}
    render = {name: None if value is SCENE_VALUE else value for name, value in render.items()}
    return {**{name: options.get(name) for name in BLOCKS}, "render": render}


#: The blocks without a type.
UNTYPED_BLOCKS: Mapping[str, type[FrozenConfig]] = {"film": Film, "render": Render}


def settings_with(role: Role, but: Role = Role.NONE) -> dict[str, tuple[str, ...]]:
    """Return the names of settings with a role, by block, without those that also have the role ``but``."""
    return {
        block: tuple(name for name, spec in parameters_of(record).items() if spec.role & role and not spec.role & but)
        for block, record in UNTYPED_BLOCKS.items()
    }


@dataclass(frozen=True)
class Settings:
    """The complete settings of a render.

    Attributes:
        film: the film block.
        integrator: the integrator.
        sampler: the sampler's kind and values.
        render: the render block.
    """

    film: Film
    integrator: Integrator
    sampler: ParsedParams
    render: Render

    @property
    def adaptive(self) -> bool:
        """Return True for adaptive sampling."""
        return bool(self.sampler.values.get("adaptive", False))

    @property
    def pilots(self) -> bool:
        """Return True where error probes are sampled; ``auto``: where adaptive sampling or ``target_error`` needs them.

        There are none for integrators whose picture is no radiance (``light`` is False) or whose samples light other pixels
        than their own (``splats``), nor beside the AOV ``variance``, which tells the error by itself.
        """
        if not self.integrator.light or self.integrator.splats or "variance" in self.film.aovs:
            return False
        needed = self.adaptive or self.render.target_error is not None
        return needed if self.render.pilots == "auto" else bool(self.render.pilots)

    @property
    def streams(self) -> int:
        """Return the number of independent randomizations (streams) of a pixel: one, or more where their spread is asked for.

        That is for the AOV ``variance``, and in place of error probes where samples light other pixels than their own.
        """
        spp, instead = self.render.spp, self.integrator.splats and self.render.pilots is True
        return min(spp, 4 if spp >= MANY_SAMPLES else 2) if "variance" in self.film.aovs or instead else 1

    @property
    def light_choice(self) -> str:
        """Return the name of the light sampler."""
        return self.integrator.light_choice

    @property
    def lights_alone(self) -> bool:
        """Return True if lights may be sampled alone, not combined with BSDF sampling by MIS."""
        return self.integrator.strategy != "mis"

    def plain(self, without: Mapping[str, Collection[str]] = MappingProxyType({})) -> dict[str, Any]:
        """Return the settings as plain values in the form of a scene file, without the keys ``without``, by block."""
        blocks = {name: _plain(getattr(self, name)) for name in BLOCKS}
        return {
            block: {key: value for key, value in values.items() if key not in without.get(block, ())}
            for block, values in blocks.items()
        }


def _plain(value: Any) -> Any:
    """Return a record, or a type with its parameters, as a mapping in the form of a scene file; other values unchanged."""
    if not isinstance(value, FrozenConfig | ParsedParams):
        return value
    kind = {"type": value.name} if hasattr(value, "name") else {}
    return kind | {key: _plain(item) for key, item in value.values.items()}


def _keys_that_are_set(raw: Any, key: str, file: str | None) -> dict[str, Any]:
    """Return the keys of a block that are not null; a bare name stands for a block of that type."""
    if raw is None:
        return {}
    if isinstance(raw, str) and key.rpartition(".")[2] in TYPED_BLOCKS:
        return {"type": raw}
    if not isinstance(raw, Mapping):
        pair = "(width, height), or " if key == "film" and file is None else ""
        raise SceneError(key, raw, f"{pair}a mapping of settings", file)
    return {str(name): value for name, value in raw.items() if value is not None}


def _merge_typed(block: str, below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Merge a typed block over another; where the type changes, ``below`` loses keys that the new type does not have."""
    table, default = TYPED_BLOCKS[block]
    before, after = below.get("type", default), above.get("type", below.get("type", default))
    if before != after and isinstance(after, str) and after in table:
        own = parameters_of(table[after])
        below = {name: value for name, value in below.items() if name in own}
    return {**below, **above}


def keep_aspect(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Complete the film keys of an override: a width or a height alone keeps the aspect ratio of the film below.

    Args:
        below: film keys of the scene; missing ones have their defaults.
        above: film keys of the override.
    """
    sides = [name for name in ("width", "height") if above.get(name) is not None]
    if len(sides) != 1:
        return dict(above)
    side, other = sides[0], "height" if sides == ["width"] else "width"
    old_side, old_other = (
        Film.parameters[name].default if below.get(name) is None else below[name] for name in (side, other)
    )
    new_side = above[side]
    if not all(type(value) is int and 1 <= value <= MAX_SIDE for value in (old_side, old_other, new_side)):
        return dict(above)  # wrong values are reported when the block is read
    # old_other * new_side / old_side, rounded to the nearest whole number without floats.
    return {**above, other: max(1, (2 * old_other * new_side + old_side) // (2 * old_side))}


def merge(scene: Mapping[str, Any], overrides: Mapping[str, Any], file: str | None) -> Settings:
    """Merge the blocks of a scene file and overrides, both by block name, to complete settings.

    Raises:
        SceneError: an unknown block or key, a key that the chosen type does not have, a bad value.
    """
    if isinstance(overrides.get("film"), tuple | list):
        overrides = {**overrides, "film": film_keys(overrides["film"])}
    instance = overrides.get("integrator")
    if isinstance(instance, Integrator):  # made in Python, complete: nothing to merge
        return _merge({**scene, "integrator": None}, {**overrides, "integrator": None}, file, instance)
    given = {name: _plain_mappings(blocks) for name, blocks in (("scene", scene), ("overrides", overrides))}
    return _merged.get(file, given, lambda: _merge(scene, overrides, file))


#: Settings by the blocks that they were merged from: loops of renders merge the same ones again and again.
_merged: ResultCache[Settings] = ResultCache(most=256)


def _plain_mappings(blocks: Mapping[str, Any]) -> Any:
    """Return blocks with dicts in place of mappings of other types, which the cache does not take."""
    return {name: dict(value) if isinstance(value, Mapping) else value for name, value in blocks.items()}


def _merge(
    scene: Mapping[str, Any], overrides: Mapping[str, Any], file: str | None, instance: Integrator | None = None
) -> Settings:
    """Merge without the cache; ``instance``: an integrator in place of the block."""
    check_keys(overrides, BLOCKS, key="", what="the settings", file=None)
    blocks: dict[str, Any] = {}
    for block in BLOCKS:
        below = _keys_that_are_set(scene.get(block), key=block, file=file)
        above = _keys_that_are_set(overrides.get(block), key=block, file=None)
        if block == "film":
            above = keep_aspect(below, above)
        raw = _merge_typed(block, below, above) if block in TYPED_BLOCKS else {**below, **above}
        if "filter" in raw:
            below_filter = _keys_that_are_set(below.get("filter"), key="film.filter", file=file)
            above_filter = _keys_that_are_set(above.get("filter"), key="film.filter", file=None)
            raw["filter"] = _merge_typed("filter", below_filter, above_filter)
        try:
            if block == "render":
                _check_stop_rules(raw, blocks["sampler"])
            blocks[block] = instance if instance is not None and block == "integrator" else _read_block(block, raw)
        except SceneError as error:
            blame = None if _contains(overrides, error.key) else file  # the file is at fault only for its own keys
            raise type(error)(error.key, error.value, error.expected, blame) from None
    settings = Settings(**blocks)
    try:
        _check_together(settings)
    except SceneError as error:
        blame = None if _contains(overrides, error.key) else file
        raise type(error)(error.key, error.value, error.expected, blame) from None
    return settings


def _check_together(settings: Settings) -> None:
    """Raise where settings exclude one another."""
    _check_pilots(settings)
    if not settings.integrator.light:
        if settings.film.denoise:
            expected = f"false where integrator is {settings.integrator.name} (it carries no light)"
            raise SceneError("film.denoise", True, expected)
        for name in settings.film.aovs:
            if LAYERS[name].light:
                expected = f"no {name} where integrator is {settings.integrator.name} (it carries no light)"
                raise SceneError("film.aovs", list(settings.film.aovs), expected)


def _check_pilots(settings: Settings) -> None:
    """Raise where settings need error probes that other settings exclude, or probes are redundant."""
    film, render = settings.film, settings.render
    adaptive, variance = settings.adaptive, "variance" in film.aovs
    for key, wanted in (("sampler.adaptive", adaptive), ("render.target_error", render.target_error is not None)):
        if not wanted:
            continue
        value = render.target_error if key.startswith("render") else adaptive
        if render.pilots is False:
            raise SceneError("render.pilots", False, f"auto or true beside {key}")
        if not settings.integrator.light:
            expected = f"an integrator that carries light, not {settings.integrator.name}"
            raise SceneError(key, value, expected)
        if settings.integrator.splats:
            expected = f"an integrator whose samples light their own pixels alone, not {settings.integrator.name}"
            raise SceneError(key, value, expected)
        if variance:
            raise SceneError("film.aovs", list(film.aovs), f"no variance beside {key}")
    if variance and render.pilots is True:
        expected = "auto or false where film.aovs asks for variance: every pixel is sampled by two streams then"
        raise SceneError("render.pilots", True, expected)


def _check_stop_rules(raw: Mapping[str, Any], sampler: ParsedParams) -> None:
    """Raise for a stop rule other than ``spp`` with a sampler whose points depend on their number."""
    for name in settings_with(Role.ENDS)["render"]:
        if sampler.kind.needs_count and raw.get(name) is not None:
            free = ", ".join(kind for kind in SAMPLERS if not SAMPLERS[kind].needs_count)
            expected = (
                f"null where sampler is {sampler.name}, whose points depend on how many there are (free of it: {free})"
            )
            raise SceneError(dotted("render", name), raw[name], expected)


def _contains(overrides: Mapping[str, Any], key: str) -> bool:
    """Return True where the overrides contain the key of an error."""
    value: Any = overrides
    for part in key.split(".")[:3]:  # deeper parts of a key lie inside a single value
        if isinstance(value, list | tuple):
            return True
        if not isinstance(value, Mapping) or value.get(part) is None:
            return isinstance(value, str)  # a bare name stands for a block of that type
        value = value[part]
    return True


def _read_block(block: str, raw: dict[str, Any]) -> Any:
    """Return a block in its final form: an integrator, a sampler's parameters, a film or render record."""
    if block in TYPED_BLOCKS:
        table, default = TYPED_BLOCKS[block]
        refuse_unused_keys(block, table, raw, default=default, file=None)
        parsed = _typed(block, raw, block)
        return parsed.kind(**parsed.values) if block == "integrator" else parsed
    if block == "film":
        if "filter" in raw:
            raw["filter"] = _typed("filter", raw["filter"], "film.filter")
        return Film(**read_params(Film, raw, key=block, file=None, words="the film").values)
    return Render(**read_params(Render, raw, key=block, file=None, words="the render settings").values)


def _typed(block: str, raw: dict[str, Any], key: str) -> ParsedParams:
    """Read a block of :data:`TYPED_BLOCKS`; ``key``: its dotted key, for errors."""
    table, default = TYPED_BLOCKS[block]
    return read_typed(block, table, raw, key=key, file=None, default=default)
