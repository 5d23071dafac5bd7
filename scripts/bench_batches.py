"""Compare torchpt's batches of many small pictures with loops over Mitsuba's ``llvm_ad_rgb``.

    python scripts/bench_batches.py [--rounds 5] [--threads 2] [--json figures.json]

Scenes: a closed room of 30 rectangles in which a ball and a bumpy mesh of 5,000 triangles move from picture to picture. Each is
loaded and its trees are built each time: by ``torchpt.load`` from a mapping, by ``mitsuba.load_dict`` from a dict whose mesh is
a ``mitsuba.Mesh`` of arrays. ``moved`` renders one loaded torchpt scene with changed parameters. Cameras: one such scene
from several poses. Gradients: scenes as above, of the mean square of each picture by the colour of a paint (Mitsuba: ``prb``).

All contenders share a process and take turns. Figures are medians over rounds, of pictures a second by wall time and by the
process's CPU time (all threads); ratios are medians of the ratios within a round. Both sides start from mappings in memory and
return pictures as arrays. Kernels compile before the first round.
"""

from __future__ import annotations

import argparse
import importlib
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchpt

DEPTH, RR_DEPTH = 8, 5
#: The paint whose colour is differentiated.
PAINT = "white"
OURS, MOVED, THEIRS = "torchpt", "torchpt, moved", "llvm_ad_rgb"
COLOURS = {"white": [0.7, 0.7, 0.7], "red": [0.6, 0.06, 0.05], "green": [0.1, 0.5, 0.1]}


def bumpy_ball(rows: int = 50, columns: int = 51) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh of about 5,000 triangles: vertices ``(V, 3)`` float32 and faces ``(F, 3)``."""
    theta = np.linspace(0.0, np.pi, rows + 1)[:, None]
    phi = np.linspace(0.0, 2.0 * np.pi, columns, endpoint=False)[None]
    r = 1.0 + 0.1 * np.sin(5.0 * theta) * np.sin(4.0 * phi)
    x, y, z = r * np.sin(theta) * np.cos(phi), r * np.cos(theta), r * np.sin(theta) * np.sin(phi)
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    faces = np.stack([a, b, b + columns, a, b + columns, a + columns], -1).reshape(-1, 3)
    return np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32), faces


def turned(axis: list[int], degrees: float) -> dict[str, Any]:
    """Return a rotation in the form that scene files use."""
    return {"rotate": {"axis": axis, "angle": degrees}}


def places(k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of ball and mesh in scene ``k``."""
    t = 0.1 * k
    return np.array([0.8 * np.cos(t), -0.6, 0.8 * np.sin(t)]), np.array([-0.8 * np.cos(t), -0.2, -0.8 * np.sin(t)])


def room(k: int, size: int, spp: int, mesh: tuple[np.ndarray, np.ndarray]) -> dict[str, Any]:
    """Return scene ``k`` as a mapping for ``torchpt.load``."""
    shapes: dict[str, Any] = {}

    def rectangle(name: str, turns: list[Any], move: list[float], scale: float, **more: Any) -> None:
        shapes[name] = {"type": "rectangle", "transform": [{"scale": scale}, *turns, {"translate": move}], **more}

    rectangle("floor", [turned([1, 0, 0], -90)], [0, -1, 0], 2, material="white")
    rectangle("ceiling", [turned([1, 0, 0], 90)], [0, 1, 0], 2, material="white")
    rectangle("back", [], [0, 0, -2], 2, material="white")
    rectangle("front", [turned([0, 1, 0], 180)], [0, 0, 2], 2, material="white")
    rectangle("left", [turned([0, 1, 0], 90)], [-2, 0, 0], 2, material="red")
    rectangle("right", [turned([0, 1, 0], -90)], [2, 0, 0], 2, material="green")
    rectangle("lamp", [turned([1, 0, 0], 90)], [0, 0.99, 0], 0.4, material="white", emission=[8, 8, 8])
    for i in range(23):
        a = 2.0 * np.pi * i / 23
        where = [float(-1.7 * np.sin(a)), -0.6 + 0.05 * i, float(-1.7 * np.cos(a))]
        rectangle(f"panel{i}", [turned([0, 1, 0], float(np.degrees(a)))], where, 0.15, material=list(COLOURS)[i % 3])
    ball, lump = places(k)
    shapes["ball"] = {"type": "sphere", "center": ball.tolist(), "radius": 0.4, "material": "white"}
    vertices = (0.4 * mesh[0] + lump).astype(np.float32)
    shapes["lump"] = {"type": "mesh", "vertices": vertices, "faces": mesh[1], "face_normals": True, "material": "red"}
    return {
        "camera": {"type": "perspective", "origin": [0, 0.3, 1.8], "target": [0, -0.2, 0], "fov": 70},
        "film": {"width": size, "height": size, "filter": "box"},
        "integrator": {"type": "path", "max_depth": DEPTH, "rr_depth": RR_DEPTH},
        "render": {"spp": spp},
        "materials": {name: {"type": "diffuse", "reflectance": rgb} for name, rgb in COLOURS.items()},
        "shapes": shapes,
    }


def poses(count: int) -> list[np.ndarray]:
    """Return camera poses ``(4, 4)``: x to the left, y up and z ahead to the scene."""
    found = []
    for k in range(count):
        origin = np.array([0.6 * np.sin(0.2 * k), 0.3, 1.5 + 0.2 * np.cos(0.2 * k)])
        ahead = np.array([0.0, -0.2, 0.0]) - origin
        ahead /= np.linalg.norm(ahead)
        left = np.cross([0.0, 1.0, 0.0], ahead)
        left /= np.linalg.norm(left)
        pose = np.eye(4)
        pose[:3] = np.stack([left, np.cross(ahead, left), ahead, origin], 1)
        found.append(pose)
    return found


def matrix(steps: list[dict[str, Any]]) -> np.ndarray:
    """Return the matrix of a list of transforms."""
    from torchpt.math.transforms import compose

    return compose(steps)


def theirs(mi: Any, given: dict[str, Any]) -> dict[str, Any]:
    """Return a scene as Mitsuba's dict, without its mesh."""
    camera, film = given["camera"], given["film"]
    look = mi.ScalarTransform4f().look_at(camera["origin"], camera["target"], [0, 1, 0])
    made: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": DEPTH, "rr_depth": RR_DEPTH},
        "sensor": {
            "type": "perspective",
            "fov": camera["fov"],
            "to_world": look,
            "film": {
                "type": "hdrfilm",
                "width": film["width"],
                "height": film["height"],
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
            },
            "sampler": {"type": "independent", "sample_count": given["render"]["spp"]},
        },
    }
    for name, rgb in COLOURS.items():
        made[name] = two_sided(rgb)
    for name, shape in given["shapes"].items():
        if shape["type"] == "mesh":
            continue
        own = {key: shape[key] for key in ("type", "center", "radius") if key in shape}
        if "transform" in shape:
            own["to_world"] = mi.ScalarTransform4f(matrix(shape["transform"]))
        if "material" in shape:
            own["bsdf"] = {"type": "ref", "id": shape["material"]}
        if "emission" in shape:
            own["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": shape["emission"]}}
        made[name] = own
    return made


def two_sided(rgb: list[float]) -> dict[str, Any]:
    """Return a two-sided diffuse material."""
    return {"type": "twosided", "own": {"type": "diffuse", "reflectance": {"type": "rgb", "value": rgb}}}


def mitsuba(arguments: argparse.Namespace, scenes: list[dict[str, Any]]) -> dict[str, Callable[[], np.ndarray]]:
    """Return Mitsuba's loops over scenes and over cameras; each renders all pictures."""
    from mitsuba_scene import load_mitsuba

    mi = load_mitsuba(THEIRS)
    importlib.import_module("drjit").set_thread_count(arguments.threads)
    red = mi.Properties()
    red["bsdf"] = mi.load_dict(two_sided(COLOURS["red"]))
    given = [theirs(mi, scene) for scene in scenes]
    arrays = [
        (s["shapes"]["lump"]["vertices"].ravel(), s["shapes"]["lump"]["faces"].astype(np.uint32).ravel())
        for s in scenes
    ]

    def loaded(k: int) -> Any:
        mesh = mi.Mesh("lump", len(arrays[k][0]) // 3, len(arrays[k][1]) // 3, props=red)
        values = mi.traverse(mesh)
        values["vertex_positions"], values["faces"] = arrays[k]
        values.update()
        return mi.load_dict({**given[k], "lump": mesh})

    def over_scenes() -> np.ndarray:
        return np.stack([np.asarray(mi.render(loaded(k), spp=arguments.spp, seed=k)) for k in range(len(given))])

    one = loaded(0)
    views = [mi.load_dict({**given[0]["sensor"], "to_world": mi.ScalarTransform4f(pose)}) for pose in poses(len(given))]

    def over_cameras() -> np.ndarray:
        return np.stack(
            [np.asarray(mi.render(one, sensor=view, spp=arguments.spp, seed=k)) for k, view in enumerate(views)]
        )

    dr = importlib.import_module("drjit")
    backward = mi.load_dict({"type": "prb", "max_depth": DEPTH, "rr_depth": RR_DEPTH})

    def gradients() -> np.ndarray:
        found = []
        for k in range(len(given)):
            scene = loaded(k)
            params = mi.traverse(scene)
            (name,) = (
                key for key in params.keys() if key.startswith(f"{PAINT}.") and key.endswith("reflectance.value")
            )
            dr.enable_grad(params[name])
            image = mi.render(scene, params, integrator=backward, spp=arguments.spp, seed=k)
            dr.backward(dr.mean(dr.square(image), axis=None))
            found.append(np.asarray(dr.grad(params[name])).ravel())
        return np.stack(found)

    return {"scenes": over_scenes, "cameras": over_cameras, "gradients": gradients}


def ours(
    arguments: argparse.Namespace, scenes: list[dict[str, Any]], mesh: tuple[np.ndarray, np.ndarray]
) -> dict[str, dict[str, Callable[[], np.ndarray]]]:
    """Return torchpt's batches over loaded scenes, over parameters and over cameras; each renders all pictures."""
    one, wishes, count = torchpt.load(scenes[0]), {"threads": arguments.threads}, len(scenes)
    pose = one.params["shapes.ball.to_world"]

    def over_scenes() -> np.ndarray:
        return torchpt.render_batch(
            (torchpt.load(scene) for scene in scenes), seed=list(range(count)), **wishes
        ).numpy()

    def over_parameters() -> np.ndarray:
        balls = pose.repeat(count, 1, 1)
        vertices = []
        for k in range(count):
            ball, lump = places(k)
            balls[k, :3, 3] = torch.from_numpy(ball)
            vertices.append(torch.from_numpy((0.4 * mesh[0] + lump).astype(np.float32)))
        moved = {"shapes.ball.to_world": balls, "shapes.lump.vertices": torch.stack(vertices)}
        return torchpt.render_batch(one, params=moved, seed=list(range(count)), **wishes).numpy()

    views = torch.from_numpy(np.stack(poses(count))).float()

    def over_cameras() -> np.ndarray:
        return torchpt.render_batch(one, views, seed=[list(range(count))], **wishes).numpy()

    def gradients() -> np.ndarray:
        name = f"materials.{PAINT}.reflectance"
        colours = torch.tensor([COLOURS[PAINT]] * count, requires_grad=True)
        loaded = (torchpt.load(scene) for scene in scenes)
        images = torchpt.render_batch(loaded, params={name: colours}, seed=list(range(count)), **wishes)
        images.square().mean((1, 2, 3, 4)).sum().backward()
        assert colours.grad is not None
        return colours.grad.numpy()

    return {
        "scenes": {OURS: over_scenes, MOVED: over_parameters},
        "cameras": {OURS: over_cameras},
        "gradients": {OURS: gradients},
    }


def measured(
    contenders: dict[str, Callable[[], np.ndarray]], rounds: int, count: int
) -> dict[str, list[dict[str, float]]]:
    """Measure pictures a second in each round, by wall and CPU time; the order of the contenders rotates."""
    found: dict[str, list[dict[str, float]]] = {name: [] for name in contenders}
    for shoot in contenders.values():
        shoot()
    names = list(contenders)
    for turn in range(rounds):
        for name in names[turn % len(names) :] + names[: turn % len(names)]:
            wall, cpu = time.perf_counter(), time.process_time()
            pictures = contenders[name]()
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            found[name].append({"wall": count / wall, "cpu": count / cpu, "mean": float(pictures.mean())})
    return found


def main() -> None:
    """Print all tables, and write all figures to the JSON file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--count", type=int, default=64, help="pictures of a batch")
    parser.add_argument("--size", type=int, default=64, help="of a picture in pixels")
    parser.add_argument("--spp", type=int, default=4)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--only", choices=("scenes", "cameras", "gradients"), help="one of the contests")
    parser.add_argument("--alone", action="store_true", help="without Mitsuba")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    mesh = bumpy_ball()
    scenes = [room(k, arguments.size, arguments.spp, mesh) for k in range(arguments.count)]
    contests = ours(arguments, scenes, mesh)
    if not arguments.alone:
        for name, shoot in mitsuba(arguments, scenes).items():
            contests[name][THEIRS] = shoot
    if arguments.only:
        contests = {arguments.only: contests[arguments.only]}
    figures = {name: measured(contest, arguments.rounds, arguments.count) for name, contest in contests.items()}
    for contest, rows in figures.items():
        for name, turns in rows.items():
            medians = {key: statistics.median(turn[key] for turn in turns) for key in ("wall", "cpu", "mean")}
            line = f"{contest:9} {name:15} {medians['wall']:7.1f}/s  {medians['cpu']:7.1f}/s of CPU  mean {medians['mean']:.4f}"
            if THEIRS in rows and name != THEIRS:
                pairs = list(zip(turns, rows[THEIRS], strict=True))
                ratios = {key: statistics.median(a[key] / b[key] for a, b in pairs) for key in ("wall", "cpu")}
                line += f"  x {ratios['wall']:.2f} by wall, x {ratios['cpu']:.2f} by CPU time"
            print(line)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
