"""Mitsuba's sensors, films, filters, samplers and integrators: what each becomes here."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from torchpt.math.transforms import is_rigid, is_singular
from torchpt.scene.formats.mitsuba.plugins import Plugin, exact, nearest
from torchpt.scene.formats.mitsuba.properties import Properties

if TYPE_CHECKING:
    from torchpt.scene.formats.mitsuba.importer import Importer

__all__ = [
    "FILMS",
    "FILTERS",
    "INTEGRATORS",
    "SAMPLERS",
    "SENSORS",
    "UNKNOWN_FILM",
    "UNKNOWN_INTEGRATOR",
    "UNKNOWN_SAMPLER",
]

Block = dict[str, Any]

#: Half the diagonal of 35 mm film, in mm: that of `focal_length`.
_HALF_DIAGONAL = 0.5 * math.hypot(36.0, 24.0)
_AXES = ("x", "y", "smaller", "larger", "diagonal")


# ---- Sensors


def _pose(p: Properties) -> tuple[Any, Any]:
    """Return the pose without scale as rows of numbers, and the lengths ``(3,)`` of its axes."""
    matrix = p.transform()
    if p.element.written == "camera":  # before 0.4, when x was to the right
        matrix = matrix @ np.diag([-1.0, 1.0, 1.0, 1.0])
    matrix = matrix.copy()
    if p.plugin in ("orthographic", "telecentric") and not matrix[:3, 2].any():  # its length has no meaning there
        matrix[:3, 2] = np.cross(matrix[:3, 0], matrix[:3, 1])
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if not (lengths > 0.0).all() or is_singular(matrix):
        raise p.element.error(matrix[:3].tolist(), "a to_world that can be inverted")
    matrix[:3, :3] /= lengths
    if not is_rigid(matrix):
        p.note("the shear of to_world is left out")
        view = matrix[:3, 2]
        above = matrix[:3, 1] - view * (matrix[:3, 1] @ view)
        above /= np.linalg.norm(above)
        left = np.cross(above, view)
        matrix[:3, 0], matrix[:3, 1] = left * np.sign(left @ matrix[:3, 0]), above
    return [[float(x) for x in row] for row in matrix], lengths


def _clip(p: Properties) -> None:
    for name in ("near_clip", "far_clip"):
        if p.has(name):
            p.number(name, 0.0)
            p.note(f"{name} is left out: all that is in front of the camera is seen")
    if p.number("shutter_open", 0.0) != p.number("shutter_close", 0.0):
        p.note("the shutter is left out: nothing moves")
    p.ignore("shutter_open_time", "srf")


def _view(p: Properties) -> Block:
    """Return the angle of view and the principal point."""
    found: Block = {}
    axis = p.text("fov_axis", "x")
    if p.element.written == "camera" and not p.has("fov_axis"):
        axis = "smaller" if p.flag("map_smaller_side", True) else "larger"
    if axis not in _AXES:
        raise p.element.error(axis, f"one of {', '.join(_AXES)} as fov_axis")
    p.ignore("focal_length")
    if p.has("fov"):
        found["fov"] = p.number("fov", 0.0)
    else:
        text = p.text("focal_length", "50mm").removesuffix("mm")
        try:
            length = float(text)
        except ValueError:
            length = 0.0
        if not 0.0 < length < math.inf:
            raise p.element.error(p.text("focal_length"), "a focal_length in millimetres, such as 50mm")
        found["fov"], axis = math.degrees(2.0 * math.atan(_HALF_DIAGONAL / length)), "diagonal"
    if axis != "x":
        found["fov_axis"] = axis
    for name in ("principal_point_offset_x", "principal_point_offset_y"):
        if value := p.number(name, 0.0):
            found[name] = value
    return found


def _perspective(p: Properties, importer: Importer) -> Block:
    _clip(p)
    pose, _ = _pose(p)
    return {"type": "perspective", "to_world": pose, **_view(p)}


def _thin_lens(p: Properties, importer: Importer) -> Block:
    _clip(p)
    pose, _ = _pose(p)
    distance = p.number("focus_distance", 1e4)
    radius = p.number("aperture_radius", 0.0)
    if p.has("blades"):
        p.note("blades are left out: the lens is round")
        p.ignore("blades")
    return {"type": "thinlens", "to_world": pose, **_view(p), "aperture_radius": radius, "focus_distance": distance}


def _orthographic(p: Properties, importer: Importer) -> Block:
    """Return an orthographic camera: the film is 2 wide before the scale of ``to_world``."""
    _clip(p)
    pose, lengths = _pose(p)
    if abs(lengths[0] - lengths[1]) > 1e-6 * lengths[0]:
        p.note("pixels are squares: the vertical scale of to_world becomes the horizontal one")
    for name in ("principal_point_offset_x", "principal_point_offset_y"):
        if p.number(name, 0.0):
            p.note(f"{name} is left out: the middle of the view is that of the film")
    return {"type": "orthographic", "to_world": pose, "width": 2.0 * float(lengths[0])}


#: Plugins of the tag ``sensor``.
SENSORS: dict[str, Plugin] = {
    "perspective": exact("perspective", _perspective, "clip planes and shutter are left out, with a warning"),
    "thinlens": exact("thinlens", _thin_lens, "clip planes and shutter are left out, with a warning"),
    "orthographic": exact("orthographic", _orthographic, "clip planes and shutter are left out, with a warning"),
    "perspective_rdist": nearest("perspective", _perspective, "without the distortion of the lens"),
    "telecentric": nearest("orthographic", _orthographic, "without the blur of the lens"),
    "batch": nearest("perspective", _perspective, "one sensor is rendered"),
    "spherical": nearest("perspective", _perspective, "a picture of some directions"),
}


# ---- Films and filters


def _film(p: Properties, importer: Importer) -> Block:
    p.ignore(
        "file_format", "pixel_format", "component_format", "banner", "high_quality_edges", "attach_log", "sample_border"
    )
    p.ignore("compensate", "filename", "variable", "digits", "show_messages", "has_variance", "alpha")
    found: Block = {"width": p.integer("width", 768), "height": p.integer("height", 576)}
    if p.has("crop_width", "crop_height", "crop_offset_x", "crop_offset_y"):
        x, y = p.integer("crop_offset_x", 0), p.integer("crop_offset_y", 0)
        width, height = p.integer("crop_width", found["width"] - x), p.integer("crop_height", found["height"] - y)
        if [x, y, width, height] != [0, 0, found["width"], found["height"]]:
            found["crop"] = [x, y, width, height]
    if p.plugin == "ldrfilm":
        gamma = p.number("gamma", -1.0)
        if gamma > 0.0:
            found["gamma"] = 1.0 / gamma
        if exposure := p.number("exposure", 0.0):
            found["exposure"] = exposure
        if p.text("tonemap_method", "gamma") == "reinhard":
            found["tonemap"] = "reinhard"
            p.ignore("key", "burn")
            p.note("reinhard becomes x / (1 + x) of each channel, without key and burn")
    filters = p.objects("rfilter")
    found["filter"] = importer.build(FILTERS, filters[-1], UNKNOWN_FILTER) if filters else {"type": "gaussian"}
    return found


_FILM_NOTE = "keys of the file that is written have no effect"

#: Plugins of the tag ``film``.
FILMS: dict[str, Plugin] = {
    "hdrfilm": exact("film", _film, _FILM_NOTE),
    "ldrfilm": exact("film", _film, _FILM_NOTE),
    "tiledhdrfilm": exact("film", _film, _FILM_NOTE),
    "mfilm": exact("film", _film, _FILM_NOTE),
    "specfilm": nearest("film", _film, "the picture is RGB"),
}
UNKNOWN_FILM = nearest("film", _film, "it is unknown")


def _box(p: Properties, importer: Importer) -> Block:
    if p.number("radius", 0.5) != 0.5:
        p.note("the radius is half a pixel")
    return {"type": "box"}


def _tent(p: Properties, importer: Importer) -> Block:
    return {"type": "tent", "radius": p.number("radius", 1.0)}


def _gaussian(p: Properties, importer: Importer) -> Block:
    return {"type": "gaussian", "stddev": p.number("stddev", 0.5)}


def _mitchell(p: Properties, importer: Importer) -> Block:
    keys = {ours: p.number(ours if p.has(ours) else ours.lower(), 1.0 / 3.0) for ours in ("B", "C")}
    p.ignore("A")
    return {"type": "mitchell", **keys}


def _catmull_rom(p: Properties, importer: Importer) -> Block:
    return {"type": "mitchell", "B": 0.0, "C": 0.5}


def _lanczos(p: Properties, importer: Importer) -> Block:
    p.ignore("lobes")
    return {"type": "mitchell", "B": 0.0, "C": 0.5}


#: Plugins of the tag ``rfilter``.
FILTERS: dict[str, Plugin] = {
    "box": exact("box", _box),
    "tent": exact("tent", _tent),
    "gaussian": exact("gaussian", _gaussian),
    "mitchell": exact("mitchell", _mitchell),
    "catmullrom": exact("mitchell", _catmull_rom, "B 0, C 0.5"),
    "lanczos": nearest("mitchell", _lanczos, "B 0, C 0.5"),
}
UNKNOWN_FILTER = nearest("gaussian", lambda p, importer: {"type": "gaussian"}, "it is unknown")


# ---- Samplers and integrators


def _sampler(type: str) -> Any:
    def build(p: Properties, importer: Importer) -> tuple[str, int]:
        p.ignore("seed", "jitter", "dimension", "scramble", "shift", "resolution", "pixel_offset")
        count = p.integer("sample_count", 4)
        if count < 1:
            p.note("a sample_count below 1 becomes 1")
        return type, max(count, 1)

    return build


#: Plugins of the tag ``sampler``.
SAMPLERS: dict[str, Plugin] = {
    "independent": exact("independent", _sampler("independent")),
    "stratified": exact("stratified", _sampler("stratified")),
    "hammersley": exact("hammersley", _sampler("hammersley")),
    "sobol": exact("sobol", _sampler("sobol")),
    "ldsampler": nearest("sobol", _sampler("sobol"), "another low-discrepancy sequence"),
    "halton": nearest("sobol", _sampler("sobol"), "another low-discrepancy sequence"),
    "multijitter": nearest("stratified", _sampler("stratified"), "stratified in other pairs of dimensions"),
    "orthogonal": nearest("stratified", _sampler("stratified"), "stratified in other pairs of dimensions"),
}
UNKNOWN_SAMPLER = nearest("independent", _sampler("independent"), "it is unknown")


def _depths(p: Properties) -> Block:
    found: Block = {"max_depth": p.integer("max_depth", -1), "rr_depth": p.integer("rr_depth", 5)}
    if found["max_depth"] == 0:
        p.note("max_depth 0, a black picture, becomes 1")
        found["max_depth"] = 1
    found["max_depth"] = max(found["max_depth"], -1)
    found["rr_depth"] = max(found["rr_depth"], 1)
    if p.flag("hide_emitters"):
        p.note("hide_emitters is left out: emitters are seen")
    p.ignore("strict_normals")
    return found


def _path(p: Properties, importer: Importer) -> Block:
    return {"type": "path", **_depths(p)}


def _direct(p: Properties, importer: Importer) -> Block:
    p.ignore("shading_samples", "emitter_samples", "bsdf_samples", "strict_normals")
    if p.flag("hide_emitters"):
        p.note("hide_emitters is left out: emitters are seen")
    return {"type": "direct"}


#: Settings of the integrators that become another one, in any version and in published scenes, without meaning for that.
_SETTINGS = (
    "alpha", "bidirectional", "bidirectional_mutation", "block_size", "brute_force", "caustic_lookup_radius",
    "caustic_perturbation", "caustic_photons", "chain_length", "clamp_neighbor", "clamp_screen", "clamping", "debug",
    "direct_samples", "direct_sampling", "dual_buffer", "explicit_sampling", "global_lookup_radius", "global_photons",
    "glossy_samples", "gradients", "granularity", "guiding", "guiding_proj", "guiding_rounds", "indirect_only",
    "initial_radius", "k_nn", "lambda", "lens_perturbation", "light_image", "lookup_size", "luminance_samples",
    "manifold_perturbation", "max_chains", "max_error", "max_passes", "max_sample_factor", "meridian_align",
    "multi_chain_perturbation", "num_chains", "overture", "p_large", "p_value", "photon_count", "proj_seed", "quality",
    "quality_adjustment", "rays", "resolution", "sample_direct", "samples_per_pass", "separate_direct",
    "shadow_map_resolution", "sppc", "sppi", "sppp", "step_snapshot", "timeout", "two_stage", "use_spectral_mis",
    "volume_lookup_radius", "volume_photons",
)  # fmt: skip


def _like_path(p: Properties, importer: Importer) -> Block:
    """Return a path tracer in place of an integrator whose own settings have no meaning for it."""
    p.ignore(*_SETTINGS)
    inner = p.objects("integrator")
    if inner:
        return importer.build(INTEGRATORS, inner[0], UNKNOWN_INTEGRATOR)
    return {"type": "path", **_depths(p)}


def _like_bdpt(p: Properties, importer: Importer) -> Block:
    return {**_like_path(p, importer), "type": "bdpt"}


def _bdpt(p: Properties, importer: Importer) -> Block:
    return {**_like_bdpt(p, importer), "light_paths": 1.0, "connections": "one"}


def _vcm(p: Properties, importer: Importer) -> Block:
    return {**_like_path(p, importer), "type": "vcm"}


_LAYERS = {"albedo": "albedo", "depth": "depth", "position": "position", "uv": "uv", "sh_normal": "normal"}


def _aov(p: Properties, importer: Importer) -> Block:
    """Return the integrator inside, with the layers as ``aovs``; without one, the layers alone."""
    layers: list[str] = []
    for item in p.text("aovs").split(","):
        kind = item.rpartition(":")[2].strip()
        if kind in _LAYERS:
            layers.append(_LAYERS[kind])
        elif kind:
            p.note(f"the layer {kind} is left out")
    inner = p.objects("integrator")
    found = importer.build(INTEGRATORS, inner[0], UNKNOWN_INTEGRATOR) if inner else {"type": "aov"}
    return found | {"aovs": list(dict.fromkeys(layers))}


_OTHER = "light is gathered by a path tracer"
_MEDIA = "without media"

#: Plugins of the tag ``integrator``.
INTEGRATORS: dict[str, Plugin] = {
    "path": exact("path", _path, "hide_emitters is left out, with a warning"),
    "direct": exact("direct", _direct, "hide_emitters is left out, with a warning"),
    "aov": exact("aovs", _aov),
    **dict.fromkeys(("volpath", "volpathmis", "volpath_simple", "prbvolpath"), nearest("path", _like_path, _MEDIA)),
    "bdpt": nearest("bdpt", _bdpt, "each vertex of a camera path is connected to one of its light path"),
    "ptracer": nearest("bdpt", _like_bdpt, "camera paths and light samples count too"),
    **dict.fromkeys(
        ("ppm", "sppm", "photonmapper"),
        nearest("vcm", _vcm, "photons are merged where nothing else finds their light, within a radius of its own"),
    ),
    **dict.fromkeys(
        (
            "mlt",
            "pssmlt",
            "erpt",
            "vpl",
            "irrcache",
            "adaptive",
            "prb",
            "prb_basic",
            "direct_projective",
            "prb_projective",
            "emission",
            "moment",
            "stokes",
            "depth",
            "multichannel",
        ),
        nearest("path", _like_path, _OTHER),
    ),
}
#: The entry of integrators that are not in the table, as those of people who wrote their own.
UNKNOWN_INTEGRATOR = nearest("path", _like_path, "it is unknown")
