"""Files of a quad whose texture is named only in its mesh file."""

from __future__ import annotations

from pathlib import Path

__all__ = ["repeated", "textured_quad"]

SCENE = """\
camera: {origin: [0, 1, 4], target: [0, 0, 0], fov: 40}
film: {width: 16, height: 12, filter: box}
shapes: {quad: {type: mesh, path: quad.obj}}
lights: {sky: {type: constant, radiance: 1}}
"""
OBJ = """\
mtllib quad.mtl
usemtl a
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 2 0
vt 2 2
vt 0 2
f 1/1 2/2 3/3 4/4
"""


def textured_quad(folder: Path) -> Path:
    """Write the scene file and the files that it names; return the path of the scene file."""
    texels = " ".join(str((37 * k) % 256) for k in range(16 * 16 * 3))
    (folder / "quad.ppm").write_text(f"P3\n16 16\n255\n{texels}\n")
    (folder / "quad.obj").write_text(OBJ)
    (folder / "quad.yaml").write_text(SCENE)
    repeated(folder, 1)
    return folder / "quad.yaml"


def repeated(folder: Path, times: int) -> None:
    """Write the material file, which repeats the texture `times` times along each axis."""
    (folder / "quad.mtl").write_text(f"newmtl a\nmap_Kd -s {times} {times} 1 quad.ppm\n")
