"""`torchpt convert`: write a scene of Mitsuba, or one of several YAML files, as one YAML file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from torchpt.cli import gc_pause
from torchpt.cli.arguments import GROUPS, UsageError, is_scene_word
from torchpt.cli.interrupt import Interrupt
from torchpt.cli.notices import printed_scene_warnings
from torchpt.cli.streams import flushed_stdout

__all__ = ["HELP", "run"]

HELP = """\
torchpt convert SCENE.xml SCENE.yaml [key=value ...]

  Write a scene of Mitsuba (XML, versions 0.3 to 3) as a YAML file, which renders the same picture. Meshes and images stay
  where they are; those that no file holds as the scene has them are written to a folder SCENE_meshes beside it.
  torchpt convert scene.xml scene.yaml 'scene_params={{spp: 64}}' import.missing=warn

  scene_params={{...}} values of the scene's own parameters, which stand as $name in it
  import.strict=true  an error in place of each warning                                                       false
  import.missing=warn grey in place of a missing image, nothing in that of a mesh                             error
  {changes}

Exit codes: 0; 2 bad input.
"""


def run(words: list[str], interrupt: Interrupt) -> int:
    """Convert a scene, print what was written and return the exit code.

    Raises:
        TorchptError: bad input.
    """
    from torchpt.scene.devices import device_of
    from torchpt.scene.formats.description import read_description
    from torchpt.scene.formats.write import write_scene
    from torchpt.scene.scene import Scene

    gc_pause.resume()  # the imports are done: collect garbage again
    source, target, changes = _parse(words)
    raw: dict[str, Any] = {}

    def keep(merged: dict[str, Any]) -> dict[str, Any]:
        raw.update(merged)
        return merged

    with printed_scene_warnings():
        description = read_description(source, change=keep, overrides=changes)
        built = Scene(description, device_of("cpu")).built
    interrupt.check()
    there = {part.shape for part in built.parts} | {copy.shape for copy in built.copies}
    raw["shapes"] = {name: shape for name, shape in raw.get("shapes", {}).items() if name in there}
    written = write_scene(raw, description.base, target, f"Converted from {Path(source).name} by torchpt.")
    counts = {key: len(raw.get(key, ())) for key in ("shapes", "materials", "textures", "lights")}
    with flushed_stdout():
        print(f"{target}: {', '.join(f'{count} {key}' for key, count in counts.items())}")
        print(json.dumps({"out": str(target), "meshes": [str(path) for path in written[:-1]], **counts}))
    return 0


def _parse(words: list[str]) -> tuple[str, Path, dict[str, Any]]:
    """Return the scene, the file to write and the overrides.

    Raises:
        UsageError: a wrong word.
    """
    from torchpt.cli.grammar import read_word

    files: list[str] = []
    changes: dict[str, Any] = {}
    for word in words:
        if is_scene_word(word):
            key, values, sweeps = read_word(word)
            if sweeps:
                raise UsageError(f"{word}: expected one value")
            if key in changes:
                raise UsageError(f"{key}: given twice")
            changes[key] = values[0]
        elif word.startswith("-"):
            raise UsageError(f"{word}: unknown option; known: --help")
        elif word.partition(".")[0] in GROUPS and "=" in word:
            raise UsageError(
                f"{word}: settings of renders are no part of a scene that is converted; set them in a render"
            )
        else:
            files.append(word)
    if len(files) != 2:
        raise UsageError(
            f"expected two files, torchpt convert SCENE.xml SCENE.yaml, got {len(files)}: {' '.join(files)}"
        )
    source, target = files
    if not target.endswith((".yaml", ".yml")):
        raise UsageError(f"{target}: expected the name of a file that ends in .yaml")
    if Path(target).exists() and Path(source).exists() and Path(target).samefile(source):
        raise UsageError(f"{target}: expected another file than the scene itself")
    return source, Path(target), changes
