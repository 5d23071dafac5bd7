"""Hash pictures and gradients, to check that a change to the code keeps every bit.

    python scripts/hash_pictures.py before.json
    python scripts/hash_pictures.py after.json --against before.json     # exit code 1 where any differs

Every shipped scene at 4 samples a pixel, compiled; small pictures of every integrator, strategy, sampler, filter, way to
choose lights and layer, compiled and as tensor operations; and the gradients by all parameters of one scene each that has
meshes, textures, glass, many lights and a lens.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

import torchpt
from torchpt.core.errors import TorchptError

SCENES = sorted(path.stem for path in (Path(__file__).parents[1] / "configs" / "scene").glob("*.yaml"))
SMALL = {"width": 48, "height": 40}
LAYERS = ["albedo", "normal", "depth", "position", "uv", "object_id", "variance"]
MODES = {"eager": False, "compiled": True}
GRADIENTS = ("shapes_and_maps", "material_row", "cornell_transmissive", "many_lights", "thin_lens", "env_teapot")


def digest(x: torch.Tensor) -> str:
    """Hash the bytes of a tensor."""
    return hashlib.sha256(x.detach().cpu().contiguous().numpy().tobytes()).hexdigest()[:24]


def variants() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield scene, name and settings of the small pictures."""
    for scene in SCENES:
        for integrator in ("path", "direct", "ibl"):
            yield scene, integrator, {"integrator": integrator}
        yield scene, "layers", {"integrator": "aov", "film": {**SMALL, "aovs": LAYERS[:-1]}}
    for scene in ("cornell_specular", "shapes_and_maps"):
        for strategy in ("mis", "bsdf", "light", "uniform"):
            yield scene, strategy, {"integrator": {"type": "path", "strategy": strategy, "max_depth": 6}}
        yield scene, "roulette", {"integrator": {"type": "path", "max_depth": -1, "rr_depth": 2, "rr_prob": 0.7}}
        yield scene, "clamp", {"integrator": {"type": "path", "clamp": 0.5}}
        for sampler in ("sobol", "independent", "stratified", "hammersley", "zsobol"):
            yield scene, sampler, {"sampler": sampler, "spp": 6}
        for kind in ("box", "tent", "gaussian", "mitchell"):
            yield scene, kind, {"film": {**SMALL, "filter": {"type": kind}}}
    for scene in ("many_lights", "studio"):
        for choice in ("auto", "uniform", "power", "tree"):
            yield scene, choice, {"integrator": {"type": "path", "light_choice": choice}}


def picture(scene: Any, compiled: bool, settings: dict[str, Any]) -> str:
    """Return the hash of a picture, or the error message if it cannot be rendered."""
    keys: dict[str, Any] = {"spp": 4, "seed": 7, **settings}
    try:
        return digest(torchpt.render(scene, compile=compiled, **keys))
    except TorchptError as error:
        return type(error).__name__


def gradients(scene: Any) -> dict[str, str]:
    """Return hashes of the gradients of a picture's mean by all parameters."""
    given = {name: value.clone().requires_grad_() for name, value in scene.params.items()}
    image = torchpt.render(scene, spp=2, seed=3, params=given, film={"width": 24, "height": 20}, threads=1)
    found = torch.autograd.grad(image.mean(), list(given.values()), allow_unused=True)
    return {name: "none" if grad is None else digest(grad) for name, grad in zip(given, found, strict=True)}


def record() -> dict[str, str]:
    """Return all hashes by name."""
    found: dict[str, str] = {}
    scenes = {name: torchpt.load(name, device="cpu") for name in SCENES}
    for name, scene in scenes.items():
        found[f"{name}: compiled"] = picture(scene, True, {})
        print(f"{name}: compiled: {found[f'{name}: compiled']}", flush=True)
    for name, label, settings in variants():
        for mode, compiled in MODES.items():
            found[f"{name}: small {label}: {mode}"] = picture(scenes[name], compiled, {"film": SMALL, **settings})
    for name in GRADIENTS:
        found |= {f"{name}: gradient of {key}": value for key, value in gradients(scenes[name]).items()}
        print(f"{name}: gradients", flush=True)
    return found


def main() -> int:
    """Write the hashes, and compare them if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="where the hashes go, as JSON")
    parser.add_argument("--against", type=Path, help="an earlier record that must be equal")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    found = record()
    arguments.out.write_text(json.dumps(found, indent=1) + "\n")
    if arguments.against is None:
        return 0
    before = json.loads(arguments.against.read_text())
    changed = [name for name in before.keys() | found.keys() if before.get(name) != found.get(name)]
    for name in sorted(changed):
        print(f"differs: {name}: {before.get(name)} before, {found.get(name)} now")
    print(f"{len(found)} hashes, {len(changed)} differ")
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())
