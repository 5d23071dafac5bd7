"""A torchpt scene as Mitsuba 3 sees it: the same description, so that numbers match. For references and benchmarks."""

from __future__ import annotations

import ctypes.util
import importlib
import os
from pathlib import Path
from typing import Any

import numpy as np

from torchpt.scene import Scene
from torchpt.scene.parts import Part
from torchpt.scene.settings import Film, PathIntegrator, Settings

__all__ = ["convert", "find_llvm", "load_mitsuba"]


def find_llvm() -> str | None:
    """The LLVM library for ``llvm_ad_rgb``: ``$DRJIT_LIBLLVM_PATH``, else the system's newest, 16 or later."""
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        return given
    for version in range(25, 15, -1):  # older ones abort the process
        for name in (
            f"/usr/lib/x86_64-linux-gnu/libLLVM-{version}.so",
            f"/usr/lib/x86_64-linux-gnu/libLLVM.so.{version}.1",
        ):
            if os.path.exists(name):
                return name
        if found := ctypes.util.find_library(f"LLVM-{version}"):
            return found
    return None


def load_mitsuba(variant: str) -> Any:
    """The module ``mitsuba`` under a variant such as ``scalar_rgb`` or ``llvm_ad_rgb``."""
    if variant.startswith("llvm"):
        library = find_llvm()
        if library is None:
            raise RuntimeError(f"{variant} needs LLVM >= 16; name its library in DRJIT_LIBLLVM_PATH")
        os.environ["DRJIT_LIBLLVM_PATH"] = library
    mitsuba: Any = importlib.import_module("mitsuba")
    mitsuba.set_variant(variant)
    mitsuba.set_log_level(mitsuba.LogLevel.Error)  # its warnings about meshes go to stdout
    return mitsuba


def convert(mitsuba: Any, scene: Scene, settings: Settings, folder: Path) -> dict[str, Any]:
    """Mitsuba's dict of a scene.

    Args:
        mitsuba: the module, with its variant set.
        scene: what; diffuse materials, as all of torchpt's are two-sided here.
        settings: film size, filter and integrator; the sampler is ``independent``.
        folder: where meshes are put as PLY files, from which Mitsuba computes smooth normals itself.
    """
    integrator = settings.integrator
    assert isinstance(integrator, PathIntegrator)
    camera = scene.description.camera
    out: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": integrator.max_depth, "rr_depth": integrator.rr_depth},
        "sensor": {
            "type": "perspective",
            "to_world": _transform(mitsuba, camera.pose()),
            "fov": camera.fov,
            "fov_axis": camera.fov_axis,
            "near_clip": 1e-3,
            "far_clip": 1e7,
            "film": _film(settings.film),
            "sampler": {"type": "independent", "sample_count": settings.render.spp},
        },
    }
    for number, part in enumerate(scene.parts.parts):
        out[f"part{number}"] = _shape(mitsuba, part, folder / f"part{number}.ply")
    if scene.parts.environment is not None:
        radiance = scene.parts.parameters[scene.parts.environment]
        out["environment"] = {"type": "constant", "radiance": _rgb(radiance)}
    return out


def _film(film: Film) -> dict[str, Any]:
    return {
        "type": "hdrfilm",
        "width": film.width,
        "height": film.height,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"} if film.filter.type == "box" else {"type": "gaussian", "stddev": film.filter.stddev},
    }


def _transform(mitsuba: Any, matrix: np.ndarray) -> Any:
    return mitsuba.ScalarTransform4f(np.asarray(matrix, np.float64).tolist())


def _rgb(colour: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(x) for x in colour]}


def _shape(mitsuba: Any, part: Part, file: Path) -> dict[str, Any]:
    lambert = {"type": "diffuse", "reflectance": _rgb(part.material.values["reflectance"])}
    shape: dict[str, Any] = {"bsdf": {"type": "twosided", "material": lambert} if part.material.two_sided else lambert}
    if part.kind == "triangle":
        assert part.vertices is not None and part.faces is not None
        world = part.vertices @ part.to_world[:3, :3].T + part.to_world[:3, 3]
        write_ply(file, world, part.faces)
        shape |= {"type": "ply", "filename": str(file), "face_normals": not part.smooth}
    else:
        shape |= {"type": part.kind, "to_world": _transform(mitsuba, part.to_world)}
    if part.flip:
        shape["flip_normals"] = True
    if part.emission is not None:
        shape["emitter"] = {"type": "area", "radiance": _rgb(part.emission)}
    return shape


def write_ply(file: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """A binary PLY of positions ``(V, 3)`` and triangles ``(F, 3)``."""
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{names}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    rows["n"], rows["v"] = 3, faces
    file.write_bytes(header.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())
