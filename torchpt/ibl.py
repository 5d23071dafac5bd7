"""Image-based lighting by the split-sum approximation: prefiltered environment maps as tensors, differentiable in the sky.

``torchpt.ibl.maps(sky)`` prefilters a sky; ``torchpt.ibl.shade(maps, n, v, base_color, roughness, metallic)`` shades with it.
"""

from torchpt.physics.ibl.convolve import irradiance_map, prefiltered, roughnesses
from torchpt.physics.ibl.cube import cube_to_equirect, equirect_to_cube
from torchpt.physics.ibl.points import hammersley, van_der_corput
from torchpt.physics.ibl.shading import IblMaps, Sky, SplitSumMaterial, fresnel, maps, shade
from torchpt.physics.ibl.table import brdf_table

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
