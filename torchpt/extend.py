"""Everything for a kind of your own: base classes, records, parameters, random numbers, vectors.

Names and meanings here are as stable as the functions of ``torchpt``; other modules may change.

====================  =====================================================================================
a material            :class:`Bsdf` with :class:`BsdfSample`
a light               :class:`Light` with :class:`Row`, :class:`Setting`, :class:`Cone`, :class:`LightSample`
a shape               :class:`Shape` with :class:`Surface`; :class:`Quadric` with :class:`Form`
a camera              :class:`Camera`
a sampler             :class:`Points`
a filter              :class:`Filter`, :class:`Tabulated`
a texture             :class:`Computed`
an integrator         :class:`Path`, :class:`FirstSurfaceIntegrator`, :class:`Limits`, and the records of stages
an AOV                :class:`SurfaceLayer`, :class:`FilmLayer`
parameters            :class:`Scalar`, :class:`Color`, ... with :class:`Moves` and :class:`Refused`
====================  =====================================================================================
"""

from torchpt.math.hashing import as_int32, mix, to_unit
from torchpt.math.sampling import (
    concentric_disk,
    cosine_hemisphere,
    power_heuristic,
    uniform_hemisphere,
    uniform_sphere,
)
from torchpt.math.vectors import Frame, dot, luminance, normalize
from torchpt.paths.integrators.base import DARK_RIMS, LIGHT_CHOICE, SAMPLES, STRATEGY, Limits
from torchpt.paths.integrators.first_surface import FirstSurface, FirstSurfaceIntegrator
from torchpt.paths.integrators.kinds.path import Path
from torchpt.paths.layers import FilmLayer, Seen, SurfaceLayer
from torchpt.paths.state import (
    DirectLight,
    Drawn,
    Emission,
    Field,
    PathState,
    Shadow,
    Splat,
    StageContext,
    Transmission,
    VertexInput,
    VertexOutput,
    no_shadow,
)
from torchpt.paths.surface import shading_normal
from torchpt.physics.bsdfs.base import Bsdf, Parameters
from torchpt.physics.bsdfs.records import BsdfSample
from torchpt.physics.bsdfs.specs import GREY, reflectance
from torchpt.physics.cameras.base import Camera
from torchpt.physics.film.filters import Filter, Tabulated
from torchpt.physics.lights.base import Cone, Light, Row, Setting, bright
from torchpt.physics.lights.kinds.point import Point
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.physics.samplers import Dimension, Draws
from torchpt.physics.samplers.base import Points
from torchpt.physics.samplers.bits import reverse_bits, scramble
from torchpt.physics.shapes import interact, offset_origin
from torchpt.physics.shapes.base import BOTTOM, UPRIGHT, Matrix, Place, Shape, Size, Surface, placed
from torchpt.physics.shapes.geometry import Hit, Interaction
from torchpt.physics.shapes.quadrics import Form, Quadric, octahedral
from torchpt.physics.textures.computed import Computed
from torchpt.physics.world import World
from torchpt.spec import Angle, Choice, Color, Custom, Flag, Integer, Moves, Refused, Scalar

__all__ = [
    "BOTTOM",
    "DARK_RIMS",
    "GREY",
    "LIGHT_CHOICE",
    "SAMPLES",
    "STRATEGY",
    "UPRIGHT",
    "Angle",
    "Bsdf",
    "BsdfSample",
    "Camera",
    "Choice",
    "Color",
    "Computed",
    "Cone",
    "Custom",
    "Dimension",
    "DirectLight",
    "Drawn",
    "Draws",
    "Emission",
    "Field",
    "FilmLayer",
    "Filter",
    "FirstSurface",
    "FirstSurfaceIntegrator",
    "Flag",
    "Form",
    "Frame",
    "Hit",
    "Integer",
    "Interaction",
    "Light",
    "LightSample",
    "Lights",
    "Limits",
    "Matrix",
    "Moves",
    "Parameters",
    "Path",
    "PathState",
    "Place",
    "Point",
    "Points",
    "Quadric",
    "Refused",
    "Row",
    "Scalar",
    "Seen",
    "Setting",
    "Shadow",
    "Shape",
    "Size",
    "Splat",
    "StageContext",
    "Surface",
    "SurfaceLayer",
    "Tabulated",
    "Transmission",
    "VertexInput",
    "VertexOutput",
    "World",
    "as_int32",
    "bright",
    "concentric_disk",
    "cosine_hemisphere",
    "dot",
    "interact",
    "luminance",
    "mix",
    "no_shadow",
    "normalize",
    "octahedral",
    "offset_origin",
    "placed",
    "power_heuristic",
    "reflectance",
    "reverse_bits",
    "scramble",
    "shading_normal",
    "to_unit",
    "uniform_hemisphere",
    "uniform_sphere",
]
