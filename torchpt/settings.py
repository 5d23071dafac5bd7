"""The run settings (film, integrator, sampler, render): built-in default < scene file < explicit override."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import model_validator

from torchpt.errors import SceneError
from torchpt.samplers import KINDS
from torchpt.spec import not_built
from torchpt.spec.fields import Check, Flag, choice, integer, memory_size, number_field, wrong
from torchpt.spec.validate import Model, check_keys, construct, dotted, refuse_foreign, refuse_not_built, select

__all__ = [
    "AOVS", "BLOCKS", "AovIntegrator", "BoxFilter", "DirectIntegrator", "Film", "Filter", "GaussianFilter",
    "IblIntegrator", "Integrator", "MitchellFilter", "PathIntegrator", "Render", "Sampler", "Settings", "TentFilter", "merge",
]  # fmt: skip

AOVS = ("albedo", "normal", "depth", "position", "uv", "object_id", "variance")
BLOCKS = ("film", "integrator", "sampler", "render")
MAX_SIDE = 65_536
MAX_PIXELS = 2**28

Positive = Annotated[float, number_field("a number > 0", lambda x: x > 0)]
Share = Annotated[float, number_field("a number in 0..1", lambda x: 0 <= x <= 1)]
Clamp = Annotated[float | None, number_field("null or a number > 0", lambda x: x > 0, optional=True)]
Survival = Annotated[
    float | None, number_field("null or a number, 0 < rr_prob <= 1", lambda x: 0 < x <= 1, optional=True)
]

LightChoice = Annotated[str, choice("auto", "uniform", "power", "tree")]


class BoxFilter(Model):
    """The pixel's own square (radius 0.5 pixels)."""

    type: Literal["box"] = "box"

    @property
    def radius(self) -> float:
        """Half the width in pixels."""
        return 0.5


class TentFilter(Model):
    """A triangle that falls to zero at ``radius`` pixels, as Mitsuba's."""

    type: Literal["tent"] = "tent"
    radius: Positive = 1.0


class MitchellFilter(Model):
    """Mitchell and Netravali's cubic, two pixels wide, with Mitsuba's names; its lobes are negative where ``C`` > 0."""

    type: Literal["mitchell"] = "mitchell"
    B: Share = 1 / 3
    C: Share = 1 / 3

    @property
    def radius(self) -> float:
        """Half the width in pixels."""
        return 2.0


class GaussianFilter(Model):
    """A truncated gaussian, as Mitsuba's: ``exp(-x^2 / 2 stddev^2)`` minus its value at ``radius``, in pixels."""

    type: Literal["gaussian"] = "gaussian"
    stddev: Positive = 0.5
    radius: Positive = 2.0

    @model_validator(mode="before")
    @classmethod
    def _default_radius(cls, raw: Any) -> Any:
        stddev = raw.get("stddev", 0.5)
        if raw.get("radius") is None and isinstance(stddev, int | float):
            return {**raw, "radius": 4.0 * stddev}
        return raw


Filter = BoxFilter | TentFilter | GaussianFilter | MitchellFilter
FILTERS: dict[str, type[Any]] = {
    "gaussian": GaussianFilter, "box": BoxFilter, "tent": TentFilter, "mitchell": MitchellFilter,
}  # fmt: skip


def _crop(value: Any) -> tuple[int, int, int, int] | None:
    if value is None:
        return None
    if not isinstance(value, list | tuple) or len(value) != 4 or not all(type(x) is int for x in value):
        raise wrong("[x, y, width, height], whole numbers of pixels")
    x, y, width, height = value
    if x < 0 or y < 0 or width < 1 or height < 1:
        raise wrong("[x, y, width, height] with x, y >= 0 and width, height >= 1")
    return x, y, width, height


def _aovs(value: Any) -> tuple[str, ...]:
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list | tuple):
        raise wrong(f"a list of {', '.join(AOVS)}")
    for index, name in enumerate(names):
        if name not in AOVS or name in names[:index]:
            raise wrong(f"a list of different ones of {', '.join(AOVS)}", name, (index,))
    return tuple(names)


def _gamma(value: Any) -> float | str:
    if value == "srgb":
        return "srgb"
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 100:
        raise wrong("srgb or an exponent > 0 such as 0.4545")
    return float(value)


def _filter(value: Any) -> Any:
    if isinstance(value, Filter):
        return value
    raise wrong("a filter")


class Film(Model):
    """The picture: its size in pixels, its reconstruction filter, and how 8-bit files show it.

    Attributes:
        crop: ``(x, y, width, height)`` in pixels, or None for the whole film.
        aovs: extra layers.
        exposure: stops, for the 8-bit formats.
        gamma: ``srgb`` or the exponent itself (``out = in ** gamma``).
    """

    width: Annotated[int, integer(1, MAX_SIDE)] = 512
    height: Annotated[int, integer(1, MAX_SIDE)] = 512
    filter: Annotated[Filter, Check(_filter)] = GaussianFilter()
    crop: Annotated[tuple[int, int, int, int] | None, Check(_crop)] = None
    aovs: Annotated[tuple[str, ...], Check(_aovs)] = ()
    exposure: Annotated[float, number_field("a number of stops in -64..64", lambda x: abs(x) <= 64)] = 0.0
    tonemap: Annotated[str, choice("none", "filmic", "aces", "reinhard")] = "none"
    gamma: Annotated[float | str, Check(_gamma)] = "srgb"

    @model_validator(mode="after")
    def _sizes(self) -> Film:
        if self.width * self.height > MAX_PIXELS:
            raise wrong(f"a film of at most {MAX_PIXELS} pixels", [self.width, self.height], ("width",))
        if self.crop is not None:
            x, y, width, height = self.crop
            if x + width > self.width or y + height > self.height:
                raise wrong(
                    f"a crop inside the film of {self.width} x {self.height} pixels", list(self.crop), ("crop",)
                )
        return self


class PathIntegrator(Model):
    """Unidirectional path tracing.

    Attributes:
        max_depth: longest path in edges: 1 sees emission only, 2 adds direct light; -1 ends by roulette alone.
        rr_depth: the depth from which Russian roulette may end a path.
        rr_prob: a constant survival probability, or None (by throughput).
        strategy: how light is found: mis, bsdf, light, uniform (hemisphere).
        light_choice: which light is sampled: all alike (uniform), by power, by the light tree, or as many lights ask (auto).
        clamp: largest contribution of a sample, or None.
        strict: whether a sample that is not finite is an error.
    """

    type: Literal["path"] = "path"
    max_depth: Annotated[int, integer(-1, 2**31 - 1)] = 16
    rr_depth: Annotated[int, integer(1, 2**31 - 1)] = 5
    rr_prob: Survival = None
    strategy: Annotated[str, choice("mis", "bsdf", "light", "uniform")] = "mis"
    light_choice: LightChoice = "auto"
    clamp: Clamp = None
    strict: Flag = False

    @model_validator(mode="after")
    def _ends(self) -> PathIntegrator:
        if self.max_depth == -1 and self.rr_prob == 1.0:
            raise wrong("a survival probability below 1 where max_depth is -1 (paths would not end)", 1.0, ("rr_prob",))
        return self


class DirectIntegrator(Model):
    """Emission and direct light only; the keys are those of :class:`PathIntegrator`."""

    type: Literal["direct"] = "direct"
    strategy: Annotated[str, choice("mis", "bsdf", "light", "uniform")] = "mis"
    light_choice: LightChoice = "auto"
    clamp: Clamp = None
    strict: Flag = False


class AovIntegrator(Model):
    """The layers of ``film.aovs`` without any light transport."""

    type: Literal["aov"] = "aov"


class IblIntegrator(Model):
    """A preview: the first surface under the environment by split sum, unshadowed, and other lights with their shadows."""

    type: Literal["ibl"] = "ibl"
    light_choice: LightChoice = "auto"
    clamp: Clamp = None
    strict: Flag = False


Integrator = PathIntegrator | DirectIntegrator | AovIntegrator | IblIntegrator
INTEGRATORS: dict[str, type[Any]] = {
    "path": PathIntegrator,
    "direct": DirectIntegrator,
    "aov": AovIntegrator,
    "ibl": IblIntegrator,
}


class Sampler(Model):
    """Where sample points come from."""

    type: Annotated[str, choice(*KINDS)] = "sobol"

    @property
    def needs_count(self) -> bool:
        """Whether ``render.spp`` must be known before the first sample, so that nothing else may end a render."""
        return KINDS[self.type].needs_count


SAMPLERS: dict[str, type[Sampler]] = dict.fromkeys(KINDS, Sampler)

_DEVICE = re.compile(r"(auto|cpu|cuda|cuda:[0-9]{1,3})\Z")


def _device(value: Any) -> str:
    if not isinstance(value, str) or not _DEVICE.match(value):
        raise wrong("auto, cpu, cuda or cuda:N")
    return value


def _preview(value: Any) -> str | None:
    if value is None or (isinstance(value, str) and value.strip() and value.isprintable()):
        return value
    raise wrong("null or a file path")


class Render(Model):
    """How the work is done; none of it but ``spp`` and ``seed`` changes what the picture converges to.

    Attributes:
        max_memory: bytes, or None.
        preview: a file that shows the picture so far, or None.
    """

    spp: Annotated[int, integer(1, 2**31 - 1)] = 64
    seed: Annotated[int, integer(0, 2**63 - 1)] = 0
    device: Annotated[str, Check(_device)] = "auto"
    accel: Annotated[str, choice("auto", "torch", "numba", "brute")] = "auto"
    compile: Annotated[str, choice("auto", "on", "off", booleans={True: "on", False: "off"})] = "auto"
    threads: Annotated[int | str, integer(1, 1024, also=("auto",))] = "auto"
    max_memory: Annotated[int | None, Check(memory_size)] = None
    preview: Annotated[str | None, Check(_preview)] = None


class Settings(Model):
    """All run settings, complete."""

    film: Film = Film()
    integrator: Integrator = PathIntegrator()
    sampler: Sampler = Sampler()
    render: Render = Render()

    @property
    def light_choice(self) -> str:
        """How a light is chosen; where no light is sampled it does not matter."""
        return getattr(self.integrator, "light_choice", "auto")


_TYPED: dict[str, tuple[dict[str, type[Any]], str]] = {
    "integrator": (INTEGRATORS, "path"),
    "sampler": (SAMPLERS, "sobol"),
    "filter": (FILTERS, "gaussian"),
}


def _set(raw: Any, key: str, file: str | None) -> dict[str, Any]:
    """The keys of a block that are really set (null means unset); a filter's or block's bare name is its type."""
    if raw is None:
        return {}
    if isinstance(raw, str) and key.rpartition(".")[2] in _TYPED:
        return {"type": raw}
    if not isinstance(raw, Mapping):
        raise SceneError(key, raw, "a mapping of settings", file)
    return {str(name): value for name, value in raw.items() if value is not None}


def _overlay(kind: str, below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """``above`` over ``below``; keys of ``below`` that another type was meant to read do not follow."""
    table, default = _TYPED[kind]
    before, after = below.get("type", default), above.get("type", below.get("type", default))
    if before != after and after in table:
        fields = table[after].model_fields
        below = {name: value for name, value in below.items() if name in fields and name != "type"}
    return {**below, **above}


def merge(scene: Mapping[str, Any], overrides: Mapping[str, Any], file: str | None) -> Settings:
    """Complete settings from the blocks of a scene file and explicit overrides, both by block name.

    Raises:
        SceneError: an unknown block or key, a key that does nothing for the chosen type, a bad value.
        NotBuiltError: a setting that this version does not build.
    """
    check_keys(overrides, BLOCKS, "", "the settings", None)
    blocks: dict[str, Any] = {}
    for block in BLOCKS:
        below, above = _set(scene.get(block), block, file), _set(overrides.get(block), block, None)
        if block in _TYPED:
            raw = _overlay(block, below, above)
        else:
            raw = {**below, **above}
        if "filter" in raw:
            inner = [_set(part.get("filter"), "film.filter", name) for part, name in ((below, file), (above, None))]
            raw["filter"] = _overlay("filter", *inner)
        try:
            if block == "render":
                _open_end(raw, blocks["sampler"])
            blocks[block] = _block(block, raw)
        except SceneError as error:
            blame = None if _given(overrides, error.key) else file
            raise type(error)(error.key, error.value, error.expected, blame) from None
    if isinstance(blocks["integrator"], AovIntegrator) and "variance" in blocks["film"].aovs:
        raise SceneError(
            "film.aovs", list(blocks["film"].aovs), "no variance where integrator is aov (it carries no light)", file
        )
    return Settings.model_construct(**blocks)


def _open_end(raw: Mapping[str, Any], sampler: Sampler) -> None:
    """Raises where something else than ``spp`` is to end a render whose points depend on their number."""
    for name in ("time_limit", "target_error"):
        if sampler.needs_count and raw.get(name) is not None:
            free = ", ".join(name for name, kind in KINDS.items() if not kind.needs_count)
            expected = (
                f"null where sampler is {sampler.type}, whose points depend on how many there are (free of it: {free})"
            )
            raise SceneError(dotted("render", name), raw[name], expected)


def _given(overrides: Mapping[str, Any], key: str) -> bool:
    """Whether the override names the key that is wrong."""
    value: Any = overrides
    for part in key.split(".")[:3]:
        if not isinstance(value, Mapping) or value.get(part) is None:
            return isinstance(value, str)
        value = value[part]
    return True


def _block(block: str, raw: dict[str, Any]) -> Model:
    if block in _TYPED:
        table, default = _TYPED[block]
        if block == "integrator":
            refuse_foreign(block, table, raw, default, None)
        return select(block, table, raw, block, None, default)
    if block == "film":
        if "filter" in raw:
            raw["filter"] = select("filter", FILTERS, raw["filter"], "film.filter", None, "gaussian")
        return construct(Film, raw, block, None, "the film")
    later, what = not_built.KEYS["render"], "the render settings"
    check_keys({k: v for k, v in raw.items() if k not in later}, Render.model_fields, block, what, None)
    rest = refuse_not_built(raw, later, block, ", ".join(Render.model_fields), None)
    return construct(Render, rest, block, None, what)
