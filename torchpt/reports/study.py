"""Read a study: its own settings and the grid of render settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from itertools import pairwise, product
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

from torchpt.core.errors import SceneError
from torchpt.core.files import configs
from torchpt.images.metrics import METRICS
from torchpt.scene.formats.yaml import plain, read_yaml
from torchpt.scene.settings import BLOCKS, Render, settings_with
from torchpt.spec import Custom, Flag, FrozenConfig, Integer, Refused, Role, parameters_of
from torchpt.spec.schema import check_keys, read_params

__all__ = [
    "ERRORS",
    "LISTS",
    "MEASURES",
    "OWN_KEYS",
    "UNTYPED_BLOCKS",
    "Extra",
    "Reference",
    "ReferencePlan",
    "Study",
    "Variant",
    "blocks_of",
    "denoised_label",
    "flat",
    "read_study",
    "study_of",
    "variants_of",
]


# ---- A grid of settings: lists become axes, every combination a variant, and its label says only what differs


#: Settings whose value is a list: of these only a list of lists is an axis.
LISTS = ("film.crop",)
#: Settings that a study refuses, each with what to write instead. Role.ENDS: those that may end a render before `spp` samples;
#: Role.FILES: those that decide which files a render writes.
_REFUSED = {
    **{
        f"render.{name}": "nothing: every run takes the samples that spp= says"
        for name in settings_with(Role.ENDS)["render"]
    },
    **{
        f"render.{name}": "nothing: a study that was stopped resumes by itself"
        for name in settings_with(Role.FILES)["render"]
    },
    "render.preview": "nothing: a study keeps every picture in its folder",
    "render.spp": "spp=[...], the steps of every curve",
    "render.seed": "seed=, from which the seeds of all runs follow",
    "film.denoise": "denoise=true, which gives denoised pictures curves of their own",
    "film.aovs": "nothing: a study compares pictures without layers",
}


@dataclass(frozen=True)
class Variant:
    """One combination of settings.

    Attributes:
        label: the settings that differ from other variants, in words.
        settings: values as written, by dotted key, or by the name of a block that has a folder in ``configs/``:
            ``{"integrator": "path"}`` takes the block from ``configs/integrator/path.yaml``.
        axes: keys that have more than one value in the grid.
        changes: overrides of the scene's keys, as :func:`torchpt.load` takes them.
    """

    label: str
    settings: dict[str, Any]
    axes: tuple[str, ...]
    changes: dict[str, Any] = field(default_factory=dict)


def denoised_label(label: str) -> str:
    """Return the label of a variant's denoised curve."""
    return f"{label}, denoised"


def flat(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested blocks as a flat mapping by dotted key; lists are kept whole."""
    found: dict[str, Any] = {}
    for key, value in raw.items():
        if isinstance(value, Mapping):
            found |= {f"{key}.{inner}": item for inner, item in flat(value).items()}
        else:
            found[str(key)] = value
    return found


def variants_of(
    settings: Mapping[str, Any], file: str | None, changes: Mapping[str, list[Any]] = MappingProxyType({})
) -> list[Variant]:
    """Return all combinations of the listed values; the last list varies fastest.

    Args:
        settings: values or lists of values by dotted key (``integrator.max_depth``) or name of a block, see
            :class:`Variant`.
        file: the study file, for errors.
        changes: values of the scene's keys, a list each (``overrides`` of the study).

    Raises:
        SceneError: an unknown key, an empty list, a repeated value, or a setting that a study refuses.
    """
    for key in settings:
        # The value is not looked at.
        check_keys({key.partition(".")[0]: None}, BLOCKS, key="", what="a study", file=file)
        if key in _REFUSED:
            raise SceneError(key, settings[key], _REFUSED[key], file)
    axes = {key: _values(key, value, file) for key, value in settings.items() if _is_axis(key, value)}
    varied = tuple(key for key, values in axes.items() if len(values) > 1)
    varied_changes = [key for key, values in changes.items() if len(_values(key, values, file)) > 1]
    combinations = [
        ({**settings, **dict(zip(axes, chosen, strict=True))}, dict(zip(changes, chosen_changes, strict=True)))
        for chosen in product(*axes.values())
        for chosen_changes in product(*changes.values())
    ]
    labels = _labels(
        [
            flat({key: values[key] for key in varied}) | {key: overrides[key] for key in varied_changes}
            for values, overrides in combinations
        ]
    )
    if len(set(labels)) < len(labels):
        expected = "settings that differ in more than how they are written"
        raise SceneError(varied[0], settings[varied[0]], expected, file)
    return [
        Variant(label, values, axes=varied, changes=overrides)
        for label, (values, overrides) in zip(labels, combinations, strict=True)
    ]


def _is_axis(key: str, value: Any) -> bool:
    """Return True if a value is a list of alternatives; an empty one counts, so that it is refused."""
    return isinstance(value, list) and (key not in LISTS or not value or isinstance(value[0], list))


def _values(key: str, values: list[Any], file: str | None) -> list[Any]:
    """Return the values of an axis unchanged; raise if there are none, or two are equal."""
    if not values or any(value in values[:index] for index, value in enumerate(values)):
        raise SceneError(key, values, "a list of different values", file)
    return values


def _labels(chosen: list[dict[str, Any]]) -> list[str]:
    """Return a label for each combination that tells it from the others."""
    keys = list(dict.fromkeys(key for item in chosen for key in item))
    differing = [key for key in keys if len({repr(item.get(key)) for item in chosen}) > 1]
    return [
        ", ".join(_words(key, item[key]) for key in differing if key in item) or "as the scene says" for item in chosen
    ]


def _words(key: str, value: Any) -> str:
    """Return a setting as it stands in labels: ``max_depth: 4`` is "depth 4", ``clamp: null`` is "no clamp"."""
    name = key.rpartition(".")[2].removeprefix("max_").replace("_", " ")
    if key in BLOCKS or name in ("type", "filter"):
        return str(value)
    if value is None or value is False:
        return f"no {name}"
    if value is True:
        return name
    return f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"


def blocks_of(settings: Mapping[str, Any], file: str | None) -> dict[str, dict[str, Any]]:
    """Return overrides by block, as :func:`torchpt.scene.formats.description.settings` takes them; nulls are kept.

    Raises:
        SceneError: ``configs/`` has no such file, or a setting that a study refuses.
    """
    blocks: dict[str, dict[str, Any]] = {}
    for key, value in sorted(settings.items(), key=lambda item: item[0] not in BLOCKS):  # whole blocks first
        if key in BLOCKS:
            blocks[key] = dict(value) if isinstance(value, Mapping) else _block_of_config(key, value, file)
            if refused := next((name for name in blocks[key] if f"{key}.{name}" in _REFUSED), None):
                raise SceneError(f"{key}.{refused}", blocks[key][refused], _REFUSED[f"{key}.{refused}"], file)
            continue
        block, *inner, last = key.split(".")
        parent = blocks.setdefault(block, {})
        for name in inner:
            child = parent.get(name)
            # A bare value is short for a block with this type.
            parent[name] = dict(child) if isinstance(child, Mapping) else {} if child is None else {"type": child}
            parent = parent[name]
        parent[last] = value
    return blocks


def _block_of_config(block: str, name: Any, file: str | None) -> dict[str, Any]:
    """Return the settings of a block's file in ``configs/``: ``integrator=path`` is ``configs/integrator/path.yaml``."""
    folder = configs() / block
    names = sorted(path.stem for path in folder.glob("*.yaml"))
    if name not in names:
        raise SceneError(block, name, f"one of {', '.join(names)}", file)
    return dict(_without_unset(read_yaml(folder / f"{name}.yaml", str(folder / f"{name}.yaml"))))


def _without_unset(block: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the keys and values of a block that are set: without nulls and empty blocks."""
    for key, value in block.items():
        kept = dict(_without_unset(value)) if isinstance(value, Mapping) else value
        if kept is not None and kept != {}:
            yield key, kept


# ---- What a study asks: scenes, a grid of settings, the steps of its curves, a reference, and what to make of them
#
# The same keys stand on the command line and in a study file; any other key there is a setting of the renderer.


#: What a curve can show, in the order of tables. Other measures have no trimmed form: `relmse_trimmed` is of this package.
MEASURES = tuple(dict.fromkeys(("relmse", "relmse_trimmed", *METRICS)))
#: The measures that fall toward 0: slopes, and times to an error, are computed for these.
ERRORS = tuple(name for name in MEASURES if name not in ("psnr", "ssim"))
#: Most steps of a curve.
_MOST_STEPS = 64


def _as_list(value: Any) -> list[Any]:
    """Return a list or tuple as a list, any other value as a list of one."""
    return list(value) if isinstance(value, list | tuple) else [value]


# Readers of the settings below: each returns the value as it is used, or raises Refused.


def _steps(value: Any) -> tuple[int, ...]:
    steps = _as_list(value)
    if not 2 <= len(steps) <= _MOST_STEPS or not all(type(n) is int and 1 <= n <= 2**30 for n in steps):
        raise Refused("a list of two or more growing numbers of samples a pixel, such as [4, 16, 64]")
    if any(a >= b for a, b in pairwise(steps)):
        raise Refused("numbers of samples a pixel that grow, such as [4, 16, 64]")
    return tuple(steps)


def _metrics(value: Any) -> tuple[str, ...]:
    names = _as_list(value)
    for index, name in enumerate(names):
        if name not in MEASURES or name in names[:index]:
            raise Refused(f"a list of different ones of {', '.join(MEASURES)}", name)
    if not names or names[0] not in ERRORS:
        raise Refused(f"a list whose first is an error, which the curves show: one of {', '.join(ERRORS)}")
    return tuple(names)


def _targets(value: Any) -> tuple[float, ...]:
    levels = _as_list(value)
    for level in levels:
        if isinstance(level, bool) or not isinstance(level, int | float) or not 0 < level < 1e12:
            raise Refused("errors > 0, one or a list", level)
    return tuple(sorted({float(level) for level in levels}, reverse=True))


@dataclass(frozen=True)
class Extra:
    """A picture by another renderer.

    Attributes:
        name: name of its curve.
        seconds: render time.
        file: path of the picture.
        scene: name of the scene.
        spp: samples a pixel; None if unknown.
    """

    name: str
    seconds: float
    file: str
    scene: str
    spp: int | None = None


def _extras(value: Any) -> tuple[dict[str, Any], ...]:
    known = ("name", "seconds", "file", "scene", "spp")
    expected = "a list of {name, seconds, file}, each perhaps with scene and spp"
    for index, item in enumerate(_as_list(value)):
        if not isinstance(item, Mapping) or not {"name", "seconds", "file"} <= item.keys() <= set(known):
            raise Refused(expected, item, (index,))
        seconds, spp = item["seconds"], item.get("spp")
        if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0 < seconds < 1e9:
            raise Refused("seconds > 0", seconds, (index, "seconds"))
        if spp is not None and (type(spp) is not int or spp < 1):
            raise Refused("a whole number >= 1", spp, (index, "spp"))
        for key in ("name", "file"):
            if not isinstance(item[key], str) or not item[key].strip():
                raise Refused("text", item[key], (index, key))
    return tuple(dict(item) for item in _as_list(value))


class StudyOptions(FrozenConfig):
    """Settings of a study besides ``scene`` and ``reference``."""

    parameters: ClassVar = {
        "spp": Custom((4, 16, 64, 256), reader=_steps, words="growing numbers", doc="samples a pixel of each step"),
        "seeds": Integer(5, low=2, high=1000, doc="independent runs of each step"),
        "seed": replace(parameters_of(Render)["seed"], doc="the seeds of all runs follow from it"),
        "metrics": Custom(
            ("relmse", "relmse_trimmed", "mse", "smape", "psnr", "ssim", "flip"),
            reader=_metrics,
            words="names of measures",
            doc="what is measured; curves show the first",
        ),
        "target": Custom(
            None, reader=_targets, words="errors > 0", doc="of the first measure: the time to reach them is told"
        ),
        "extra": Custom(
            (), reader=_extras, words="a list of {name, seconds, file}", doc="other renderers' pictures, linear"
        ),
        "denoise": Flag(False, doc="beside every curve a second one, of the denoised pictures of its runs"),
        "title": Custom("Error against run time", reader=str, words="text", doc="of the page"),
    }


#: Samples a pixel of a reference's runs, over those of the largest step, where `reference.spp` is not given.
_REFERENCE_FACTOR = 4


class Reference(FrozenConfig):
    """Settings of a reference that is rendered."""

    parameters: ClassVar = {
        "spp": Integer(None, low=1, doc="samples a pixel of each of its runs; 4 times the largest step"),
        "seeds": Integer(8, low=2, high=1000, doc="independent runs that it is the mean of"),
    }


#: Keys of a study that are no settings of the renderer.
OWN_KEYS = (*StudyOptions.parameters, "scene", "reference", "overrides")
#: For the tables of the docs.
UNTYPED_BLOCKS = {"study": StudyOptions, "reference": Reference}


@dataclass(frozen=True)
class ReferencePlan:
    """The reference of a study: files, or runs to be made.

    Attributes:
        files: path by scene; empty if the reference is rendered.
        spp: samples a pixel of each run.
        seeds: number of runs.
        settings: overrides by dotted key of the settings that all variants share.
    """

    files: dict[str, str]
    spp: int
    seeds: int
    settings: dict[str, Any]


@dataclass(frozen=True)
class Study:
    """A study, validated as far as possible without loading its scenes.

    Attributes:
        scenes: names or paths of the scenes.
        variants: the combinations of the grid.
        options: settings of the study: spp, seeds, seed, metrics, target, denoise, title.
        extras: other renderers' pictures.
        reference: the reference.
        file: the study file.
    """

    scenes: tuple[str, ...]
    variants: tuple[Variant, ...]
    options: Any
    extras: tuple[Extra, ...]
    reference: ReferencePlan
    file: str | None = None

    def overrides(self, variant: Variant) -> dict[str, dict[str, Any]]:
        """Return the overrides of a variant by block."""
        return blocks_of(variant.settings, self.file)

    def reference_overrides(self, variant: Variant) -> dict[str, dict[str, Any]]:
        """Return the overrides of a variant's reference: shared settings, its film, no clamp; then those of ``reference``."""
        # Axes of the film are kept, since a reference has to show the same picture.
        own = {k: v for k, v in variant.settings.items() if k not in variant.axes or k.partition(".")[0] == "film"}
        return blocks_of({**own, "integrator.clamp": None, **self.reference.settings}, self.file)


def read_study(name: str) -> tuple[dict[str, Any], str]:
    """Return the keys of a study file, and its path; relative paths in it start at its folder.

    Args:
        name: name of a study in ``configs/study/``, or a path that ends in ``.yaml``.

    Raises:
        SceneError: the file is missing, is no valid YAML, or no mapping.
    """
    shipped = {path.stem: str(path) for path in sorted((configs() / "study").glob("*.yaml"))}
    if not name.endswith((".yaml", ".yml")) and name not in shipped:
        raise SceneError("study", name, f"one of {', '.join(shipped)}, or a path ending in .yaml")
    path = shipped.get(name, name)
    if not Path(path).is_file():
        raise SceneError("study", path, "a study file that is there")
    raw = read_yaml(Path(path), path)
    if not isinstance(raw, dict):
        raise SceneError("study", raw, "a mapping of keys such as scene, spp, sampler", path)
    raw = plain(raw, path)
    base = Path(path).parent

    def beside_study(file: Any) -> Any:  # a path, relative to the study file's folder
        return str(base / file) if isinstance(file, str) else file

    def scene_name(scene: Any) -> Any:  # a scene: a path, or the name of one that ships
        return beside_study(scene) if str(scene).endswith((".yaml", ".yml", ".xml")) else scene

    if "scene" in raw:
        raw["scene"] = [scene_name(scene) for scene in _as_list(raw["scene"])]
    reference = raw.get("reference")
    if isinstance(reference, str):
        raw["reference"] = beside_study(reference)
    elif isinstance(reference, Mapping) and "file" in reference:
        files = reference["file"]
        files = (
            {scene_name(k): beside_study(v) for k, v in files.items()}
            if isinstance(files, Mapping)
            else beside_study(files)
        )
        raw["reference"] = {**reference, "file": files}
    if isinstance(raw.get("extra"), list):
        raw["extra"] = [_extra_beside_study(item, beside_study, scene_name) for item in raw["extra"]]
    return raw, path


def _extra_beside_study(item: Any, beside_study: Callable[[Any], Any], scene_name: Callable[[Any], Any]) -> Any:
    if not isinstance(item, Mapping):
        return item
    scene = {"scene": scene_name(item["scene"])} if "scene" in item else {}
    return {**item, "file": beside_study(item.get("file")), **scene}


def study_of(raw: Mapping[str, Any], file: str | None = None) -> Study:
    """Return the study with the given keys, as a file and the command line have them.

    Raises:
        SceneError: a key or value is not accepted.
    """
    scenes = tuple(_as_list(raw.get("scene") or []))
    if not scenes or not all(isinstance(name, str) for name in scenes) or len(set(scenes)) < len(scenes):
        raise SceneError(
            "scene", raw.get("scene"), "the name of a scene, a path ending in .yaml, or a list of them", file
        )
    options = read_params(
        StudyOptions,
        {key: raw[key] for key in StudyOptions.parameters if key in raw},
        key="",
        file=file,
        words="a study",
    )
    if "flip" in options["metrics"] and find_spec("flip_evaluator") is None:
        if "metrics" in options.given:
            expected = "measures that are there (flip: pip install '.[compare]' in the checkout of torchpt)"
            raise SceneError("metrics", list(options["metrics"]), expected, file)
        options.values["metrics"] = tuple(name for name in options["metrics"] if name != "flip")
    settings: dict[str, Any] = {}
    for key, value in raw.items():
        if key not in OWN_KEYS and not key.startswith("reference."):
            settings |= flat({key: value})
    changes = raw.get("overrides") or {}
    variants = tuple(variants_of(settings, file, changes))
    labels = {variant.label for variant in variants}
    labels |= {denoised_label(label) for label in labels if options["denoise"]}
    extras = []
    for index, item in enumerate(options["extra"]):
        scene = item.get("scene", scenes[0] if len(scenes) == 1 else None)
        if scene not in scenes:
            raise SceneError(f"extra.{index}.scene", scene, f"one of {', '.join(scenes)}", file)
        if item["name"] in labels:
            raise SceneError(f"extra.{index}.name", item["name"], "a name that no curve has", file)
        extras.append(
            Extra(
                name=item["name"],
                seconds=float(item["seconds"]),
                file=item["file"],
                scene=scene,
                spp=item.get("spp"),
            )
        )
    plan = _plan(raw.get("reference"), scenes, largest_spp=options["spp"][-1], file=file)
    if plan.files and (several := next((key for key, values in changes.items() if len(values) > 1), None)):
        raise SceneError(several, changes[several], "one value where reference= is a file, which shows one scene", file)
    return Study(
        scenes=scenes, variants=variants, options=options.values, extras=tuple(extras), reference=plan, file=file
    )


def _plan(raw: Any, scenes: tuple[str, ...], largest_spp: int, file: str | None) -> ReferencePlan:
    """Return the reference of a path, of a mapping with ``file``, or of one with ``spp``, ``seeds`` and settings."""
    if raw is None or isinstance(raw, str):
        raw = {} if raw is None else {"file": raw}
    if not isinstance(raw, Mapping):
        raise SceneError("reference", raw, "a file, or a mapping with spp, seeds and settings", file)
    files = raw.get("file")
    if files is not None:
        if other := next((key for key in raw if key != "file"), None):
            raise SceneError(f"reference.{other}", raw[other], "nothing where reference.file is given", file)
        files = {scenes[0]: files} if isinstance(files, str) and len(scenes) == 1 else files
        if not isinstance(files, Mapping) or set(files) != set(scenes):
            raise SceneError("reference.file", files, f"a file for each of {', '.join(scenes)}", file)
        return ReferencePlan(files=dict(files), spp=0, seeds=0, settings={})  # not rendered
    own = {key: value for key, value in raw.items() if key in parameters_of(Reference)}
    options = read_params(Reference, own, key="reference", file=file, words="a reference")
    settings = flat({key: value for key, value in raw.items() if key not in own})
    for key, value in settings.items():
        if isinstance(value, list) and key not in LISTS:
            raise SceneError(f"reference.{key}", value, "one value: there is one reference", file)
    variants_of(settings, file)  # for its errors: unknown keys, and settings that a study refuses
    spp = options["spp"] or _REFERENCE_FACTOR * largest_spp
    return ReferencePlan(files={}, spp=spp, seeds=options["seeds"], settings=settings)
