"""Render public Mitsuba scenes by both programs: agreement, load, first picture, paths a second.

    python scripts/compare_scenes.py ../shared/scenes/*/*.xml --width 160 --spp 128 --seeds 12
    python scripts/compare_scenes.py scene.xml --pictures out    # both pictures as PNG, to look at

Mitsuba 3.9 opens hardly any published file: it gets a copy that is mended as this program reads the file (integrators that it
lacks are ``path``, ``roughdiffuse`` is ``diffuse`` (ours gets its alpha as 0), keys that it does not know are dropped, an
old sky is its own of today). Needs the extra `bench`, and LLVM where ``DRJIT_LIBLLVM_PATH`` says. The columns: mean of ours
over Mitsuba's with the standard error of the seeds; how many blocks of 16 x 16 pixels differ by more than 4 of their
standard errors, of all; seconds until the scene is loaded and until its first picture at 1 sample a pixel, ours and
Mitsuba's; paths a second, ours over Mitsuba's.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mitsuba_scene import load_mitsuba, sky_pose, sky_values

import torchpt
from torchpt.core.errors import ImportedSceneWarning
from torchpt.spec.schema import ParsedParams

#: Regular expressions of what Mitsuba 3.9 refuses, and what takes its place.
MENDS = (
    (r'(<integrator\s+type=")(?!path"|direct")[^"]*"', r'\1path"'),
    (r'<(integer|boolean)\s+name="(photonCount|maxPasses|stepSnapshot|kNN|dualBuffer)"[^>]*/>', ""),
    (r'<boolean\s+name="high_quality_edges"[^>]*/>', ""),
    (r'<float\s+name="(gamma|extEta|ext_eta)"[^>]*/>', ""),
    (r'value="trilinear"', 'value="bilinear"'),
    (r'(<bsdf\s+type="roughdiffuse"[^>]*>\s*<rgb[^>]*/>)\s*<float\s+name="alpha"[^>]*/>', r"\1"),
    (r'type="roughdiffuse"', 'type="diffuse"'),
)
BLOCK = 16


#: Emitters that Mitsuba has under another name and with other keys today.
SKY = re.compile(r'<emitter\s+type="(?:sunsky|sky|sun)".*?</emitter>', re.DOTALL)


def mended(file: Path, folder: Path, scene: torchpt.Scene) -> Path:
    """Return a copy that Mitsuba opens, in a folder that has links to the files beside the scene."""
    text = SKY.sub(
        lambda _: "".join(map(_emitter, scene.description.lights.values())), file.read_text(encoding="utf-8")
    )
    for pattern, replacement in MENDS:
        text = re.sub(pattern, replacement, text)
    for entry in file.resolve().parent.iterdir():
        if entry.suffix != ".xml":
            (folder / entry.name).symlink_to(entry)
    copy = folder / file.name
    copy.write_text(text, encoding="utf-8")
    return copy


def _emitter(light: ParsedParams) -> str:
    """Return a sky as XML; others stand in the file as they are."""
    if light.name != "sky":
        return ""
    matrix = " ".join(f"{value:.9g}" for value in sky_pose(light.values).ravel())
    inner = [f'<transform name="to_world"><matrix value="{matrix}"/></transform>']
    for name, value in {**sky_values(light.values), "albedo": light["albedo"]}.items():
        if name == "type":
            continue
        tag = {"sun_direction": "vector", "albedo": "rgb", "complex_sun": "boolean"}.get(name, "float")
        text = " ".join(map(repr, value)) if isinstance(value, list | tuple) else str(value).lower()
        inner.append(f'<{tag} name="{name}" value="{text}"/>')
    return f'<emitter type="sunsky">{"".join(inner)}</emitter>'


def blocks(image: np.ndarray) -> np.ndarray:
    """Return the means of blocks of a picture ``(H, W, 3)``, those at the right and lower edge left out."""
    rows, columns = (side // BLOCK for side in image.shape[:2])
    cut = image[: rows * BLOCK, : columns * BLOCK].mean(2)
    return cut.reshape(rows, BLOCK, columns, BLOCK).mean((1, 3))


def compare(mitsuba: Any, file: Path, given: argparse.Namespace) -> tuple[dict[str, Any], Any]:
    """Render a scene by both programs; return the row of the table and the two mean pictures."""
    width, spp, seeds = given.width, given.spp, given.seeds
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ImportedSceneWarning)
        scene = torchpt.load(str(file))
        rough = [name for name, m in scene.description.materials.items() if m.name == "roughdiffuse"]
        if rough:
            scene = torchpt.load(str(file), overrides={f"materials.{name}.alpha": 0.0 for name in rough})
    loaded = time.perf_counter() - start
    old = scene.description.film
    film = {"width": width, "height": max(1, round(width * old["height"] / old["width"])), "filter": "box"}
    limit = given.depth or scene.description.integrator.get("max_depth", -1)
    integrator = {"type": "path", "max_depth": limit, "rr_depth": 5, "dark_rims": True}
    options: dict[str, Any] = {"film": film, "integrator": integrator}
    options["accel"] = given.accel
    torchpt.render(scene, spp=1, seed=0, **options)
    first = time.perf_counter() - start
    ours, seconds = _rendered(lambda seed: torchpt.render(scene, spp=spp, seed=seed, **options).numpy(), seeds)

    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        peer = mitsuba.load_file(str(mended(file, Path(folder), scene)))
        sensor = _sensor(mitsuba, peer, film)
        integrator = mitsuba.load_dict({"type": "path", "max_depth": limit, "rr_depth": 5})

        def render(seed: int, count: int = spp) -> np.ndarray:
            return np.array(mitsuba.render(peer, sensor=sensor, integrator=integrator, spp=count, seed=seed))[..., :3]

        peer_loaded = time.perf_counter() - start
        render(0, 1)
        peer_first = time.perf_counter() - start
        theirs, peer_seconds = _rendered(lambda seed: render(1000 + seed), seeds)
    means = [np.array([image.mean() for image in images]) for images in (ours, theirs)]
    error = np.sqrt(sum(mean.var(ddof=1) / len(mean) / mean.mean() ** 2 for mean in means))
    squares = [np.array([blocks(image) for image in images]) for images in (ours, theirs)]
    spread = np.sqrt(sum(square.var(0, ddof=1) / len(square) for square in squares))
    apart = np.abs(squares[0].mean(0) - squares[1].mean(0)) > 4.0 * np.maximum(spread, 1e-9)
    row = {
        "scene": f"{file.parent.name}/{file.name}",
        "mean": f"{means[0].mean() / means[1].mean():.4f} +- {error:.4f}",
        "blocks": f"{int(apart.sum())} of {apart.size}",
        "load": f"{loaded:.1f} / {peer_loaded:.1f}",
        "first": f"{first:.1f} / {peer_first:.1f}",
        "paths/s": f"{peer_seconds / seconds:.2f}x",
    }
    return row, (np.mean(ours, 0), np.mean(theirs, 0))


def _rendered(render: Any, seeds: int) -> tuple[list[np.ndarray], float]:
    """Return the pictures of the seeds, and the seconds of the quickest: the first may compile."""
    images, seconds = [], []
    for seed in range(seeds):
        start = time.perf_counter()
        images.append(render(seed))
        seconds.append(time.perf_counter() - start)
    return images, min(seconds)


def _sensor(mitsuba: Any, scene: Any, film: dict[str, Any]) -> Any:
    """Return the scene's camera with another film."""
    parameters = mitsuba.traverse(scene.sensors()[0])
    given = {"type": "hdrfilm", "width": film["width"], "height": film["height"], "rfilter": {"type": "box"}}
    return mitsuba.load_dict(
        {
            "type": "perspective",
            "fov": float(np.array(parameters["x_fov"]).ravel()[0]),
            "to_world": mitsuba.ScalarTransform4f(np.array(parameters["to_world"].matrix, np.float64).reshape(4, 4)),
            "film": given,
            "sampler": {"type": "independent"},
        }
    )


def main() -> int:
    """Compare the scenes of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--spp", type=int, default=128)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--depth", type=int, help="in place of each scene's own")
    parser.add_argument("--accel", default="auto", help="the search structure of ours")
    parser.add_argument("--pictures", type=Path, help="a folder for both mean pictures as PNG")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    given = parser.parse_args()
    mitsuba = load_mitsuba(given.variant)
    for number, file in enumerate(given.scenes):
        row, pictures = compare(mitsuba, file, given)
        if number == 0:
            print("| " + " | ".join(row) + " |\n|" + "---|" * len(row))
        print("| " + " | ".join(row.values()) + " |", flush=True)
        if given.pictures is not None:
            given.pictures.mkdir(exist_ok=True)
            for name, image in zip(("ours", "mitsuba"), pictures, strict=True):
                stem = f"{file.parent.name}_{file.stem}_{name}"
                torchpt.write_image(str(given.pictures / f"{stem}.png"), torch.from_numpy(np.ascontiguousarray(image)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
