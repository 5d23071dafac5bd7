"""A grid of settings: lists become axes, every combination a variant, and its label says only what differs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

from torchpt.errors import SceneError
from torchpt.files import configs
from torchpt.format.yaml_file import read_yaml
from torchpt.settings import BLOCKS, having
from torchpt.spec import Role
from torchpt.spec.validate import check_keys

__all__ = ["LISTS", "Variant", "blocks_of", "denoised_label", "flat", "variants_of"]

#: Settings whose value is a list: of these only a list of lists is an axis.
LISTS = ("film.crop",)
#: Settings that a study has its own way of saying, or that have no place in one.
_TAKEN = {
    **{f"render.{name}": "nothing: every run takes the samples that spp= says" for name in having(Role.ENDS)["render"]},
    **{
        f"render.{name}": "nothing: a study that was stopped resumes by itself" for name in having(Role.FILES)["render"]
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
        label: what differs from the other variants.
        settings: by dotted key or name of a group, as written.
        axes: of them, those that the grid gave a list of.
    """

    label: str
    settings: dict[str, Any]
    axes: tuple[str, ...]


def denoised_label(label: str) -> str:
    """What the curve of a variant's denoised pictures is called."""
    return f"{label}, denoised"


def flat(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Nested blocks as dotted keys; lists stay, with all that is in them."""
    found: dict[str, Any] = {}
    for key, value in raw.items():
        if isinstance(value, Mapping):
            found |= {f"{key}.{inner}": item for inner, item in flat(value).items()}
        else:
            found[str(key)] = value
    return found


def variants_of(settings: Mapping[str, Any], file: str | None) -> list[Variant]:
    """Every combination of what the lists hold, the last list turning fastest.

    Args:
        settings: by dotted key (``integrator.max_depth``) or name of a group; a value or a list of values.
        file: the study file, for errors.

    Raises:
        SceneError: an unknown key, an empty list, a value given twice, a setting that a study decides itself.
    """
    for key in settings:
        check_keys({key.partition(".")[0]: 0}, BLOCKS, "", "a study", file)
        if key in _TAKEN:
            raise SceneError(key, settings[key], _TAKEN[key], file)
    axes = {key: _values(key, value, file) for key, value in settings.items() if _is_axis(key, value)}
    wide = tuple(key for key, values in axes.items() if len(values) > 1)
    found = [{**settings, **dict(zip(axes, chosen, strict=True))} for chosen in product(*axes.values())]
    labels = _labels([flat({key: item[key] for key in wide}) for item in found])
    if len(set(labels)) < len(labels):
        raise SceneError(wide[0], settings[wide[0]], "settings that differ in more than how they are written", file)
    return [Variant(label, item, wide) for label, item in zip(labels, found, strict=True)]


def _is_axis(key: str, value: Any) -> bool:
    return isinstance(value, list) and (key not in LISTS or not value or isinstance(value[0], list))


def _values(key: str, values: list[Any], file: str | None) -> list[Any]:
    if not values or any(value in values[:index] for index, value in enumerate(values)):
        raise SceneError(key, values, "a list of different values", file)
    return values


def _labels(chosen: list[dict[str, Any]]) -> list[str]:
    """What a reader must be told of each to know it from the others."""
    keys = list(dict.fromkeys(key for item in chosen for key in item))
    told = [key for key in keys if len({repr(item.get(key)) for item in chosen}) > 1]
    return [", ".join(_words(key, item[key]) for key in told if key in item) or "as the scene says" for item in chosen]


def _words(key: str, value: Any) -> str:
    name = key.rpartition(".")[2].removeprefix("max_").replace("_", " ")
    if key in BLOCKS or name in ("type", "filter"):
        return str(value)
    if value is None or value is False:
        return f"no {name}"
    if value is True:
        return name
    return f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"


def blocks_of(settings: Mapping[str, Any], file: str | None) -> dict[str, dict[str, Any]]:
    """The overrides of one variant by block, as `torchpt.format.description.settings` takes them; nulls are kept.

    Raises:
        SceneError: a group without such a file, a key below something that is no block.
    """
    blocks: dict[str, dict[str, Any]] = {}
    for key, value in sorted(settings.items(), key=lambda item: item[0] not in BLOCKS):  # a group first
        if key in BLOCKS:
            blocks[key] = dict(value) if isinstance(value, Mapping) else _group(key, value, file)
            if taken := next((name for name in blocks[key] if f"{key}.{name}" in _TAKEN), None):
                raise SceneError(f"{key}.{taken}", blocks[key][taken], _TAKEN[f"{key}.{taken}"], file)
            continue
        block, *inner, last = key.split(".")
        place = blocks.setdefault(block, {})
        for name in inner:
            below = place.get(name)
            place[name] = dict(below) if isinstance(below, Mapping) else {} if below is None else {"type": below}
            place = place[name]
        place[last] = value
    return blocks


def _group(group: str, name: Any, file: str | None) -> dict[str, Any]:
    """What a group's file sets: ``integrator=path`` is ``configs/integrator/path.yaml``."""
    folder = configs() / group
    names = sorted(path.stem for path in folder.glob("*.yaml"))
    if name not in names:
        raise SceneError(group, name, f"one of {', '.join(names)}", file)
    return dict(_set(read_yaml(folder / f"{name}.yaml", str(folder / f"{name}.yaml"))))


def _set(block: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in block.items():
        kept = dict(_set(value)) if isinstance(value, Mapping) else value
        if kept is not None and kept != {}:
            yield key, kept
