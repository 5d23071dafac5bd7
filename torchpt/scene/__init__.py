"""Load scenes and prepare them for engines: YAML -> description -> parts -> :class:`Scene` -> world and wave.

A *description* is a scene file that was read and checked. *Parts* are its surfaces as NumPy arrays, one for each material of a
shape. The *world* holds the same as tensors, in the coordinates that a render computes in; a *wave* is the world together with
camera, sampler, film filter and integrator: all that an engine needs.

====================  ==================================================================================
``formats/``          reads scene files and validates them: the description
``meshes/``           reads mesh files: triangles with their materials, lights and cameras
``settings.py``       the settings of a render, each declared once
``loading.py``        ``torchpt.load``: start here
``build.py``          builds parts and parameters of a description, with ``shapes.py``, ``sources.py``, ``mesh_triangles.py``
``scene.py``          a scene: its parameters, and a cache of the worlds and trees built from them
``world/``            builds the world of parts and parameters: one differentiable function
``prepare.py``        builds the wave of a render, and chooses the engine
``conventions.py``    converts cameras of other libraries; ``transforms_json.py`` reads and writes those of NeRF datasets
====================  ==================================================================================

May import: ``engines`` and the layers below.
"""

from __future__ import annotations

from torchpt.scene.loading import load
from torchpt.scene.scene import Scene

__all__ = ["Scene", "load"]
