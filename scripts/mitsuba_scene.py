"""Convert a torchpt scene to Mitsuba 3 such that both render the same picture. For references and benchmarks.

Opaque materials are ``twosided``, meshes have torchpt's own shading normals. Mitsuba counts light that
passes an opacity or ``null`` as a bounce, torchpt does not: scenes with such surfaces need a large ``max_depth``.

:func:`comparable` leaves out what Mitsuba cannot express; :func:`nearest` replaces it in the description, which both
renderers then use.
"""

from __future__ import annotations

import ctypes.util
import importlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchpt
from torchpt.math.vectors import cross, dot, luminance
from torchpt.physics.bsdfs import KINDS, Bsdf
from torchpt.physics.bsdfs.metal import by_reflectance
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.lights.kinds.sky import direction_of, sky_angles, sky_turn
from torchpt.physics.parts import Part, Source
from torchpt.physics.shapes import KINDS as SHAPES
from torchpt.physics.shapes import Shape
from torchpt.physics.textures import Node
from torchpt.physics.textures.atlas import ImageNode
from torchpt.scene import Scene
from torchpt.scene.formats.description import Description, read_description
from torchpt.scene.formats.materials import inner_of, read_material
from torchpt.scene.formats.textures import TextureInput
from torchpt.scene.settings import Film, Settings
from torchpt.scene.space import Space
from torchpt.scene.world import corners_of
from torchpt.spec.schema import ParsedParams, read_params

__all__ = [
    "NoCounterpartError", "bsdf", "comparable", "convert", "find_llvm", "lets_pass", "load_mitsuba", "nearest",
    "replacements", "sensor", "sky_pose", "sky_values",
]  # fmt: skip

#: Models with the same parameters in both renderers; microfacet models become smooth below ``LEAST_ALPHA``.
SHARED = ("diffuse", "conductor", "dielectric", "thindielectric", "plastic", "principled", "null")
SMOOTH = {"roughconductor": "conductor", "roughdielectric": "dielectric", "roughplastic": "plastic"}
#: Below this alpha torchpt's rough models are mirrors.
LEAST_ALPHA = 1e-4
#: Number of sides of the mesh that replaces a cone.
SIDES = 128
#: Largest reflectance at normal incidence for which an index or a metal is computed.
MOST_REFLECTANCE = 0.98


class NoCounterpartError(ValueError):
    """A material or camera that Mitsuba cannot express."""


def find_llvm() -> str | None:
    """Find the LLVM library for ``llvm_ad_rgb``: ``$DRJIT_LIBLLVM_PATH``, else the system's newest, 16 or later."""
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        return given
    for version in range(25, 15, -1):  # older ones abort the process: 15 has no fmaximum for AVX-512
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
    """Import ``mitsuba`` and set its variant, such as ``scalar_rgb`` or ``llvm_ad_rgb``."""
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
    """Convert a scene to Mitsuba's dict.

    Args:
        mitsuba: the module, with its variant set.
        scene: the scene to convert.
        settings: film size, filter and integrator; the sampler is ``independent``.
        folder: folder in which meshes are written as PLY files.

    Raises:
        NoCounterpartError: a material or camera that Mitsuba cannot express.
    """
    integrator = settings.integrator
    assert integrator.name == "path"
    if scene.built.copies:
        raise NoCounterpartError(f"{scene.built.copies[0].name}: instances are not converted")
    out: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": integrator.max_depth, "rr_depth": integrator.rr_depth},
        "sensor": {
            **sensor(mitsuba, scene.description.camera),
            "film": _film(settings.film),
            "sampler": {"type": "independent", "sample_count": settings.render.spp},
        },
    }
    for number, part in enumerate(scene.built.parts):
        out[f"part{number}"] = _shape(mitsuba, scene, part, folder / f"part{number}.ply")
    for source in scene.built.sources:
        out[source.name.replace(".", "_")] = _source(mitsuba, scene, source)
    return out


def _source(mitsuba: Any, scene: Scene, source: Source) -> dict[str, Any]:
    """Return Mitsuba's dict of a light that is not a surface."""
    if source.kind == "envmap":
        texels, scale, pose = (scene.params[f"{source.name}.{key}"] for key in ("texels", "scale", "to_world"))
        linear = pose[:3, :3].double().cpu().numpy()
        turn = np.eye(4)
        turn[:3, :3] = linear / np.cbrt(abs(np.linalg.det(linear)))
        picture = mitsuba.Bitmap(np.ascontiguousarray(texels.cpu().numpy()))
        return {"type": "envmap", "bitmap": picture, "scale": float(scale), "to_world": mitsuba.ScalarTransform4f(turn)}
    name = source.name.removeprefix("lights.")
    given = scene.description.lights[name].values
    if source.kind == "sky":
        return {**sky_values(given), "to_world": _transform(mitsuba, sky_pose(given)), "albedo": _rgb(given["albedo"])}
    found: dict[str, Any] = {"type": source.kind}
    for key, value in given.items():
        if key in ("intensity", "irradiance", "radiance"):
            found[key] = _rgb(value)
        elif key in ("position", "target"):
            found[key] = list(value)
        else:
            found[key] = list(value) if key == "direction" else value
    if source.kind == "spot":
        origin, target = found.pop("position"), found.pop("target")
        along = np.subtract(target, origin)
        up = [1.0, 0.0, 0.0] if abs(along[0]) < 0.9 * np.linalg.norm(along) else [0.0, 1.0, 0.0]
        found["to_world"] = mitsuba.ScalarTransform4f().look_at(origin=origin, target=target, up=up)
    return found


def sky_values(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return Mitsuba's ``sunsky`` of the light ``sky``, without ``to_world`` and ``albedo``.

    Raises:
        NoCounterpartError: a sky that is stretched.
    """
    if given["stretch"] != 1.0:
        raise NoCounterpartError("Mitsuba's sky is not stretched")
    to_sun = np.linalg.inv(sky_turn(given)) @ direction_of(*sky_angles(given))
    scales = {key: given[key] for key in ("turbidity", "sky_scale", "sun_scale", "sun_aperture")}
    return {"type": "sunsky", "sun_direction": to_sun.tolist(), "complex_sun": True, **scales}


def sky_pose(given: Mapping[str, Any]) -> np.ndarray:
    """Return the pose ``(4, 4)`` of Mitsuba's ``sunsky``, whose up is z, of the light ``sky``."""
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.inv(sky_turn(given)) @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    return pose


def sensor(mitsuba: Any, camera: ParsedParams) -> dict[str, Any]:
    """Return Mitsuba's dict of a camera, without film and sampler.

    Raises:
        NoCounterpartError: an aperture with blades, pixels that are not square, or a shifted lens.
    """
    given = {key: value for key, value in camera.values.items() if value is not None}
    pose = given["to_world"]
    if camera.name == "orthographic":  # its film is [-1, 1] wide, and sized by the pose
        pose = pose @ np.diag([0.5 * given["width"], 0.5 * given["width"], 1.0, 1.0])
    if camera.kind.lens and (given["blades"] or not given["aperture_radius"]):
        raise NoCounterpartError("camera: Mitsuba's lens is round, and has a size")
    offsets = [key for key in given if key.startswith("principal_point")]
    if "pixel_aspect" in given or (camera.kind.lens and offsets):
        raise NoCounterpartError("camera: Mitsuba's pixels are squares, and its lens is in the middle")
    keys = ("fov", "fov_axis", *offsets, "aperture_radius", "focus_distance")
    found = {"type": camera.name, **{key: given[key] for key in keys if key in given}}
    return {**found, "to_world": _transform(mitsuba, pose), "near_clip": 1e-3, "far_clip": 1e7}


def comparable(name: str) -> Scene:
    """Load a scene of ``configs/scene`` without what Mitsuba cannot express, and without optional meshes."""
    scene = torchpt.load(name, device="cpu")
    lacking = {shape for shape, value in scene.description.shapes.items() if len(value.values.get("path") or ()) > 1}
    for part in scene.built.parts:
        try:
            _kind(part)
            bsdf(part.material, lambda _: {})
        except NoCounterpartError:
            lacking.add(part.shape)
    if not lacking:
        return scene
    shapes = {shape: value for shape, value in scene.description.shapes.items() if shape not in lacking}
    return Scene(replace(scene.description, shapes=shapes), scene.device)


def nearest(scene: Scene | str) -> Scene:
    """Load a scene with the nearest equivalent, for both renderers, of everything that Mitsuba cannot express.

    :func:`replacements` lists them; anything else still raises :class:`NoCounterpartError` in :func:`convert`.
    """
    loaded = torchpt.load(scene, device="cpu") if isinstance(scene, str) else scene
    changed, said = _replaced(loaded.description)
    return Scene(changed, loaded.device) if said else loaded


def replacements(scene: Scene | str) -> dict[str, str]:
    """Return the replacements that :func:`nearest` makes, as text by dotted name."""
    return _replaced(read_description(scene) if isinstance(scene, str) else scene.description)[1]


def _replaced(description: Description) -> tuple[Description, dict[str, str]]:
    found, shapes = _Nearest(), description.shapes
    changed = replace(
        description,
        camera=found.camera(description.camera),
        materials={name: found.material(f"materials.{name}", value) for name, value in description.materials.items()},
        shapes={name: found.shape(f"shapes.{name}", value, shapes) for name, value in shapes.items()},
    )
    return changed, found.said


def lets_pass(scene: Scene) -> bool:
    """Return True if light passes a surface of the scene undeflected, which Mitsuba counts as a bounce."""
    slots = [slot for part in scene.built.parts for slot in part.material.with_inner()]
    return any(slot.model.name == "null" or slot.opacity != 1.0 for slot in slots)


class _Nearest:
    """Replaces the parts of a description that Mitsuba lacks.

    Attributes:
        said: the replacements as text, by dotted name.
    """

    def __init__(self) -> None:
        self.said: dict[str, str] = {}

    def camera(self, camera: ParsedParams) -> ParsedParams:
        """Replace an aperture with blades by a round one."""
        blades = camera.values.get("blades")
        if not blades:
            return camera
        self.said["camera"] = f"an aperture of {blades} blades is round"
        return replace(camera, values={**camera.values, "blades": 0})

    def shape(self, name: str, shape: ParsedParams, shapes: Mapping[str, ParsedParams]) -> ParsedParams:
        """Replace a cone, or an instance, by a mesh."""
        if shape.name == "cone":
            self.said[name] = f"cone is a mesh of {SIDES} sides with smooth normals"
            shape = _cone(shape)
        elif shape.name == "instance" and (mesh := shapes.get(shape["of"])) is not None and mesh.kind.meshed:
            self.said[name] = f"instance is a copy of {shape['of']}"
            own = {"transform": shape["transform"], "flip_normals": shape["flip_normals"], "emission": None}
            material = shape["material"] or mesh["material"]
            shape = replace(mesh, values={**mesh.values, **own, "material": material})
        if isinstance(shape["material"], ParsedParams):
            material = self.material(f"{name}.material", shape["material"])
            shape = replace(shape, values={**shape.values, "material": material})
        return shape

    def material(self, name: str, material: ParsedParams) -> ParsedParams:
        """Replace a material whose model Mitsuba lacks by one with the same highlight and base."""
        inner = {
            side: self.material(f"{name}.{side}", item) if isinstance(item, ParsedParams) else item
            for side, item in inner_of(material).items()
        }
        if inner:
            return _with(material, **inner)
        if isinstance(material["opacity"], TextureInput) and material["alpha_cutoff"] is not None:
            self.said[f"{name}.alpha_cutoff"] = "cutoff left out: opacity is coverage"
            material = _with(material, alpha_cutoff=None)
        if material.values.get("energy_compensation"):
            self.said[f"{name}.energy_compensation"] = "left out"
            material = _with(material, energy_compensation=False)
        if "conductor" in material.name and by_reflectance(material.values) and material["reflectance"] is not None:
            return self._metal(name, material, _numbers(name, material["reflectance"]))
        coat = _coat(name, material)
        if coat is None:
            return material
        base, reflectance, alpha, tint = coat
        root = math.sqrt(min(reflectance, MOST_REFLECTANCE))
        index = (1.0 + root) / (1.0 - root)
        self.said[name] = f"{material.name} is roughplastic of int_ior {index:.3g}, alpha {alpha:.3g}"
        plastic = read_material(
            {"type": "roughplastic", "int_ior": index, "ext_ior": 1.0, "alpha": alpha}, name, KINDS, None
        )
        common = {key: material[key] for key in Bsdf.parameters}
        return _with(plastic, **common, diffuse_reflectance=base, specular_reflectance=tint)

    def _metal(self, name: str, material: ParsedParams, reflectance: tuple[float, ...]) -> ParsedParams:
        """Return index 1 and the absorption that gives the same reflectance at normal incidence."""
        if reflectance == (1.0, 1.0, 1.0):
            return material
        self.said[name] = "metal by its reflectance has eta 1 and k of the same reflectance"
        k = tuple(2.0 * math.sqrt(r / (1.0 - r)) for r in (min(r, MOST_REFLECTANCE) for r in reflectance))
        return _with(material, material=None, reflectance=None, eta=(1.0, 1.0, 1.0), k=k)


def _with(read_typed: ParsedParams, /, **values: Any) -> ParsedParams:
    """Return a copy with other values."""
    return replace(read_typed, values={**read_typed.values, **values})


def _coat(name: str, material: ParsedParams) -> tuple[Any, float, float, Any] | None:
    """Return base, normal reflectance, alpha and tint of a coated model that Mitsuba lacks; None for other models.

    ``(h . n)^n`` is as wide as GGX with ``alpha^2 = 2 / (n + 2)`` (Walter et al. 2007); the lobe about the mirror direction
    is as wide as one of four times its exponent about the half vector.
    """
    if material.name in ("phong", "blinn_phong"):
        blinn = material.name == "blinn_phong"
        (exponent,) = _numbers(name, material["exponent"])
        specular = sum(_numbers(name, material["specular"])) / 3.0
        alpha = math.sqrt(2.0 / ((exponent if blinn else 4.0 * exponent) + 2.0))
        return material["diffuse"], (4.0 if blinn else 1.0) * specular, alpha, None
    if material.name == "nonmetal":
        ((specular,), (roughness,)) = _numbers(name, material["specular"]), _numbers(name, material["roughness"])
        return material["base_color"], specular, max(roughness**2, LEAST_ALPHA), None
    if material.name == "microfacet":
        ((index,), (roughness,)) = _numbers(name, material["ior"]), _numbers(name, material["roughness"])
        reflectance = ((index - 1.0) / (index + 1.0)) ** 2
        return material["diffuse"], reflectance, max(roughness**2, LEAST_ALPHA), material["specular"]
    return None


def _numbers(name: str, value: Any) -> tuple[float, ...]:
    if isinstance(value, TextureInput):
        raise NoCounterpartError(f"{name}: a texture where its nearest takes a number")
    return value if isinstance(value, tuple) else (value,)


def _cone(cone: ParsedParams) -> ParsedParams:
    """Return a mesh of a cone: its side with the cone's own normals, and its base."""
    angles = 2.0 * np.pi * np.arange(SIDES) / SIDES
    none, one = np.zeros(SIDES), np.ones(SIDES)
    ring, tips = np.stack((np.cos(angles), np.sin(angles), none)), np.stack((none, none, one))
    # Every side has a tip of its own, whose normal is that of its middle.
    slanted = [np.stack((np.cos(a), np.sin(a), one)) for a in (angles, angles + np.pi / SIDES)]
    here = np.arange(SIDES)
    after = (here + 1) % SIDES
    points, normals, faces = [ring, tips], slanted, [np.stack((here, after, here + SIDES))]
    if cone["capped"]:  # by corners that face down, around a centre
        points, normals = [*points, ring, np.zeros((3, 1))], [*normals, -tips, -tips[:, :1]]
        faces.append(np.stack((after + 2 * SIDES, here + 2 * SIDES, np.full(SIDES, 3 * SIDES))))
    own = cone.kind.own(cone.values)
    across = np.linalg.inv(own[:3, :3]).T @ np.concatenate(normals, 1)
    mesh = {
        "vertices": (own[:3, :3] @ np.concatenate(points, 1) + own[:3, 3:]).T,
        "normals": (across / np.linalg.norm(across, axis=0)).T,
        "faces": np.concatenate(faces, 1).T,
    }
    made = read_params(SHAPES["mesh"], mesh, "", None)
    return replace(made, values=made.values | {key: cone[key] for key in Shape.parameters})


def _film(film: Film) -> dict[str, Any]:
    return {
        "type": "hdrfilm",
        "width": film.width,
        "height": film.height,
        **_crop(film),
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": _rfilter(film.filter),
    }


def _crop(film: Film) -> dict[str, int]:
    if film.crop is None:
        return {}
    return dict(zip(("crop_offset_x", "crop_offset_y", "crop_width", "crop_height"), film.crop, strict=True))


def _rfilter(filter: Any) -> dict[str, Any]:
    # Mitsuba's gaussian has no radius of its own: it is four deviations, as ours is where none is given.
    own = {key: value for key, value in filter.values.items() if key != "radius" or filter.name == "tent"}
    return {"type": filter.name, **own}


def _transform(mitsuba: Any, matrix: np.ndarray) -> Any:
    return mitsuba.ScalarTransform4f(np.asarray(matrix, np.float64).tolist())


def _rgb(colour: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(x) for x in colour]}


def _shape(mitsuba: Any, scene: Scene, part: Part, file: Path) -> dict[str, Any]:
    if part.emission_texture is not None:
        raise NoCounterpartError(f"{part.name}: emission by a texture is not converted")
    if part.emission is not None and _passing(part.material) != 1.0:
        raise NoCounterpartError(f"{part.name}: Mitsuba's lights shine in full whatever their opacity")
    shape: dict[str, Any] = {"bsdf": bsdf(part.material, lambda node: _bitmap(mitsuba, scene, node))}
    if part.kind == "triangle":
        mapped = part.material.normal_map is not None or part.material.bump_map is not None
        if part.uvs is None and (part.material.model.anisotropic or mapped):
            raise NoCounterpartError(f"{part.name}: anisotropic, and no uv to agree on a tangent")
        _write_part(file, scene, part)
        shape |= {"type": "ply", "filename": str(file), "face_normals": not part.smooth}
    else:
        shape |= {"type": _kind(part), "to_world": _transform(mitsuba, part.to_world)}
    if part.flip:
        shape["flip_normals"] = True
    if part.emission is not None:
        strength = part.material.emission_strength if len(part.emission_names) > 1 else 1.0
        shape["emitter"] = {"type": "area", "radiance": _rgb(strength * np.array(part.emission))}
    return shape


def _kind(part: Part) -> str:
    """Return Mitsuba's name for the shape type of a part."""
    name = part.kind if part.quadric is None else part.quadric.name
    if part.quadric is not None and name != "cylinder":
        raise NoCounterpartError(f"{part.name}: Mitsuba has no {name}")
    return name


def _bitmap(mitsuba: Any, scene: Scene, node: Node) -> dict[str, Any]:
    """Return Mitsuba's dict of a texture."""
    if not isinstance(node, ImageNode):
        raise NoCounterpartError("a texture that is no image is not converted")
    if node.filtered:
        raise NoCounterpartError(f"{node.texels}: Mitsuba does not filter textures over a pixel")
    image = node.image(scene.params).detach()
    if node.channel is None:
        image = image[..., :3] if image.shape[2] >= 3 else image[..., :1].expand(-1, -1, 3)
        image = image * torch.tensor(node.scale)
    else:
        channel = image[..., node.channel] if node.channel >= 0 else luminance(image.movedim(-1, 0))
        image = channel[..., None] * node.scale[0]
    return {
        "type": "bitmap",
        "bitmap": mitsuba.Bitmap(np.ascontiguousarray(image.numpy(), np.float32)),
        "raw": True,
        "wrap_mode": node.wrap,
        "filter_type": "nearest" if node.nearest else "bilinear",
        "to_uv": mitsuba.ScalarTransform3f([*map(list, node.transform), [0.0, 0.0, 1.0]]),
    }


def _refuse(node: Node) -> dict[str, Any]:
    raise NoCounterpartError("a texture, and no scene to take it from")


Opened = Callable[[Node], dict[str, Any]]


def bsdf(slot: ResolvedMaterial, opened: Opened = _refuse) -> dict[str, Any]:
    """Return Mitsuba's dict of a material.

    Args:
        slot: the material.
        opened: returns Mitsuba's texture for a texture.

    Raises:
        NoCounterpartError: a material that Mitsuba lacks; the message has its name.
    """
    opacity = _passing(slot)
    if slot.inner and (slot.model.transmits or any(_passing(inner) != 1.0 for inner in slot.inner)):
        a, b = (bsdf(inner, opened) for inner in slot.inner)
        weight = _value(slot.values["weight"], opened)
        found: dict[str, Any] = {"type": "blendbsdf", "weight": weight, "bsdf_0": a, "bsdf_1": b}
    else:
        found = _bare(slot, opened)
        if slot.normal_map is not None:
            if slot.normal_strength != 1.0:
                raise NoCounterpartError(f"{slot.name}: Mitsuba's normal maps have no strength")
            found = {"type": "normalmap", "normalmap": opened(slot.normal_map), "bsdf": found}
        if slot.bump_map is not None:
            found = {"type": "bumpmap", "bump_texture": opened(slot.bump_map), "bsdf": found}
        if slot.two_sided and not slot.model.transmits:
            found = {"type": "twosided", "material": found}
    return found if opacity == 1.0 else {"type": "mask", "opacity": _value(opacity, opened), "material": found}


def _value(value: Any, opened: Opened) -> Any:
    """Convert a parameter to a value for Mitsuba's dict."""
    if isinstance(value, Node):
        return opened(value)
    return _rgb(value) if isinstance(value, tuple) else value


def _passing(slot: ResolvedMaterial) -> float | Node:
    """Return the opacity of a material itself."""
    if isinstance(slot.opacity, Node):
        if slot.alpha_cutoff is not None:
            raise NoCounterpartError(f"{slot.name}: a cutoff of an opacity texture has no counterpart in Mitsuba")
        return slot.opacity
    return slot.opacity if slot.alpha_cutoff is None else float(slot.opacity >= slot.alpha_cutoff)


def _bare(slot: ResolvedMaterial, opened: Opened) -> dict[str, Any]:
    """Return Mitsuba's dict of a material seen from its front, without wrappers."""
    model, values = slot.model, dict(slot.values)
    if slot.inner:
        a, b = (_bare(inner, opened) for inner in slot.inner)
        return {"type": "blendbsdf", "weight": _value(values["weight"], opened), "bsdf_0": a, "bsdf_1": b}
    if model.name not in (*SHARED, *SMOOTH):
        raise NoCounterpartError(f"{slot.name}: {model.name} has no counterpart in Mitsuba")
    if getattr(model, "energy_compensation", False):
        raise NoCounterpartError(f"{slot.name}: energy_compensation has no counterpart in Mitsuba")
    out: dict[str, Any] = {"type": model.name}
    if getattr(model, "schlick", False):
        if values.pop("reflectance") != (1.0, 1.0, 1.0):
            raise NoCounterpartError(f"{slot.name}: a conductor given by its reflectance has no counterpart in Mitsuba")
        out["material"] = "none"
    if model.name in SMOOTH:
        if isinstance(values.get("roughness"), Node):
            raise NoCounterpartError(f"{slot.name}: Mitsuba interpolates alpha, torchpt a texture of roughness")
        if "roughness" in values:
            values["alpha"] = values.pop("roughness") ** 2  # type: ignore[operator]
        alphas = {key: values.pop(key) for key in ("alpha", "alpha_u", "alpha_v") if key in values}
        numbers = [alpha for alpha in alphas.values() if isinstance(alpha, float)]
        if numbers and max(numbers) < LEAST_ALPHA:
            out["type"] = SMOOTH[model.name]
        else:
            least = {k: max(LEAST_ALPHA, alpha) if isinstance(alpha, float) else alpha for k, alpha in alphas.items()}
            facets = "beckmann" if getattr(model, "beckmann", False) else "ggx"
            out |= {"distribution": facets, **{key: _value(alpha, opened) for key, alpha in least.items()}}
    if getattr(model, "nonlinear", False):
        out["nonlinear"] = True
    return out | {key: _value(value, opened) for key, value in values.items()}


def _write_part(file: Path, scene: Scene, part: Part) -> None:
    """Write a mesh in world space with torchpt's interpolated normals; equal corners become one vertex.

    Mitsuba takes an edge whose triangles do not share vertices for two borders, and counts its silhouette twice.
    """
    own = Space(torch.zeros(3, dtype=torch.float64), 1.0)
    corners = corners_of(part, scene.params, own, torch.float64)
    columns = [torch.stack((corners.p0, corners.p1, corners.p2))]  # (3 corners, 3, F)
    if corners.normals is not None:
        columns.append(torch.stack(corners.normals))
        face = cross(corners.p1 - corners.p0, corners.p2 - corners.p0)
        against = dot(face, columns[1].sum(0)) < 0  # the outside is where the shading normals point
    else:
        against = torch.zeros(corners.p0.shape[1], dtype=torch.bool)
    if part.uvs is not None:
        assert corners.faces is not None
        columns.append(torch.from_numpy(part.uvs)[corners.faces].permute(1, 2, 0))
    rows = torch.cat(columns, 1)
    rows = torch.where(against, rows[[0, 2, 1]], rows)
    names = [
        *"xyz",
        *(("nx", "ny", "nz") if corners.normals is not None else ()),
        *("uv" if part.uvs is not None else ""),
    ]
    corner = rows.permute(2, 0, 1).reshape(-1, len(names)).detach().float().numpy()
    vertices, index = np.unique(corner, axis=0, return_inverse=True)
    write_ply(file, vertices, index.reshape(-1, 3), names)


def write_ply(file: Path, vertices: np.ndarray, faces: np.ndarray, names: Sequence[str] = "xyz") -> None:
    """Write a binary PLY of vertices ``(V, C)`` with properties ``names`` and triangles ``(F, 3)``."""
    properties = "".join(f"property float {name}\n" for name in names)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    rows["n"], rows["v"] = 3, faces
    file.write_bytes(header.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())
