"""Image-based lighting by split sum: maps of a sky as tensors, differentiable in the sky, and shading with them.

``torchpt.ibl.maps(sky)`` makes them, ``torchpt.ibl.shade(maps, n, v, base_color, roughness, metallic)`` looks them up.
"""

from torchpt.physics.ibl import (
    IblMaps,
    Sky,
    SplitSumMaterial,
    brdf_table,
    cube_to_equirect,
    equirect_to_cube,
    fresnel,
    hammersley,
    irradiance_map,
    maps,
    prefiltered,
    roughnesses,
    shade,
    van_der_corput,
)

__all__ = [
    "IblMaps",
    "Sky",
    "SplitSumMaterial",
    "brdf_table",
    "cube_to_equirect",
    "equirect_to_cube",
    "fresnel",
    "hammersley",
    "irradiance_map",
    "maps",
    "prefiltered",
    "roughnesses",
    "shade",
    "van_der_corput",
]
